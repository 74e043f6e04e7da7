"""The controller's problem, discretised, condensed and scaled, as CasADi functions of run-time values only.

The states are eliminated (single shooting); the inputs U remain, one for each block of intervals in which it is held.
``sweep`` rolls the model out and linearises it stage by stage; ``quadratic`` condenses that to a dense QP for the scaled
step v = (U+ - U) / range and the scaled slacks; ``residual`` measures optimality from the same linearisation without
condensing it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from chargetune.control.condensing import convex, operations, quadratic, scaling, span_of
from chargetune.control.controller import Controller
from chargetune.control.layout import Layout
from chargetune.control.linearisation import Bend, Linearisation, dense, straight
from chargetune.control.optimality import adjoint, curvature, merit, residual
from chargetune.control.window import Window
from chargetune.runtime.split import split

__all__ = ["Problem", "control_problem", "row_weight"]

# Up to so many multiplications the functions of the whole horizon are straight-line code, where loops and calls take 1.15 to 1.4
# times as long. Beyond they are as quick (0.94 at 40 000), and straight-line code takes a compiler 1.5 s for each 1000.
STRAIGHT_MAX = 20_000


@dataclass(frozen=True)
class Problem:
    """A controller as CasADi functions.

    prepare
        (theta, setpoint, p_nominal) -> q, everything that is fixed over an episode (spline coefficients, weights):
        no other function sees theta or p. Where there are given signals the q of the others is this one and below it
        the signals over the horizon, a row of `model.given.windows` (`control_step.numbers`).
    bounds
        (now, q) -> (lower, upper), the input bounds at the start of each block, shapes (size,). ``now`` is the estimate and below it
        the last values of the inputs that are `Controller.carried`; it is the first state of the horizon.
    clip
        (now, U, q) -> the inputs nearest to U, one after the other, that keep bounds and rates.
    sweep
        (now, U, q) -> (J, c, D): cost, scaled and weighted rows c(U) <= s, and the stages' derivatives packed in a vector.
    scaling
        (D, lower, upper) -> (gamma, near): with gamma the mean of the scaled Hessian's diagonal is one; near is what it
        lacks where the cost has hardly a curvature, else 0.
    quadratic
        (U, c, D, lower, upper, gamma, near) -> (g, A', lba, uba, span): the QP of `control.qp`, one slack a limit. Its first
        rows, as many as inputs, are v = dU / span between the bounds, then c + dc less the slack; the cost is gamma J.
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
    layout
        Which numbers of U and c belong together.
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
    layout: Layout

    @property
    def size(self) -> int:
        """Number of decision variables, nu a block."""
        return self.layout.size

    @property
    def groups(self) -> tuple[int, ...]:
        """For each row the index of its limit, -1 for a hard one."""
        return self.layout.groups

    @property
    def row_width(self) -> int:
        """Rows of c in one stage; the terminal rows follow after the last stage."""
        return len(self.layout.stage_groups)

    def first(self, estimate: ArrayLike, last: ArrayLike) -> NDArray[np.float64]:
        """``now`` of an estimated state and the last input."""
        return np.concatenate([np.asarray(estimate, dtype=np.float64), np.asarray(last, dtype=np.float64)[list(self.controller.carried)]])


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
    found = ca.extract_parametric(dense(*expressions), ca.vertcat(theta, setpoint, nominal), {"extract_trivial": True})
    expressions, symbols, values = found
    fixed = ca.vertcat(*symbols) if symbols else ca.SX(0, 1)
    prepared = ca.cse(ca.vertcat(*values)) if values else ca.SX(0, 1)
    after, stage_cost, stage_rows, final_cost, final_rows, lower, upper, rate, fallback, x_hat, corrected, predicted = expressions
    q, window = ca.vertcat(fixed, given, given_end), Window(fixed.shape[0], ng, horizon)

    weight = ca.SX.sym("weight")
    stage_rows = stage_rows * weight
    final_rows = final_rows * row_weight(horizon, horizon)
    exact, nothing = controller.hessian == "exact", ca.SX(0, 1)
    bend, bend_final = Bend.of(z, u, after, stage_rows, exact=exact), Bend.of(z, nothing, nothing, final_rows, exact=exact)
    stage, stage_packed = Linearisation.of(z, u, after, stage_cost, stage_rows, bend)
    final, final_packed = Linearisation.of(z, nothing, nothing, final_cost, final_rows, bend_final)
    seconds = (
        ca.Function("second", [z, u, now, q, weight, bend.costate, bend.multipliers], dense(stage.bent(bend))),
        ca.Function("second_final", [z, now, q, bend_final.multipliers], dense(final.bent(bend_final))),
    )
    hard = (-1,) * (2 * len(controller.rated))
    layout = Layout(
        nu=nu,
        blocks=controller.input_blocks,
        stage_groups=(*_group(controller, "start", "both"), *_group(controller, "end", "both"), *hard),
        final_groups=_group(controller, "terminal"),
        prices=tuple(limit.penalty * limit.scale for limit in limits),
    )
    packed_stage = ca.Function("stage", [z, u, now, q, weight], dense(after, stage_cost, stage_rows, stage_packed))
    follow = ca.Function("follow", [z, u, q], dense(after))
    packed_final = ca.Function("final", [z, now, q], dense(final_cost, final_rows, final_packed))
    bounds, clip = _bounds(controller, layout, ca.Function("bound", [now, q], dense(lower, upper, rate)), window)
    # The measurement belongs to the end of the interval before.
    correct = ca.Function("correct", [memory, y, u, q], dense(x_hat, corrected))
    predict = ca.Function("predict", [x, memory, u, q], dense(predicted))
    short = operations(layout, stage) <= STRAIGHT_MAX

    def lean(function: ca.Function) -> ca.Function:
        return straight(function) if short else function

    adjoints = adjoint(stage, final)
    return Problem(
        controller=controller,
        prepare=ca.Function("prepare", [theta, setpoint, nominal], [prepared]),
        bounds=bounds,
        clip=clip,
        sweep=_sweep(layout, packed_stage, packed_final, window, stage.at_start),
        scaling=lean(scaling(layout, stage, final)),
        quadratic=lean(quadratic(layout, stage, final)),
        curvature=curvature(layout, [row_weight(i, horizon) for i in range(horizon)], follow, seconds, adjoints, window, stage.at_start),
        convex=convex(layout, stage, final, exact=exact),
        residual=lean(residual(layout, adjoints)),
        merit=lean(merit(layout)),
        fallback=window.of_stage(ca.Function("fallback", [now, q], [fallback]), 0),
        correct=window.of_stage(correct, -1),
        predict=window.of_stage(predict, 0),
        layout=layout,
    )


def _rate_rows(controller: Controller, u: Any, last: Any, lower: Any, upper: Any, rate: Any) -> Any:
    """Rows that are <= 0 when the rates are kept, as shares of the inputs' ranges.

    Where the bounds move away faster than the rate they win, so that an input that keeps these rows always exists.
    """
    own = list(controller.rated)
    if not own:
        return ca.SX(0, 1)
    span = span_of(lower, upper)[own]
    above = u[own] - ca.fmax(last[own] + rate, lower[own])
    below = ca.fmin(last[own] - rate, upper[own]) - u[own]
    # fmax and fmin drop a rate that is no number.
    return ca.vertcat(*(ca.if_else(rate >= 0, row / span, np.nan) for row in (above, below)))


def _bounds(controller: Controller, layout: Layout, bound: ca.Function, window: Window) -> tuple[ca.Function, ca.Function]:
    """`Problem.bounds` and `Problem.clip` from (now, q of a stage) -> (lower, upper, rate)."""
    nu, nz = layout.nu, bound.size1_in(0)
    now, q, inputs = ca.MX.sym("now", nz), ca.MX.sym("q", window.length), ca.MX.sym("U", layout.size)
    firsts = [sum(layout.blocks[:k]) for k in range(len(layout.blocks))]
    stages = [bound(now, window.at(q, i)) for i in firsts] if window.signals else [bound(now, q)] * len(firsts)
    nx = nz - len(controller.carried)
    last = ca.MX.zeros(nu)
    for k, i in enumerate(controller.carried):
        last[i] = now[nx + k]
    lowers, uppers, clipped = [], [], []
    for i, (u, (low, high, rate)) in enumerate(zip(split(inputs, [nu] * len(firsts)), stages, strict=True)):
        least, most = ca.MX(low), ca.MX(high)
        told_least, told_most = ca.MX(low), ca.MX(high)
        for k, j in enumerate(controller.rated):
            least[j] = ca.fmin(ca.fmax(low[j], last[j] - rate[k]), high[j])
            most[j] = ca.fmax(ca.fmin(high[j], last[j] + rate[k]), low[j])
            # What is applied keeps the bounds even where the rate is no number; solved such a problem is not.
            told_least[j], told_most[j] = (ca.if_else(rate[k] >= 0, bound, np.nan) for bound in (least[j], most[j]))
        # From the second block on the rate is a row of the problem: what the input may be depends on the one before.
        lowers.append(told_least if i == 0 else low)
        uppers.append(told_most if i == 0 else high)
        last = ca.fmin(ca.fmax(u, least), most)
        clipped.append(last)
    bounds = ca.Function("bounds", [now, q], [ca.vertcat(*lowers), ca.vertcat(*uppers)])
    return bounds, ca.Function("clip", [now, inputs, q], [ca.vertcat(*clipped)])


def _group(controller: Controller, *places: str) -> tuple[int, ...]:
    return tuple(j for j, limit in enumerate(controller.limits) if limit.at in places for _ in range(limit.rows.size1_out(0)))


def _sweep(layout: Layout, stage: ca.Function, final: ca.Function, window: Window, at_start: ca.Function) -> ca.Function:
    now, inputs, q = ca.MX.sym("now", stage.size1_in(0)), ca.MX.sym("U", layout.size), ca.MX.sym("q", window.length)
    x, cost, rows, derivatives = now, ca.MX(0.0), [], []
    for i, u in enumerate(layout.inputs(inputs)):
        x, stage_cost, row, packed = stage(x, u, now, window.at(q, i), row_weight(i, layout.horizon))
        cost = cost + stage_cost
        rows.append(row)
        derivatives.append(packed if i else at_start(packed))
    final_cost, row, packed = final(x, now, window.at(q, layout.horizon))
    return ca.Function("sweep", [now, inputs, q], [cost + final_cost, ca.vertcat(*rows, row), ca.vertcat(*derivatives, packed)])
