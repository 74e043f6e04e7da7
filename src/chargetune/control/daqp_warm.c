/* Dense QP by DAQP, warm-started, without memory allocation:
 *
 *   min 1/2 x'Hx + g'x   s.t.   lbx <= x <= ubx,   A x <= uba
 *
 * as a function of CasADi's C interface with arguments (H, g, A, uba, lbx, ubx, guess) and results (x, multipliers).
 * guess and multipliers hold the bounds first, then the rows; positive is active at the upper side, negative at the
 * lower one, zero is inactive. Matrices are column-major on the way in (H is symmetric).
 * Rows are generated: the QP is solved with those that the guess says are active, and again with those that its solution
 * breaks, until it breaks none. Setting up a row costs as much as a pivot and most rows of a long horizon never matter.
 * QP_N variables, QP_M rows and QP_TOLERANCE are set by the compiler's command line, QP_NAME is the name of the function.
 * DAQP: Arnstrom, Bemporad, Axehill, IEEE Trans. Automatic Control 67 (2022), doi 10.1109/TAC.2022.3176430.
 */
#include <daqp/api.h>
#include <daqp/utils.h>
#include <float.h>
#include <math.h>
#include <string.h>

#define JOIN_(a, b) a##b
#define JOIN(a, b) JOIN_(a, b)
#define VARS QP_N
#define CONS (QP_N + QP_M)
#define UPDATE_ALL (UPDATE_Rinv + UPDATE_M + UPDATE_v + UPDATE_d + UPDATE_sense)
#define UPDATE_ROWS (UPDATE_M + UPDATE_d + UPDATE_sense)

long long JOIN(QP_NAME, _n_in)(void) { return 7; }
long long JOIN(QP_NAME, _n_out)(void) { return 2; }

/* Dense shapes in CasADi's compressed form: rows, columns, 1 = dense. */
static const long long square[3] = {VARS, VARS, 1}, column[3] = {VARS, 1, 1}, matrix[3] = {QP_M, VARS, 1}, rows[3] = {QP_M, 1, 1}, all[3] = {CONS, 1, 1};
const long long *JOIN(QP_NAME, _sparsity_in)(long long i) {
  switch (i) {
    case 0: return square;
    case 2: return matrix;
    case 3: return rows;
    case 6: return all;
    default: return column;
  }
}
const long long *JOIN(QP_NAME, _sparsity_out)(long long i) { return i == 0 ? column : all; }

/* Below this a row counts as kept; far above rounding, far below the tolerance of the optimality check. */
#define ROW_TOLERANCE 1e-9

/* Fill the working set: bounds that coincide always, then what the guess says; stops at the first dependent one. */
static void start_from(DAQPWorkspace *work, const double *guess) {
  int i;
  for (i = 0; i < work->m; ++i)
    if ((work->sense[i] & IMMUTABLE) && (work->sense[i] & ACTIVE)) add_constraint(work, i, 1.0);
  for (i = 0; guess && i < work->m && work->n_active < work->n && work->sing_ind == EMPTY_IND; ++i) {
    const double g = guess[i];
    if (!(g > 0 || g < 0) || (work->sense[i] & (ACTIVE + IMMUTABLE))) continue;
    if (g < 0 && work->qp->blower[i] <= -DAQP_INF) continue;
    if (g > 0 && work->qp->bupper[i] >= DAQP_INF) continue;
    if (g < 0) work->sense[i] |= LOWER;
    add_constraint(work, i, g);
  }
}

/* DAQP does not survive numbers that are none; bounds may be infinite. */
static int usable(const double **arg) {
  int i, bad = 0;
  for (i = 0; i < VARS * VARS; ++i) bad |= !(fabs(arg[0][i]) <= DBL_MAX);
  for (i = 0; i < VARS; ++i) bad |= !(fabs(arg[1][i]) <= DBL_MAX) | (arg[4][i] != arg[4][i]) | (arg[5][i] != arg[5][i]);
  for (i = 0; i < QP_M * VARS; ++i) bad |= !(fabs(arg[2][i]) <= DBL_MAX);
  for (i = 0; i < QP_M; ++i) bad |= !(fabs(arg[3][i]) <= DBL_MAX);
  return !bad;
}

int QP_NAME(const double **arg, double **res, long long *iw, double *w, int mem) {
  double a[QP_M * VARS + 1], lower[CONS], upper[CONS];
  double rinv[(VARS + 1) * VARS / 2], m[QP_M * VARS + 1], v[VARS], scaling[CONS], dupper[CONS], dlower[CONS];
  double lam[VARS + 2], lam_star[VARS + 2], l[(VARS + 2) * (VARS + 3) / 2], d[VARS + 2], xldl[VARS + 2], zldl[VARS + 2];
  double x[VARS + 1], xold[VARS + 1], primal[VARS], dual[CONS], guess[CONS];
  int sense[CONS], start[CONS], origin[QP_M + 1], used[QP_M + 1], working[VARS + 2], kept = 0, added, mask, i, j;
  DAQPSettings settings;
  DAQPProblem qp;
  DAQPWorkspace work;
  DAQPResult result;
  (void)iw;
  (void)w;
  (void)mem;

  if (!usable(arg)) {
    for (i = 0; i < VARS && res[0]; ++i) res[0][i] = NAN;
    for (i = 0; i < CONS && res[1]; ++i) res[1][i] = NAN;
    return 0;
  }
  memset(&work, 0, sizeof work);
  daqp_default_settings(&settings);
  settings.primal_tol = QP_TOLERANCE;
  result.x = primal;
  result.lam = dual;
  qp.n = work.n = VARS;
  qp.ms = work.ms = VARS;
  qp.H = (double *)arg[0];
  qp.f = (double *)arg[1];
  qp.A = a;
  qp.bupper = upper;
  qp.blower = lower;
  qp.sense = start;
  work.qp = &qp;
  work.M = m;
  work.dupper = dupper;
  work.dlower = dlower;
  work.Rinv = rinv;
  work.v = v;
  work.sense = sense;
  work.scaling = scaling;
  work.x = work.u = x;
  work.xold = xold;
  work.lam = lam;
  work.lam_star = lam_star;
  work.L = l;
  work.D = d;
  work.xldl = xldl;
  work.zldl = zldl;
  work.WS = working;
  work.settings = &settings;

  for (i = 0; i < CONS; ++i) start[i] = 0;
  for (i = 0; i < VARS; ++i) {
    guess[i] = arg[6][i];
    lower[i] = arg[4][i] < -DAQP_INF ? -DAQP_INF : arg[4][i];
    upper[i] = arg[5][i] > DAQP_INF ? DAQP_INF : arg[5][i];
  }
  for (i = 0; i < QP_M; ++i) {
    used[i] = arg[6][VARS + i] > 0.0;
    if (used[i]) {
      for (j = 0; j < VARS; ++j) a[kept * VARS + j] = arg[2][j * QP_M + i];
      guess[VARS + kept] = arg[6][VARS + i];
      origin[kept++] = i;
    }
  }

  mask = UPDATE_ALL;
  do {
    qp.m = work.m = VARS + kept;
    for (i = mask == UPDATE_ALL ? 0 : VARS; i < VARS + kept; ++i) scaling[i] = 1.0;
    for (i = 0; i < kept; ++i) {
      lower[VARS + i] = -DAQP_INF;
      upper[VARS + i] = arg[3][origin[i]];
    }
    memset(m, 0, kept * VARS * sizeof *m);
    reset_daqp_workspace(&work);
    result.exitflag = update_ldp(mask, &work);
    if (result.exitflag < 0) break;
    mask = UPDATE_ROWS;
    start_from(&work, guess);
    if (work.sing_ind != EMPTY_IND) {
      /* Dependent guesses: start from nothing. */
      for (i = 0; i < VARS + kept; ++i)
        if (!(sense[i] & IMMUTABLE)) sense[i] &= ~(ACTIVE + LOWER);
      reset_daqp_workspace(&work);
      start_from(&work, NULL);
    }
    daqp_solve(&result, &work);
    if (result.exitflag <= 0) break;

    memcpy(guess, dual, (VARS + kept) * sizeof *guess);
    added = 0;
    for (i = 0; i < QP_M; ++i) {
      double value = 0.0;
      if (used[i]) continue;
      for (j = 0; j < VARS; ++j) value += arg[2][j * QP_M + i] * primal[j];
      if (value <= arg[3][i] + ROW_TOLERANCE) continue;
      for (j = 0; j < VARS; ++j) a[kept * VARS + j] = arg[2][j * QP_M + i];
      guess[VARS + kept] = 0.0;
      used[i] = 1;
      origin[kept++] = i;
      added = 1;
    }
  } while (added);

  for (i = 0; i < VARS && res[0]; ++i) res[0][i] = result.exitflag > 0 ? primal[i] : NAN;
  if (res[1]) {
    for (i = 0; i < CONS; ++i) res[1][i] = result.exitflag > 0 ? 0.0 : NAN;
    for (i = 0; i < VARS + kept && result.exitflag > 0; ++i) res[1][i < VARS ? i : VARS + origin[i - VARS]] = dual[i];
  }
  return 0;
}
