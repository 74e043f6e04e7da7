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

from chargetune.control.condensing import operations, quadratic, scaling
from chargetune.control.controller import Controller
from chargetune.control.layout import Layout
from chargetune.control.linearisation import Linearisation, dense, straight
from chargetune.control.optimality import adjoint, curvature, merit, residual, second

__all__ = ["Problem", "control_problem", "row_weight"]

# Up to so many multiplications the functions of the whole horizon are straight-line code, where loops and calls take 1.15 to 1.4
# times as long. Beyond they are as quick (0.94 at 40 000), and straight-line code takes a compiler 1.5 s for each 1000.
STRAIGHT_MAX = 20_000


@dataclass(frozen=True)
class Problem:
    """A controller as CasADi functions.

    prepare
        (theta, setpoint, p_nominal) -> q, everything that is fixed over an episode (spline coefficients, weights):
        no other function sees theta or p.
    bounds
        (now, q) -> (lower, upper), the input bounds repeated over the horizon, shapes (size,).
    sweep
        (now, U, q) -> (J, c, D): cost, scaled and weighted rows c(U) <= s, and the stages' derivatives packed in a vector.
    quadratic
        (U, c, D, lower, upper, W) -> (g, A', lba, uba, span, gamma): the QP of `control.qp`, one slack a limit. Its first
        rows, as many as inputs, are v = dU / span between the bounds, then c + dc less the slack; the cost is gamma J, and
        W, shape (size,), is added to the diagonal of the blocks' input Hessians.
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
    layout
        Which numbers of U and c belong together.
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
    layout: Layout

    @property
    def size(self) -> int:
        """Number of decision variables, nu a block."""
        return self.layout.size

    @property
    def groups(self) -> tuple[int, ...]:
        """For each row the index of its limit."""
        return self.layout.groups

    @property
    def row_width(self) -> int:
        """Rows of c in one stage; the terminal rows follow after the last stage."""
        return len(self.layout.stage_groups)


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
    found = ca.extract_parametric(dense(*expressions), ca.vertcat(theta, setpoint, nominal), {"extract_trivial": True})
    expressions, symbols, values = found
    q = ca.vertcat(*symbols) if symbols else ca.SX(0, 1)
    prepared = ca.cse(ca.vertcat(*values)) if values else ca.SX(0, 1)
    after, stage_cost, stage_rows, final_cost, final_rows, lower, upper, fallback, x_hat, corrected, predicted = expressions

    weight = ca.SX.sym("weight")
    stage_rows = stage_rows * weight
    final_rows = final_rows * row_weight(horizon, horizon)
    stage, stage_packed = Linearisation.of(x, u, after, stage_cost, stage_rows)
    final, final_packed = Linearisation.of(x, ca.SX(0, 1), ca.SX(0, 1), final_cost, final_rows)
    layout = Layout(
        nu=nu,
        blocks=controller.input_blocks,
        stage_groups=(*_group(controller, "start", "both"), *_group(controller, "end", "both")),
        final_groups=_group(controller, "terminal"),
        prices=tuple(limit.penalty * limit.scale for limit in limits),
    )
    packed_stage = ca.Function("stage", [x, u, now, q, weight], dense(after, stage_cost, stage_rows, stage_packed))
    follow = ca.Function("follow", [x, u, q], dense(after))
    packed_final = ca.Function("final", [x, now, q], dense(final_cost, final_rows, final_packed))
    short = operations(layout, stage) <= STRAIGHT_MAX

    def lean(function: ca.Function) -> ca.Function:
        return straight(function) if short else function

    scaled, adjoints = lean(scaling(layout, stage, final)), adjoint(stage, final)
    return Problem(
        controller=controller,
        prepare=ca.Function("prepare", [theta, setpoint, nominal], [prepared]),
        bounds=ca.Function("bounds", [now, q], [ca.repmat(bound, len(layout.blocks), 1) for bound in (lower, upper)]),
        sweep=_sweep(layout, packed_stage, packed_final),
        quadratic=lean(quadratic(layout, stage, final, scaled)),
        curvature=curvature(
            layout,
            [row_weight(i, horizon) for i in range(horizon)],
            follow,
            second(x, u, now, q, weight, after, stage_rows),
            scaled,
            adjoints,
        ),
        residual=lean(residual(layout, adjoints)),
        merit=lean(merit(layout)),
        fallback=ca.Function("fallback", [now, q], [fallback]),
        correct=ca.Function("correct", [memory, y, u, q], dense(x_hat, corrected)),
        predict=ca.Function("predict", [x, memory, u, q], dense(predicted)),
        layout=layout,
    )


def _group(controller: Controller, *places: str) -> tuple[int, ...]:
    return tuple(j for j, limit in enumerate(controller.limits) if limit.at in places for _ in range(limit.rows.size1_out(0)))


def _sweep(layout: Layout, stage: ca.Function, final: ca.Function) -> ca.Function:
    now, inputs, q = ca.MX.sym("now", stage.size1_in(0)), ca.MX.sym("U", layout.size), ca.MX.sym("q", stage.size1_in(3))
    x, cost, rows, derivatives = now, ca.MX(0.0), [], []
    for i, u in enumerate(layout.inputs(inputs)):
        x, stage_cost, row, packed = stage(x, u, now, q, row_weight(i, layout.horizon))
        cost = cost + stage_cost
        rows.append(row)
        derivatives.append(packed)
    final_cost, row, packed = final(x, now, q)
    return ca.Function("sweep", [now, inputs, q], [cost + final_cost, ca.vertcat(*rows, row), ca.vertcat(*derivatives, packed)])
