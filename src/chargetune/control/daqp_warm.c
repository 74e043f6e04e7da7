/* Dense QP by DAQP, warm-started, without memory allocation:
 *
 *   min |x|^2 / 2 + g'x   s.t.   x_i >= 0 for i < QP_SLACKS,   lba <= A x <= uba
 *
 * as a function of CasADi's C interface with arguments (g, A', lba, uba, guess) and results (A x, multipliers).
 * guess and multipliers hold the bounds first, then the rows; positive is active at the upper side, negative at the
 * lower one, zero is inactive. Matrices are column-major, so that each row of A stands in one piece.
 * The Hessian is the identity, which makes this DAQP's own inner problem: nothing has to be factorised for it.
 * Rows are generated: the QP is solved with those that the guess says are active, and again with those that its solution
 * breaks, until it breaks none. Setting up a row costs as much as a pivot and most rows of a long horizon never matter.
 * The work arrays are the caller's, on the heap: those of a long horizon are larger than a stack.
 * QP_SLACKS, QP_VARIABLES (slacks included), QP_ROWS and QP_TOLERANCE are set by the compiler's command line, QP_NAME is
 * the name of the function.
 * DAQP: Arnstrom, Bemporad, Axehill, IEEE Trans. Automatic Control 67 (2022), doi 10.1109/TAC.2022.3176430.
 */
#include <daqp/api.h>
#include <daqp/utils.h>
#include <float.h>
#include <limits.h>
#include <math.h>
#include <string.h>

#define JOIN_(a, b) a##b
#define JOIN(a, b) JOIN_(a, b)
#define VARS QP_VARIABLES
#define CONS (QP_SLACKS + QP_ROWS)
#define UPDATES (UPDATE_M + UPDATE_v + UPDATE_d + UPDATE_sense)

long long JOIN(QP_NAME, _n_in)(void) { return 5; }
long long JOIN(QP_NAME, _n_out)(void) { return 2; }

/* Dense shapes in CasADi's compressed form: rows, columns, 1 = dense. */
static const long long column[3] = {VARS, 1, 1}, matrix[3] = {VARS, QP_ROWS, 1}, rows[3] = {QP_ROWS, 1, 1}, all[3] = {CONS, 1, 1};
const long long *JOIN(QP_NAME, _sparsity_in)(long long i) {
  switch (i) {
    case 0: return column;
    case 1: return matrix;
    case 4: return all;
    default: return rows;
  }
}
const long long *JOIN(QP_NAME, _sparsity_out)(long long i) { return i == 0 ? rows : all; }

/* The numbers in all work arrays. DAQP counts the entries of a matrix with an int. */
#define MATRIX ((long long)QP_ROWS * VARS)
#define FACTOR ((long long)(VARS + 2) * (VARS + 3) / 2)
#define DOUBLES (2 * MATRIX + FACTOR + 7LL * CONS + QP_ROWS + 7LL * (VARS + 2) + 2LL * VARS)
#define INTS (2LL * CONS + 2LL * QP_ROWS + VARS + 2)
_Static_assert(MATRIX < INT_MAX && FACTOR < INT_MAX, "the QP has too many variables or rows");

int JOIN(QP_NAME, _work)(long long *sz_arg, long long *sz_res, long long *sz_iw, long long *sz_w) {
  if (sz_arg) *sz_arg = 5;
  if (sz_res) *sz_res = 2;
  if (sz_iw) *sz_iw = INTS;
  if (sz_w) *sz_w = DOUBLES;
  return 0;
}

static double *doubles(double **w, long long n) {
  double *taken = *w;
  *w += n;
  return taken;
}

/* An int in each of the caller's long integers' places. */
static int *ints(long long **iw, long long n) {
  int *taken = (int *)*iw;
  *iw += n;
  return taken;
}

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

/* Four sums side by side: one alone would wait for each addition. */
static double dot(const double *a, const double *b) {
  double s0 = 0.0, s1 = 0.0, s2 = 0.0, s3 = 0.0;
  int j = 0;
  for (; j + 3 < VARS; j += 4) {
    s0 += a[j] * b[j];
    s1 += a[j + 1] * b[j + 1];
    s2 += a[j + 2] * b[j + 2];
    s3 += a[j + 3] * b[j + 3];
  }
  for (; j < VARS; ++j) s0 += a[j] * b[j];
  return (s0 + s1) + (s2 + s3);
}

/* DAQP does not survive numbers that are none. */
static int finite_all(const double *a, int n) {
  int j, good = 1;
  for (j = 0; j < n; ++j) good &= fabs(a[j]) <= DBL_MAX;
  return good;
}

int QP_NAME(const double **arg, double **res, long long *iw, double *w, int mem) {
  double *a = doubles(&w, MATRIX), *m = doubles(&w, MATRIX), *l = doubles(&w, FACTOR);
  double *lower = doubles(&w, CONS), *upper = doubles(&w, CONS), *scaling = doubles(&w, CONS), *dupper = doubles(&w, CONS);
  double *dlower = doubles(&w, CONS), *dual = doubles(&w, CONS), *guess = doubles(&w, CONS), *value = doubles(&w, QP_ROWS);
  double *lam = doubles(&w, VARS + 2), *lam_star = doubles(&w, VARS + 2), *d = doubles(&w, VARS + 2), *xldl = doubles(&w, VARS + 2);
  double *zldl = doubles(&w, VARS + 2), *x = doubles(&w, VARS + 2), *xold = doubles(&w, VARS + 2);
  double *v = doubles(&w, VARS), *primal = doubles(&w, VARS);
  int *sense = ints(&iw, CONS), *start = ints(&iw, CONS), *origin = ints(&iw, QP_ROWS), *used = ints(&iw, QP_ROWS);
  int *working = ints(&iw, VARS + 2), kept = 0, taken = 0, added, good, i;
  DAQPSettings settings;
  DAQPProblem qp;
  DAQPWorkspace work;
  DAQPResult result;
  (void)mem;

  memset(&work, 0, sizeof work);
  memset(&qp, 0, sizeof qp);
  daqp_default_settings(&settings);
  settings.primal_tol = QP_TOLERANCE;
  result.x = primal;
  result.lam = dual;
  result.exitflag = 1;
  qp.n = work.n = VARS;
  qp.ms = work.ms = QP_SLACKS;
  qp.f = (double *)arg[0];
  qp.A = a;
  qp.bupper = upper;
  qp.blower = lower;
  qp.sense = start;
  work.qp = &qp;
  work.M = m;
  work.dupper = dupper;
  work.dlower = dlower;
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

  good = finite_all(arg[0], VARS);
  for (i = 0; i < QP_SLACKS; ++i) {
    lower[i] = 0.0;
    upper[i] = DAQP_INF;
    guess[i] = arg[4][i];
  }
  for (i = 0; i < CONS; ++i) {
    start[i] = 0;
    scaling[i] = 1.0;
  }
  for (i = 0; i < QP_ROWS; ++i) {
    good &= arg[2][i] <= arg[3][i];
    used[i] = arg[4][QP_SLACKS + i] > 0.0 || arg[4][QP_SLACKS + i] < 0.0 || arg[2][i] >= arg[3][i];
  }

  do {
    /* The rows in use that stand not yet in the problem. */
    for (i = 0; i < QP_ROWS && good; ++i) {
      const int k = QP_SLACKS + kept;
      if (used[i] != 1) continue;
      memcpy(a + kept * VARS, arg[1] + i * VARS, VARS * sizeof *a);
      lower[k] = arg[2][i] < -DAQP_INF ? -DAQP_INF : arg[2][i];
      upper[k] = arg[3][i] > DAQP_INF ? DAQP_INF : arg[3][i];
      guess[k] = taken ? 0.0 : arg[4][QP_SLACKS + i];
      good = finite_all(a + kept * VARS, VARS);
      used[i] = 2;
      origin[kept++] = i;
    }
    if (!good) break;
    taken = 1;
    qp.m = work.m = QP_SLACKS + kept;
    for (i = QP_SLACKS; i < QP_SLACKS + kept; ++i) scaling[i] = 1.0;
    reset_daqp_workspace(&work);
    result.exitflag = update_ldp(UPDATES, &work);
    if (result.exitflag < 0) break;
    start_from(&work, guess);
    if (work.sing_ind != EMPTY_IND) {
      /* Dependent guesses: start from nothing. */
      for (i = 0; i < QP_SLACKS + kept; ++i)
        if (!(sense[i] & IMMUTABLE)) sense[i] &= ~(ACTIVE + LOWER);
      reset_daqp_workspace(&work);
      start_from(&work, NULL);
    }
    daqp_solve(&result, &work);
    if (result.exitflag <= 0) break;

    memcpy(guess, dual, (QP_SLACKS + kept) * sizeof *guess);
    added = 0;
    for (i = 0; i < QP_ROWS; ++i) {
      value[i] = dot(arg[1] + i * VARS, primal);
      if (used[i] || (value[i] <= arg[3][i] + ROW_TOLERANCE && value[i] >= arg[2][i] - ROW_TOLERANCE)) continue;
      used[i] = added = 1;
    }
  } while (added);

  good &= result.exitflag > 0;
  for (i = 0; i < QP_ROWS && res[0]; ++i) res[0][i] = good ? value[i] : NAN;
  if (res[1]) {
    for (i = 0; i < CONS; ++i) res[1][i] = good ? 0.0 : NAN;
    for (i = 0; i < QP_SLACKS && good; ++i) res[1][i] = dual[i];
    for (i = 0; i < kept && good; ++i) res[1][QP_SLACKS + origin[i]] = dual[QP_SLACKS + i];
  }
  return 0;
}
