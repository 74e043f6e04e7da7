"""The controller's problem, discretised, condensed and scaled, as CasADi functions of run-time values only.

The states are eliminated (single shooting); the inputs U = (u_0 .. u_{N-1}) remain. ``sweep`` rolls the model out and
linearises it stage by stage; ``quadratic`` condenses that to a dense QP for the scaled step v = (U+ - U) / range and
the scaled slacks; ``residual`` measures optimality from the same linearisation without condensing it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from chargetune.control.controller import Controller
from chargetune.control.convexity import nearby_convex
from chargetune.control.estimators import finite
from chargetune.runtime.split import split

__all__ = ["Problem", "control_problem", "row_weight"]

# Least curvature of an input relative to the mean; only the steps depend on it, not the solution.
REGULARISATION = 1e-8
# A cost whose mean curvature is below this share of its mean slope (both over an input's range) is flat: a proximal term of that size
# stands in for its curvature, so that a step over the whole range costs a twenty-thousandth of what it gains.
FLAT = 1e-4
# Least curvature that stands in for a negative one.
LEAST_PIVOT = 1e-3


@dataclass(frozen=True)
class Problem:
    """A controller as CasADi functions.

    prepare
        (theta, setpoint, p_nominal) -> q, everything that is fixed over an episode (spline coefficients, weights):
        no other function sees theta or p. Where there are given signals the q of the others is this one and below it
        the signals over the horizon, a row of `model.given.windows` (`control_step.numbers`).
    bounds
        (now, q) -> (lower, upper), the input bounds over the horizon, shapes (N nu,). ``now`` is the estimate and below it
        the last values of the inputs that are `Controller.carried`; it is the first state of the horizon.
    clip
        (now, U, q) -> the inputs nearest to U, one after the other, that keep bounds and rates.
    sweep
        (now, U, q) -> (J, c, D): cost, scaled and weighted rows c(U) <= s, and the stages' derivatives packed in a vector.
    scaling
        (D, lower, upper) -> gamma, with which the mean of the scaled Hessian's diagonal is one, or less where the cost has
        hardly a curvature.
    quadratic
        (U, c, D, lower, upper, gamma) -> (g, A', lba, uba, span): the QP of `control.qp`, one slack a limit. Its first
        N nu rows are v = dU / span between the bounds, then c + dc less the slack; the cost is gamma J.
    curvature
        (now, U, D, multipliers, q) -> D with the Lagrangian's curvature in the Hessians: of a Gauss-Newton controller what
        constraints and dynamics add to the diagonal of the inputs' one, where it is positive; of an exact one all of it.
        The multipliers are those of the rows, of the cost as it is (gamma = 1).
    convex
        (D, lower, upper) -> D with which the QP is convex: as it is, or with the Hessian of each stage changed (`nearby_convex`).
    residual
        (U, c, D, multipliers, gamma, lower, upper) -> largest natural residual of the scaled optimality conditions.
    merit
        (J, c) -> phi, the cost with its exact penalties.
    fallback
        (now, q) -> input, shape (nu,), before clipping.
    correct, predict
        The estimator: (memory, y, u, q) -> (x_hat, memory); (x_hat, memory, u, q) -> memory.
    groups
        For each row the index of its limit, -1 for a row that is hard: the rate of an input.
    """

    controller: Controller
    prepare: ca.Function
    bounds: ca.Function
    clip: ca.Function
    sweep: ca.Function
    scaling: ca.Function
    quadratic: ca.Function
    curvature: ca.Function
    convex: ca.Function
    residual: ca.Function
    merit: ca.Function
    fallback: ca.Function
    correct: ca.Function
    predict: ca.Function
    groups: tuple[int, ...]

    @property
    def size(self) -> int:
        """Number of decision variables N nu."""
        return int(self.sweep.size1_in(1))

    @property
    def row_width(self) -> int:
        """Rows of c in one stage; the terminal rows follow after the last stage."""
        own = self.controller
        soft = sum(limit.rows.size1_out(0) * (2 if limit.at == "both" else 1) for limit in own.limits if limit.at != "terminal")
        return soft + 2 * len(own.rated)

    def first(self, estimate: ArrayLike, last: ArrayLike) -> NDArray[np.float64]:
        """``now`` of an estimated state and the last input."""
        return np.concatenate([np.asarray(estimate, dtype=np.float64), np.asarray(last, dtype=np.float64)[list(self.controller.carried)]])


@dataclass(frozen=True)
class _Window:
    """q = (what is fixed over an episode; g_{-1}, g_0 .. g_N): which part of it a stage reads."""

    fixed: int
    signals: int
    horizon: int

    @property
    def length(self) -> int:
        return self.fixed + self.signals * (self.horizon + 2)

    @property
    def own(self) -> int:
        """Numbers of one stage: the fixed ones, and the signals at its start and at its end."""
        return self.fixed + 2 * self.signals

    def at(self, q: Any, stage: int) -> Any:
        """What stage i of 0 .. N reads; -1 is the interval before."""
        if not self.signals:
            return q
        fixed, *signals = split(q, (self.fixed, *[self.signals] * (self.horizon + 2)))
        return ca.vertcat(fixed, signals[stage + 1], signals[min(stage + 2, self.horizon + 1)])


def row_weight(stage: int, horizon: int) -> float:
    """Weight of a violation at stage i in the slack s = max_i (1 + i / N) c_i.

    With equal weights a violation that cannot be avoided now would make all later ones as large free of charge, and a
    state once beyond its limit would stay there. Growing weights ask for half of it by the end of the horizon.
    """
    return 1.0 + stage / horizon


def control_problem(controller: Controller) -> Problem:
    """Turn a controller into CasADi functions."""
    model, horizon, limits = controller.model, controller.horizon, controller.limits
    nx, nu, ng = len(model.states), len(model.inputs), len(controller.given)
    # The state of the problem holds the last inputs that are read, too.
    carried = controller.carried
    nz = nx + len(carried)
    z, u, now = ca.SX.sym("x", nz), ca.SX.sym("u", nu), ca.SX.sym("now", nz)
    x, before = split(z, (nx, len(carried)))
    estimate, _ = split(now, (nx, len(carried)))
    theta, setpoint = ca.SX.sym("theta", controller.theta.dimension), ca.SX.sym("setpoint", nx + nu)
    nominal = ca.SX.sym("p", model.nominal.size)
    memory, y = (ca.SX.sym(name, controller.estimation.size1_in(i)) for i, name in ((1, "memory"), (2, "y")))
    given, given_end = ca.SX.sym("given", ng), ca.SX.sym("given_end", ng)

    p = controller.parameters(theta, nominal, given)
    ahead = model.f(x, u, p)
    after = ca.vertcat(ahead, *(u[i] for i in carried))
    no_input = ca.SX(ca.DM.zeros(nu))
    last = ca.SX(no_input)
    for k, i in enumerate(carried):
        last[i] = before[k]

    def rows(places: tuple[str, ...], state: Any, control: Any, signals: Any) -> Any:
        arguments = (state, control, theta, p, estimate, last, signals)
        return ca.vertcat(*(limit.rows(*arguments) / limit.scale for limit in limits if limit.at in places))

    lower, upper = (bound(theta, p, estimate, given) for bound in (controller.input_lower, controller.input_upper))
    rate = controller.input_rate(theta, p, estimate, given)[list(controller.rated)] if controller.rated else ca.SX(0, 1)
    x_hat, corrected, predicted = controller.estimation(x, memory, y, u, p)
    expressions = [
        after,
        controller.stage_cost(x, u, theta, p, setpoint, estimate, last, given),
        ca.vertcat(
            rows(("start", "both"), x, u, given),
            rows(("end", "both"), ahead, u, given_end),
            _rate_rows(controller, u, last, lower, upper, rate),
        ),
        controller.terminal_cost(x, no_input, theta, p, setpoint, estimate, last, given),
        rows(("terminal",), x, no_input, given),
        lower,
        upper,
        rate,
        controller.fallback(theta, p, estimate, given),
        x_hat,
        corrected,
        predicted,
    ]
    # Everything that depends on theta and p alone is computed once an episode instead of at every stage. What two of these expressions
    # share has to be one beforehand: two symbols for one number are not recognised any more.
    found = ca.extract_parametric(_cse(*expressions), ca.vertcat(theta, setpoint, nominal), {"extract_trivial": True})
    expressions, symbols, values = found
    fixed = ca.vertcat(*symbols) if symbols else ca.SX(0, 1)
    prepared = ca.cse(ca.vertcat(*values)) if values else ca.SX(0, 1)
    after, stage_cost, stage_rows, final_cost, final_rows, lower, upper, rate, fallback, x_hat, corrected, predicted = expressions
    q, window = ca.vertcat(fixed, given, given_end), _Window(fixed.shape[0], ng, horizon)

    weight = ca.SX.sym("weight")
    stage_rows = stage_rows * weight
    final_rows = final_rows * row_weight(horizon, horizon)
    exact, nothing = controller.hessian == "exact", ca.SX(0, 1)
    bend, bend_final = _Bend.of(z, u, after, stage_rows, exact=exact), _Bend.of(z, nothing, nothing, final_rows, exact=exact)
    stage = _Linearisation.of(z, u, after, stage_cost, stage_rows, bend)
    final = _Linearisation.of(z, nothing, nothing, final_cost, final_rows, bend_final)
    second = ca.Function("second", [z, u, now, q, weight, bend.costate, bend.multipliers], _cse(stage.bent(bend)))
    second_final = ca.Function("second_final", [z, now, q, bend_final.multipliers], _cse(final.bent(bend_final)))
    hard = [-1] * (2 * len(controller.rated))
    groups = (
        *(_group(controller, "start", "both") + _group(controller, "end", "both") + hard) * horizon,
        *_group(controller, "terminal"),
    )
    packed_stage = ca.Function("stage", [z, u, now, q, weight], _cse(after, stage_cost, stage_rows, stage.packed))
    follow = ca.Function("follow", [z, u, q], _cse(after))
    packed_final = ca.Function("final", [z, now, q], _cse(final_cost, final_rows, final.packed))
    bounds, clip = _bounds(controller, ca.Function("bound", [now, q], _cse(lower, upper, rate)), window)
    # The measurement belongs to the end of the interval before.
    correct = ca.Function("correct", [memory, y, u, q], _cse(x_hat, corrected))
    predict = ca.Function("predict", [x, memory, u, q], _cse(predicted))
    return Problem(
        controller=controller,
        prepare=ca.Function("prepare", [theta, setpoint, nominal], [prepared]),
        bounds=bounds,
        clip=clip,
        sweep=_sweep(packed_stage, packed_final, nz, nu, window),
        scaling=_scaling(controller, stage, final),
        quadratic=_quadratic(controller, stage, final, groups),
        curvature=_curvature(follow, second, second_final, stage, final, window),
        convex=_convex(controller, stage, final),
        residual=_residual(controller, stage, final, groups),
        merit=_merit(controller, groups),
        fallback=_at_stage(ca.Function("fallback", [now, q], [fallback]), window, 0),
        correct=_at_stage(correct, window, -1),
        predict=_at_stage(predict, window, 0),
        groups=groups,
    )


def _rate_rows(controller: Controller, u: Any, last: Any, lower: Any, upper: Any, rate: Any) -> Any:
    """Rows that are <= 0 when the rates are kept, as shares of the inputs' ranges.

    Where the bounds move away faster than the rate they win, so that an input that keeps these rows always exists.
    """
    own = list(controller.rated)
    if not own:
        return ca.SX(0, 1)
    span = _span(lower, upper)[own]
    above = u[own] - ca.fmax(last[own] + rate, lower[own])
    below = ca.fmin(last[own] - rate, upper[own]) - u[own]
    return ca.vertcat(above / span, below / span)


def _at_stage(function: ca.Function, window: _Window, stage: int) -> ca.Function:
    """A function whose last argument is what a stage reads of q, as one of the whole q."""
    if not window.signals:
        return function
    *arguments, _ = function.mx_in()
    q = ca.MX.sym("q", window.length)
    return ca.Function(function.name(), [*arguments, q], list(function.call([*arguments, window.at(q, stage)])))


def _bounds(controller: Controller, bound: ca.Function, window: _Window) -> tuple[ca.Function, ca.Function]:
    """`Problem.bounds` and `Problem.clip` from (now, q of a stage) -> (lower, upper, rate)."""
    horizon, nu, nz = controller.horizon, len(controller.model.inputs), bound.size1_in(0)
    now, q, inputs = ca.MX.sym("now", nz), ca.MX.sym("q", window.length), ca.MX.sym("U", horizon * nu)
    stages = [bound(now, window.at(q, i)) for i in range(horizon if window.signals else 1)] * (1 if window.signals else horizon)
    nx = nz - len(controller.carried)
    last = ca.MX.zeros(nu)
    for k, i in enumerate(controller.carried):
        last[i] = now[nx + k]
    lowers, uppers, clipped = [], [], []
    for i, (u, (low, high, rate)) in enumerate(zip(ca.vertsplit(inputs, nu), stages, strict=True)):
        least, most = ca.MX(low), ca.MX(high)
        for k, j in enumerate(controller.rated):
            least[j] = ca.fmin(ca.fmax(low[j], last[j] - rate[k]), high[j])
            most[j] = ca.fmax(ca.fmin(high[j], last[j] + rate[k]), low[j])
        # From the second stage on the rate is a row of the problem: what the input may be depends on the one before.
        lowers.append(least if i == 0 else low)
        uppers.append(most if i == 0 else high)
        last = ca.fmin(ca.fmax(u, least), most)
        clipped.append(last)
    bounds = ca.Function("bounds", [now, q], [ca.vertcat(*lowers), ca.vertcat(*uppers)])
    return bounds, ca.Function("clip", [now, inputs, q], [ca.vertcat(*clipped)])


def _cse(*expressions: Any) -> list[Any]:
    return list(ca.cse([ca.densify(e) for e in expressions]))


def _group(controller: Controller, *places: str) -> list[int]:
    return [j for j, limit in enumerate(controller.limits) if limit.at in places for _ in range(limit.rows.size1_out(0))]


@dataclass(frozen=True)
class _Bend:
    """Second derivatives of costate' f + multipliers' c with respect to (x, u), as far as the solver uses them."""

    costate: Any
    multipliers: Any
    hessian: Any

    @classmethod
    def of(cls, x: Any, u: Any, after: Any, rows: Any, *, exact: bool) -> _Bend:
        costate, multipliers = ca.SX.sym("costate", after.shape[0]), ca.SX.sym("lambda", rows.shape[0])
        total = ca.dot(costate, after) + ca.dot(multipliers, rows)
        if exact:
            # Dense, since a convex one nearby has more entries.
            return cls(costate, multipliers, ca.densify(ca.hessian(total, ca.vertcat(x, u))[0]))
        positive = ca.fmax(ca.diag(ca.densify(ca.hessian(total, u)[0])), 0)
        nx, nu = x.shape[0], u.shape[0]
        return cls(costate, multipliers, ca.diagcat(ca.SX(nx, nx), ca.diag(positive)) if nu else ca.SX(nx, nx))


@dataclass(frozen=True)
class _Linearisation:
    """Derivatives of one stage with respect to (x, u), as the non-zeros of sparse matrices packed in one vector."""

    packed: Any
    patterns: tuple[ca.Sparsity, ...]

    @classmethod
    def of(cls, x: Any, u: Any, after: Any, cost: Any, rows: Any, bend: _Bend) -> _Linearisation:
        """The Hessians' patterns have room for what ``bend`` adds later."""
        xu = ca.vertcat(x, u)
        curvature, slope = ca.hessian(cost, xu)
        nx = x.shape[0]
        slope_x, slope_u = split(slope, (nx, u.shape[0]))
        parts = [ca.jacobian(after, x), ca.jacobian(after, u), ca.jacobian(rows, x), ca.jacobian(rows, u), slope_x, slope_u]
        parts = [ca.sparsify(part) for part in parts]
        pairs = zip(_hessians(ca.sparsify(curvature), nx), _hessians(bend.hessian, nx), strict=True)
        parts += [ca.project(one, one.sparsity() + two.sparsity()) for one, two in pairs]
        return cls(ca.vertcat(*(ca.vertcat(*part.nonzeros()) for part in parts)), tuple(part.sparsity() for part in parts))

    def bent(self, bend: _Bend) -> Any:
        """What ``bend`` adds to the packed vector."""
        nx = self.patterns[6].size1()
        parts = [ca.project(one, pattern) for one, pattern in zip(_hessians(bend.hessian, nx), self.patterns[6:], strict=True)]
        kept = ca.SX(ca.DM.zeros(sum(pattern.nnz() for pattern in self.patterns[:6])))
        return ca.vertcat(kept, *(ca.vertcat(*part.nonzeros()) for part in parts))

    @property
    def length(self) -> int:
        return sum(pattern.nnz() for pattern in self.patterns)

    def unpack(self, vector: Any) -> list[Any]:
        """[f_x, f_u, c_x, c_u, l_x, l_u, l_xx, l_ux, l_uu] from the packed vector."""
        pieces = split(vector, (pattern.nnz() for pattern in self.patterns))
        return [ca.SX(pattern, piece) for pattern, piece in zip(self.patterns, pieces, strict=True)]


def _hessians(matrix: Any, nx: int) -> list[Any]:
    """[xx, ux, uu] of the Hessian with respect to (x, u)."""
    return [matrix[:nx, :nx], matrix[nx:, :nx], matrix[nx:, nx:]]


def _sweep(stage: ca.Function, final: ca.Function, nx: int, nu: int, window: _Window) -> ca.Function:
    horizon = window.horizon
    now, inputs, q = ca.MX.sym("now", nx), ca.MX.sym("U", horizon * nu), ca.MX.sym("q", window.length)
    x, cost, rows, derivatives = now, ca.MX(0.0), [], []
    for i, u in enumerate(ca.vertsplit(inputs, nu)):
        x, stage_cost, row, packed = stage(x, u, now, window.at(q, i), row_weight(i, horizon))
        cost = cost + stage_cost
        rows.append(row)
        derivatives.append(packed)
    final_cost, row, packed = final(x, now, window.at(q, horizon))
    return ca.Function("sweep", [now, inputs, q], [cost + final_cost, ca.vertcat(*rows, row), ca.vertcat(*derivatives, packed)])


def _violations(controller: Controller, groups: tuple[int, ...], rows: Any) -> list[Any]:
    """s_j / scale_j, the largest violation of each limit over the horizon, at least 0."""
    worst: list[Any] = [0.0] * len(controller.limits)
    for i, j in _soft(groups):
        worst[j] = ca.if_else(rows[i] > worst[j], rows[i], worst[j])
    return worst


def _soft(groups: tuple[int, ...]) -> list[tuple[int, int]]:
    """(row, limit) of the rows that have a slack."""
    return [(i, j) for i, j in enumerate(groups) if j >= 0]


def _merit(controller: Controller, groups: tuple[int, ...]) -> ca.Function:
    cost, rows = ca.SX.sym("J"), ca.SX.sym("c", len(groups))
    merit = cost
    for limit, s in zip(controller.limits, _violations(controller, groups, rows), strict=True):
        merit += limit.penalty * limit.scale * (s + s**2 / 2)
    # The running maximum drops a NaN; the sum keeps it, so that the line search refuses the point.
    known = finite(ca.sum1(rows)) if groups else 1
    return ca.Function("merit", [cost, rows], [ca.if_else(known, merit, np.inf)])


def _span(lower: Any, upper: Any) -> Any:
    return ca.fmax(upper - lower, 1e-9 * (1 + ca.fabs(upper)))


def _blocks(vector: Any, size: int) -> list[Any]:
    return list(ca.vertsplit(vector, size)) if vector.shape[0] else []


def _derivatives(vector: Any, stage: _Linearisation, final: _Linearisation, horizon: int) -> tuple[list[list[Any]], list[Any]]:
    *stages, last = split(vector, (*[stage.length] * horizon, final.length))
    return [stage.unpack(one) for one in stages], final.unpack(last)


def _curvature(
    follow: ca.Function, second: ca.Function, second_final: ca.Function, stage: _Linearisation, final: _Linearisation, window: _Window
) -> ca.Function:
    nx, nu, width, horizon = follow.size1_in(0), follow.size1_in(1), second.size1_in(6), window.horizon
    own, last = ca.SX.sym("D", stage.length), ca.SX.sym("D", final.length)
    ahead, mu = ca.SX.sym("costate", nx), ca.SX.sym("lambda", width)
    f_x, _, c_x, _, l_x, *_ = stage.unpack(own)
    *_, final_x, _, final_slope, _, _, _, _ = final.unpack(last)
    mu_last = ca.SX.sym("lambda", final_x.shape[0])
    back = ca.Function("back", [own, ahead, mu], _cse(l_x + ca.mtimes(c_x.T, mu) + ca.mtimes(f_x.T, ahead)))
    end = ca.Function("end", [last, mu_last], _cse(final_slope + ca.mtimes(final_x.T, mu_last)))

    now, inputs, q = ca.MX.sym("now", nx), ca.MX.sym("U", horizon * nu), ca.MX.sym("q", window.length)
    vector = ca.MX.sym("D", horizon * stage.length + final.length)
    multipliers = ca.MX.sym("lambda", horizon * width + final_x.shape[0])
    controls = split(inputs, [nu] * horizon)
    *derivatives, last_derivatives = split(vector, (*[stage.length] * horizon, final.length))
    *prices, last_price = split(multipliers, (*[width] * horizon, final_x.shape[0]))
    states = [now]
    for i, u in enumerate(controls):
        states.append(follow(states[-1], u, window.at(q, i)))
    costate = end(last_derivatives, last_price)
    out: list[Any] = [last_derivatives + second_final(states[-1], now, window.at(q, horizon), last_price)]
    for i in reversed(range(horizon)):
        bent = second(states[i], controls[i], now, window.at(q, i), row_weight(i, horizon), costate, prices[i])
        out.insert(0, derivatives[i] + bent)
        costate = back(derivatives[i], costate, prices[i])
    return ca.Function("curvature", [now, inputs, vector, multipliers, q], [ca.vertcat(*out)])


def _quadratic(controller: Controller, stage: _Linearisation, final: _Linearisation, groups: tuple[int, ...]) -> ca.Function:
    """The QP by a Riccati recursion, in coordinates that make its Hessian the identity.

    With B = f_u range, stage Hessians [Q C'; C R] times gamma and P the cost to go, backwards

        r'r = R + B'P B,   h = r^-T (C + B'P A),   P <- Q + A'P A - h'h,   g = r^-T (l_u + B'p),   p <- l_x + A'p - h'g

    the cost is sum_i |e_i|^2 / 2 + g_i'e_i with e_i = r v_i + h dx_i. Forwards v_i = r^-1 (e_i - h dx_i) makes the bounds
    and rows lower triangular in e. That costs N^2 operations where condensing and factorising the Hessian costs N^3.
    """
    horizon, limits = controller.horizon, controller.limits
    nu = len(controller.model.inputs)
    size = horizon * nu
    inputs, lower, upper = (ca.SX.sym(n, size) for n in ("U", "lower", "upper"))
    rows, vector = ca.SX.sym("c", len(groups)), ca.SX.sym("D", horizon * stage.length + final.length)
    gamma = ca.SX.sym("gamma")
    stages, last = _derivatives(vector, stage, final, horizon)
    span = _span(lower, upper)
    ranges = [ca.diag(block) for block in _blocks(span, nu)]
    near = _proximal(gamma, *_steepness(stages, last, ranges))
    costate, weight = gamma * last[4], gamma * last[6]
    gradient: list[Any] = []
    laws: list[tuple[Any, Any]] = []
    for scale, (f_x, f_u, _, _, l_x, l_u, l_xx, l_ux, l_uu) in zip(reversed(ranges), reversed(stages), strict=True):
        into = ca.mtimes(f_u, scale)
        ahead = ca.mtimes(into.T, weight)
        block = ca.mtimes([scale, gamma * l_uu, scale]) + ca.mtimes(ahead, into) + (REGULARISATION + near) * ca.SX.eye(nu)
        inverse = ca.solve(_factor(ca.densify(block)), ca.SX.eye(nu))
        law = ca.mtimes(inverse.T, gamma * ca.mtimes(scale, l_ux) + ca.mtimes(ahead, f_x))
        slope = ca.mtimes(inverse.T, gamma * ca.mtimes(scale, l_u) + ca.mtimes(into.T, costate))
        costate = gamma * l_x + ca.mtimes(f_x.T, costate) - ca.mtimes(law.T, slope)
        weight = gamma * l_xx + ca.mtimes([f_x.T, weight, f_x]) - ca.mtimes(law.T, law)
        gradient.insert(0, slope)
        laws.insert(0, (inverse, law))

    # states[k]: sensitivity of the state to block k of e.
    states: list[Any] = []
    bounds, jacobian = [], []
    for i, (scale, (inverse, law), (f_x, f_u, c_x, c_u, *_)) in enumerate(zip(ranges, laws, stages, strict=True)):
        moves = [*(-ca.mtimes(inverse, ca.mtimes(law, s)) for s in states), inverse]
        into, seen = ca.mtimes(f_u, scale), ca.mtimes(c_u, scale)
        states.append(ca.SX(f_x.shape[0], nu))
        bounds.append(ca.horzcat(*moves, ca.SX(nu, size - (i + 1) * nu)))
        jacobian.append(
            ca.horzcat(
                *(ca.mtimes(c_x, s) + ca.mtimes(seen, m) for s, m in zip(states, moves, strict=True)),
                ca.SX(c_x.shape[0], size - (i + 1) * nu),
            )
        )
        states = [ca.mtimes(f_x, s) + ca.mtimes(into, m) for s, m in zip(states, moves, strict=True)]
    jacobian.append(ca.horzcat(*(ca.mtimes(last[2], s) for s in states)))

    root = ca.sqrt(gamma * ca.vertcat(*(limit.penalty * limit.scale for limit in limits))) if limits else ca.SX(0, 1)
    slacks = ca.SX(size + len(groups), len(limits))
    for i, j in _soft(groups):
        slacks[size + i, j] = -1 / root[j]
    data = [
        ca.vertcat(root, *gradient),
        ca.horzcat(slacks, ca.vertcat(*bounds, *jacobian)).T,
        ca.vertcat((lower - inputs) / span, ca.SX(ca.DM(np.full(len(groups), -np.inf)))),
        ca.vertcat((upper - inputs) / span, -rows),
        span,
    ]
    return ca.Function("quadratic", [inputs, rows, vector, lower, upper, gamma], _cse(*data))


def _convex(controller: Controller, stage: _Linearisation, final: _Linearisation) -> ca.Function:
    """`Problem.convex`: the Riccati recursion has positive pivots where the whole Hessian is positive definite."""
    horizon, nu = controller.horizon, len(controller.model.inputs)
    lower, upper = (ca.SX.sym(n, horizon * nu) for n in ("lower", "upper"))
    vector = ca.SX.sym("D", horizon * stage.length + final.length)
    if controller.hessian != "exact":
        return ca.Function("convex", [vector, lower, upper], [vector])
    stages, last = _derivatives(vector, stage, final, horizon)
    weight, smallest, largest = last[6], ca.SX(np.inf), ca.SX(0)
    for span, (f_x, f_u, _, _, _, _, l_xx, l_ux, l_uu) in zip(reversed(_blocks(_span(lower, upper), nu)), reversed(stages), strict=True):
        scale = ca.diag(span)
        into = ca.mtimes(f_u, scale)
        ahead = ca.mtimes(into.T, weight)
        rest = ca.densify(ca.mtimes([scale, l_uu, scale]) + ca.mtimes(ahead, into))
        law = ca.densify(ca.mtimes(scale, l_ux) + ca.mtimes(ahead, f_x))
        weight = l_xx + ca.mtimes([f_x.T, weight, f_x])
        for k in range(nu):
            smallest, largest = ca.fmin(smallest, rest[k, k]), ca.fmax(largest, rest[k, k])
            pivot, below, row = rest[k, k], rest[:, k], law[k, :]
            weight -= ca.mtimes(row.T, row) / pivot
            law -= ca.mtimes(below, row) / pivot
            rest -= ca.mtimes(below, below.T) / pivot
    sound = smallest > REGULARISATION * largest
    nx = stage.patterns[6].size1()
    changed = ca.vertcat(*(_nearby(stage, one, nx) for one in stages), _nearby(final, last, nx))
    as_it_is = ca.Function("as_it_is", [vector], [vector])
    nearby = ca.Function("nearby", [vector], _cse(changed))
    definite = ca.Function("definite", [vector, lower, upper], _cse(sound))
    choose = ca.Function.if_else("choose", as_it_is, nearby)
    given = [ca.MX.sym("D", vector.shape[0]), ca.MX.sym("lower", horizon * nu), ca.MX.sym("upper", horizon * nu)]
    return ca.Function("convex", given, [choose(definite(*given), given[0])])


def _nearby(of: _Linearisation, parts: list[Any], nx: int) -> Any:
    *kept, l_xx, l_ux, l_uu = parts
    matrix = nearby_convex(ca.vertcat(ca.horzcat(l_xx, l_ux.T), ca.horzcat(l_ux, l_uu)))
    changed = [*kept, *(ca.project(one, pattern) for one, pattern in zip(_hessians(matrix, nx), of.patterns[6:], strict=True))]
    return ca.vertcat(*(ca.vertcat(*part.nonzeros()) for part in changed))


def _factor(block: Any) -> Any:
    """Upper triangular r with r'r = block; where the block is not positive definite a pivot is taken as if it were bent upwards."""
    size = block.shape[0]
    r, rest = ca.SX(size, size), ca.SX(block)
    for k in range(size):
        pivot = rest[k, k]
        pivot = ca.sqrt(ca.if_else(pivot >= REGULARISATION, pivot, ca.fmax(-pivot, LEAST_PIVOT)))
        r[k, k] = pivot
        for j in range(k + 1, size):
            r[k, j] = rest[k, j] / pivot
        for i in range(k + 1, size):
            for j in range(k + 1, size):
                rest[i, j] -= r[k, i] * r[k, j]
    return ca.triu(r)


def _scaling(controller: Controller, stage: _Linearisation, final: _Linearisation) -> ca.Function:
    """(D, lower, upper) -> gamma = 1 / max(mean of the scaled Hessian's diagonal, FLAT times that of the scaled gradient)."""
    horizon, nu = controller.horizon, len(controller.model.inputs)
    lower, upper = (ca.SX.sym(n, horizon * nu) for n in ("lower", "upper"))
    vector = ca.SX.sym("D", horizon * stage.length + final.length)
    ranges = [ca.diag(block) for block in _blocks(_span(lower, upper), nu)]
    curvature, steep = _steepness(*_derivatives(vector, stage, final, horizon), ranges)
    gamma = 1 / ca.fmax(ca.fmax(curvature, FLAT * steep), 1e-12)
    return ca.Function("scaling", [vector, lower, upper], _cse(gamma))


def _proximal(gamma: Any, curvature: Any, steep: Any) -> Any:
    """The proximal term that takes the place of a curvature that is missing: nothing where the mean curvature is not flat."""
    return ca.if_else(curvature < FLAT * steep, 1 - gamma * ca.fmax(curvature, 0), 0)


def _steepness(stages: list[list[Any]], last: list[Any], ranges: list[Any]) -> tuple[Any, Any]:
    """Means over the inputs of the scaled Hessian's diagonal and of the scaled gradient's size."""
    costate, weight, total, steep = last[4], last[6], ca.SX(0), ca.SX(0)
    for scale, (f_x, f_u, _, _, l_x, l_u, l_xx, _, l_uu) in zip(reversed(ranges), reversed(stages), strict=True):
        total += ca.trace(ca.densify(ca.mtimes([scale, l_uu + ca.mtimes([f_u.T, weight, f_u]), scale])))
        steep += ca.sum1(ca.fabs(ca.mtimes(scale, l_u + ca.mtimes(f_u.T, costate))))
        weight = l_xx + ca.mtimes([f_x.T, weight, f_x])
        costate = l_x + ca.mtimes(f_x.T, costate)
    count = sum(scale.shape[0] for scale in ranges)
    return total / count, steep / count


def _residual(controller: Controller, stage: _Linearisation, final: _Linearisation, groups: tuple[int, ...]) -> ca.Function:
    """Natural residual at U with multipliers lambda >= 0 of the rows (all in the scaled problem).

    stationarity      clip(-range gamma (g + A' lambda), (lower - U) / range, (upper - U) / range) is zero
    complementarity   min(lambda_i, s_j - c_i) is zero with s_j = max(0, max c_i): an unused row has no multiplier
    exactness         min(s_j, 1 + s_j - sum lambda / w_j) is zero: a violation only where the penalty is spent
    """
    horizon, nu = controller.horizon, len(controller.model.inputs)
    size = horizon * nu
    inputs, lower, upper = (ca.SX.sym(n, size) for n in ("U", "lower", "upper"))
    rows, multipliers, gamma = ca.SX.sym("c", len(groups)), ca.SX.sym("lambda", len(groups)), ca.SX.sym("gamma")
    vector = ca.SX.sym("D", horizon * stage.length + final.length)
    stages, last = _derivatives(vector, stage, final, horizon)
    span, width = _span(lower, upper), stages[0][2].shape[0]

    *prices, last_price = split(multipliers, (*[width] * horizon, last[2].shape[0]))
    costate = gamma * last[4] + ca.mtimes(last[2].T, last_price)
    slopes: list[Any] = []
    for i in reversed(range(horizon)):
        f_x, f_u, c_x, c_u, l_x, l_u, *_ = stages[i]
        slopes.insert(0, gamma * l_u + ca.mtimes(c_u.T, prices[i]) + ca.mtimes(f_u.T, costate))
        costate = gamma * l_x + ca.mtimes(c_x.T, prices[i]) + ca.mtimes(f_x.T, costate)
    slope = ca.densify(ca.vertcat(*slopes)) * span
    residuals = [ca.fabs(_least(_greatest(-slope, (lower - inputs) / span), (upper - inputs) / span))]
    for j, (limit, s) in enumerate(zip(controller.limits, _violations(controller, groups, rows), strict=True)):
        own_rows = [i for i, group in enumerate(groups) if group == j]
        residuals += [ca.fabs(_least(multipliers[i], s - rows[i])) for i in own_rows]
        # Relative to the price, which is so large that its rounding alone would exceed the tolerance.
        spent = sum((multipliers[i] for i in own_rows), ca.SX(0)) / (gamma * limit.scale * limit.penalty)
        residuals.append(ca.fabs(_least(s, 1 + s - spent)))
    residuals += [ca.fabs(_least(multipliers[i], -rows[i])) for i, group in enumerate(groups) if group < 0]
    everything = ca.vertcat(*residuals)
    worst: Any = 0.0
    for k in range(everything.shape[0]):
        worst = _greatest(worst, everything[k])
    # A maximum drops a NaN; the sum keeps it.
    worst = ca.if_else(finite(ca.sum1(everything)), worst, np.inf)
    return ca.Function("residual", [inputs, rows, vector, multipliers, gamma, lower, upper], _cse(worst))


def _least(a: Any, b: Any) -> Any:
    return ca.if_else(a < b, a, b)


def _greatest(a: Any, b: Any) -> Any:
    return ca.if_else(a > b, a, b)
