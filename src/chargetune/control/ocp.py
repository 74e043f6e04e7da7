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

from chargetune.control.controller import Controller
from chargetune.control.estimators import finite
from chargetune.runtime.split import split

__all__ = ["Problem", "control_problem", "row_weight"]

# Least curvature of an input relative to the mean; only the steps depend on it, not the solution.
REGULARISATION = 1e-8


@dataclass(frozen=True)
class Problem:
    """A controller as CasADi functions.

    prepare
        (theta, setpoint, p_nominal) -> q, everything that is fixed over an episode (spline coefficients, weights):
        no other function sees theta or p.
    bounds
        (now, q) -> (lower, upper), the input bounds repeated over the horizon, shapes (N nu,).
    sweep
        (now, U, q) -> (J, c, D): cost, scaled and weighted rows c(U) <= s, and the stages' derivatives packed in a vector.
    quadratic
        (U, c, D, lower, upper, W) -> (g, A', lba, uba, span, gamma): the QP of `control.qp`, one slack a limit. Its first
        N nu rows are v = dU / span between the bounds, then c + dc less the slack; the cost is gamma J, and W, shape (N nu,),
        is added to the diagonal of the stages' input Hessians.
    curvature
        (now, U, D, multipliers, lower, upper, q) -> W: what constraints and dynamics add to that diagonal in the
        Lagrangian, where it is positive.
    residual
        (U, c, D, multipliers, gamma, lower, upper) -> largest natural residual of the scaled optimality conditions.
    merit
        (J, c) -> phi, the cost with its exact penalties.
    fallback
        (now, q) -> input, shape (nu,), before clipping.
    correct, predict
        The estimator: (memory, y, u, q) -> (x_hat, memory); (x_hat, memory, u, q) -> memory.
    groups
        For each row the index of its limit.
    """

    controller: Controller
    prepare: ca.Function
    bounds: ca.Function
    sweep: ca.Function
    quadratic: ca.Function
    curvature: ca.Function
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
        return sum(limit.rows.size1_out(0) * (2 if limit.at == "both" else 1) for limit in self.controller.limits if limit.at != "terminal")


def row_weight(stage: int, horizon: int) -> float:
    """Weight of a violation at stage i in the slack s = max_i (1 + i / N) c_i.

    With equal weights a violation that cannot be avoided now would make all later ones as large free of charge, and a
    state once beyond its limit would stay there. Growing weights ask for half of it by the end of the horizon.
    """
    return 1.0 + stage / horizon


def control_problem(controller: Controller) -> Problem:
    """Turn a controller into CasADi functions."""
    model, horizon, limits = controller.model, controller.horizon, controller.limits
    nx, nu = len(model.states), len(model.inputs)
    x, u, now = ca.SX.sym("x", nx), ca.SX.sym("u", nu), ca.SX.sym("now", nx)
    theta, setpoint = ca.SX.sym("theta", controller.theta.dimension), ca.SX.sym("setpoint", nx + nu)
    nominal = ca.SX.sym("p", model.nominal.size)
    memory, y = (ca.SX.sym(name, controller.estimation.size1_in(i)) for i, name in ((1, "memory"), (2, "y")))

    p = controller.parameters(theta, nominal)
    after = model.f(x, u, p)
    no_input = ca.SX(ca.DM.zeros(nu))

    def rows(places: tuple[str, ...], state: Any, control: Any) -> Any:
        return ca.vertcat(*(limit.rows(state, control, theta, p, now) / limit.scale for limit in limits if limit.at in places))

    x_hat, corrected, predicted = controller.estimation(x, memory, y, u, p)
    expressions = [
        after,
        controller.stage_cost(x, u, theta, p, setpoint, now),
        ca.vertcat(rows(("start", "both"), x, u), rows(("end", "both"), after, u)),
        controller.terminal_cost(x, no_input, theta, p, setpoint, now),
        rows(("terminal",), x, no_input),
        controller.input_lower(theta, p, now),
        controller.input_upper(theta, p, now),
        controller.fallback(theta, p, now),
        x_hat,
        corrected,
        predicted,
    ]
    # Everything that depends on theta and p alone is computed once an episode instead of at every stage. What two of these expressions
    # share has to be one beforehand: two symbols for one number are not recognised any more.
    found = ca.extract_parametric(_cse(*expressions), ca.vertcat(theta, setpoint, nominal), {"extract_trivial": True})
    expressions, symbols, values = found
    q = ca.vertcat(*symbols) if symbols else ca.SX(0, 1)
    prepared = ca.cse(ca.vertcat(*values)) if values else ca.SX(0, 1)
    after, stage_cost, stage_rows, final_cost, final_rows, lower, upper, fallback, x_hat, corrected, predicted = expressions

    weight = ca.SX.sym("weight")
    stage_rows = stage_rows * weight
    final_rows = final_rows * row_weight(horizon, horizon)
    stage = _Linearisation.of(x, u, after, stage_cost, stage_rows)
    final = _Linearisation.of(x, ca.SX(0, 1), ca.SX(0, 1), final_cost, final_rows)
    groups = (*(_group(controller, "start", "both") + _group(controller, "end", "both")) * horizon, *_group(controller, "terminal"))
    packed_stage = ca.Function("stage", [x, u, now, q, weight], _cse(after, stage_cost, stage_rows, stage.packed))
    follow = ca.Function("follow", [x, u, q], _cse(after))
    packed_final = ca.Function("final", [x, now, q], _cse(final_cost, final_rows, final.packed))
    return Problem(
        controller=controller,
        prepare=ca.Function("prepare", [theta, setpoint, nominal], [prepared]),
        bounds=ca.Function("bounds", [now, q], [ca.repmat(lower, horizon, 1), ca.repmat(upper, horizon, 1)]),
        sweep=_sweep(packed_stage, packed_final, horizon, nx, nu, q.shape[0]),
        quadratic=_quadratic(controller, stage, final, groups),
        curvature=_curvature(follow, _second(x, u, now, q, weight, after, stage_rows), stage, final, horizon),
        residual=_residual(controller, stage, final, groups),
        merit=_merit(controller, groups),
        fallback=ca.Function("fallback", [now, q], [fallback]),
        correct=ca.Function("correct", [memory, y, u, q], _cse(x_hat, corrected)),
        predict=ca.Function("predict", [x, memory, u, q], _cse(predicted)),
        groups=groups,
    )


def _cse(*expressions: Any) -> list[Any]:
    return list(ca.cse([ca.densify(e) for e in expressions]))


def _group(controller: Controller, *places: str) -> list[int]:
    return [j for j, limit in enumerate(controller.limits) if limit.at in places for _ in range(limit.rows.size1_out(0))]


@dataclass(frozen=True)
class _Linearisation:
    """Derivatives of one stage with respect to (x, u), as the non-zeros of sparse matrices packed in one vector."""

    packed: Any
    patterns: tuple[ca.Sparsity, ...]

    @classmethod
    def of(cls, x: Any, u: Any, after: Any, cost: Any, rows: Any) -> _Linearisation:
        xu = ca.vertcat(x, u)
        curvature, slope = ca.hessian(cost, xu)
        nx = x.shape[0]
        slope_x, slope_u = split(slope, (nx, u.shape[0]))
        parts = [
            ca.jacobian(after, x), ca.jacobian(after, u), ca.jacobian(rows, x), ca.jacobian(rows, u),
            slope_x, slope_u, curvature[:nx, :nx], curvature[nx:, :nx], curvature[nx:, nx:],
        ]  # fmt: skip
        parts = [ca.sparsify(part) for part in parts]
        return cls(ca.vertcat(*(ca.vertcat(*part.nonzeros()) for part in parts)), tuple(part.sparsity() for part in parts))

    @property
    def length(self) -> int:
        return sum(pattern.nnz() for pattern in self.patterns)

    def unpack(self, vector: Any) -> list[Any]:
        """[f_x, f_u, c_x, c_u, l_x, l_u, l_xx, l_ux, l_uu] from the packed vector."""
        pieces = split(vector, (pattern.nnz() for pattern in self.patterns))
        return [ca.SX(pattern, piece) for pattern, piece in zip(self.patterns, pieces, strict=True)]


def _sweep(stage: ca.Function, final: ca.Function, horizon: int, nx: int, nu: int, nq: int) -> ca.Function:
    now, inputs, q = ca.MX.sym("now", nx), ca.MX.sym("U", horizon * nu), ca.MX.sym("q", nq)
    x, cost, rows, derivatives = now, ca.MX(0.0), [], []
    for i, u in enumerate(ca.vertsplit(inputs, nu)):
        x, stage_cost, row, packed = stage(x, u, now, q, row_weight(i, horizon))
        cost = cost + stage_cost
        rows.append(row)
        derivatives.append(packed)
    final_cost, row, packed = final(x, now, q)
    return ca.Function("sweep", [now, inputs, q], [cost + final_cost, ca.vertcat(*rows, row), ca.vertcat(*derivatives, packed)])


def _violations(controller: Controller, groups: tuple[int, ...], rows: Any) -> list[Any]:
    """s_j / scale_j, the largest violation of each limit over the horizon, at least 0."""
    worst: list[Any] = [0.0] * len(controller.limits)
    for i, j in enumerate(groups):
        worst[j] = ca.if_else(rows[i] > worst[j], rows[i], worst[j])
    return worst


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


def _second(x: Any, u: Any, now: Any, q: Any, weight: Any, after: Any, rows: Any) -> ca.Function:
    """(x, u, now, q, weight, costate, multipliers) -> positive part of the diagonal of d2/du2 (costate' f + multipliers' c)."""
    costate, multipliers = ca.SX.sym("costate", after.shape[0]), ca.SX.sym("lambda", rows.shape[0])
    total = ca.dot(costate, after) + ca.dot(multipliers, rows)
    bent = ca.diag(ca.densify(ca.hessian(total, u)[0]))
    return ca.Function("second", [x, u, now, q, weight, costate, multipliers], _cse(ca.fmax(bent, 0)))


def _curvature(follow: ca.Function, second: ca.Function, stage: _Linearisation, final: _Linearisation, horizon: int) -> ca.Function:
    nx, nu, nq, width = follow.size1_in(0), follow.size1_in(1), follow.size1_in(2), second.size1_in(6)
    own, last = ca.SX.sym("D", stage.length), ca.SX.sym("D", final.length)
    ahead, mu, gamma = ca.SX.sym("costate", nx), ca.SX.sym("lambda", width), ca.SX.sym("gamma")
    f_x, _, c_x, _, l_x, *_ = stage.unpack(own)
    *_, final_x, _, final_slope, _, _, _, _ = final.unpack(last)
    mu_last = ca.SX.sym("lambda", final_x.shape[0])
    back = ca.Function("back", [own, ahead, mu, gamma], _cse(gamma * l_x + ca.mtimes(c_x.T, mu) + ca.mtimes(f_x.T, ahead)))
    end = ca.Function("end", [last, mu_last, gamma], _cse(gamma * final_slope + ca.mtimes(final_x.T, mu_last)))

    low, high, whole = (
        ca.SX.sym("lower", horizon * nu),
        ca.SX.sym("upper", horizon * nu),
        ca.SX.sym("D", horizon * stage.length + final.length),
    )
    ranges = [ca.diag(block) for block in _blocks(_span(low, high), nu)]
    scaled = ca.Function("scaling", [whole, low, high], _cse(_scaling(*_derivatives(whole, stage, final, horizon), ranges)))

    now, inputs, q = ca.MX.sym("now", nx), ca.MX.sym("U", horizon * nu), ca.MX.sym("q", nq)
    vector, multipliers = ca.MX.sym("D", whole.shape[0]), ca.MX.sym("lambda", horizon * width + final_x.shape[0])
    lower, upper = ca.MX.sym("lower", horizon * nu), ca.MX.sym("upper", horizon * nu)
    scaling = scaled(vector, lower, upper)
    controls = split(inputs, [nu] * horizon)
    *derivatives, last_derivatives = split(vector, (*[stage.length] * horizon, final.length))
    *prices, last_price = split(multipliers, (*[width] * horizon, final_x.shape[0]))
    states = [now]
    for u in controls[:-1]:
        states.append(follow(states[-1], u, q))
    costate = end(last_derivatives, last_price, scaling)
    out: list[Any] = []
    for i in reversed(range(horizon)):
        out.insert(0, second(states[i], controls[i], now, q, row_weight(i, horizon), costate, prices[i]))
        costate = back(derivatives[i], costate, prices[i], scaling)
    return ca.Function("curvature", [now, inputs, vector, multipliers, lower, upper, q], [ca.vertcat(*out)])


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
    stages, last = _derivatives(vector, stage, final, horizon)
    span, bent = _span(lower, upper), ca.SX.sym("W", size)
    ranges, bends = ([ca.diag(block) for block in _blocks(vector, nu)] for vector in (span, bent))
    gamma = _scaling(stages, last, ranges)
    costate, weight = gamma * last[4], gamma * last[6]
    gradient: list[Any] = []
    laws: list[tuple[Any, Any]] = []
    for scale, bend, (f_x, f_u, _, _, l_x, l_u, l_xx, l_ux, l_uu) in zip(reversed(ranges), reversed(bends), reversed(stages), strict=True):
        into = ca.mtimes(f_u, scale)
        ahead = ca.mtimes(into.T, weight)
        block = ca.mtimes([scale, gamma * l_uu + bend, scale]) + ca.mtimes(ahead, into) + REGULARISATION * ca.SX.eye(nu)
        inverse = ca.solve(ca.chol(ca.densify(block)), ca.SX.eye(nu))
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
    for i, j in enumerate(groups):
        slacks[size + i, j] = -1 / root[j]
    data = [
        ca.vertcat(root, *gradient),
        ca.horzcat(slacks, ca.vertcat(*bounds, *jacobian)).T,
        ca.vertcat((lower - inputs) / span, ca.SX(ca.DM(np.full(len(groups), -np.inf)))),
        ca.vertcat((upper - inputs) / span, -rows),
        span,
        gamma,
    ]
    return ca.Function("quadratic", [inputs, rows, vector, lower, upper, bent], _cse(*data))


def _scaling(stages: list[list[Any]], last: list[Any], ranges: list[Any]) -> Any:
    """gamma, with which the mean of the scaled Hessian's diagonal is one."""
    weight, total = last[6], ca.SX(0)
    for scale, (f_x, f_u, _, _, _, _, l_xx, _, l_uu) in zip(reversed(ranges), reversed(stages), strict=True):
        total += ca.trace(ca.densify(ca.mtimes([scale, l_uu + ca.mtimes([f_u.T, weight, f_u]), scale])))
        weight = l_xx + ca.mtimes([f_x.T, weight, f_x])
    return 1 / ca.fmax(total / sum(scale.shape[0] for scale in ranges), 1e-12)


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
