"""The independent reference: the same problem by IPOPT, written as the equations stand.

Direct multiple shooting with the states as variables and the model as equality constraints, slacks as variables, exact
Hessians. It shares the controller's own functions with `ocp` and nothing else: no condensing, no scaling, no
linearisation. Some hundred times slower; for tests, and on request: ``run_episode(..., control=ipopt_act)``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from chargetune.control.control_step import Info, Memory, problem_of
from chargetune.control.controller import Controller
from chargetune.control.ocp import row_weight
from chargetune.control.sqp import SolveStatus
from chargetune.runtime.cache import cached

__all__ = ["Nlp", "ipopt_act", "multiple_shooting"]

# At 1e-9 IPOPT stops 2 mA early where a charge is nearly done and the cost is flat.
OPTIONS: dict[str, Any] = {
    "ipopt": {"print_level": 0, "sb": "yes", "tol": 1e-11, "max_iter": 500, "bound_relax_factor": 0.0},
    "print_time": False,
    "error_on_fail": False,
}


@dataclass(frozen=True)
class Nlp:
    """The problem for IPOPT: variables (an input a block, x_1 .. x_N, s), parameters (now, theta, setpoint, p_nominal)."""

    solver: ca.Function
    equalities: int
    inequalities: int
    bounds: ca.Function
    fallback: ca.Function


def multiple_shooting(controller: Controller) -> Nlp:
    """min J + sum_j w_j (s_j + s_j^2 / (2 scale_j)) s.t. x_{i+1} = f(x_i, u_i), (1 + i / N) rows <= s, bounds on u, s >= 0."""
    model, horizon = controller.model, controller.horizon
    nx, nu = len(model.states), len(model.inputs)
    now, theta = ca.MX.sym("now", nx), ca.MX.sym("theta", controller.theta.dimension)
    setpoint, nominal = ca.MX.sym("setpoint", nx + nu), ca.MX.sym("p", model.nominal.size)
    p = controller.parameters(theta, nominal)
    blocks = controller.input_blocks
    inputs, states = ca.MX.sym("U", nu, len(blocks)), ca.MX.sym("X", nx, horizon)
    block_of = [k for k, length in enumerate(blocks) for _ in range(length)]
    slack = ca.MX.sym("s", len(controller.limits))
    cost: Any = ca.MX(0.0)
    gaps: list[Any] = []
    rows: list[Any] = []

    def add_rows(places: tuple[str, ...], stage: int, x: Any, u: Any) -> None:
        weight = row_weight(stage, horizon)
        rows.extend(weight * limit.rows(x, u, theta, p, now) - slack[j] for j, limit in enumerate(controller.limits) if limit.at in places)

    x: Any = now
    for i in range(horizon):
        u = inputs[:, block_of[i]]
        cost += controller.stage_cost(x, u, theta, p, setpoint, now)
        add_rows(("start", "both"), i, x, u)
        gaps.append(states[:, i] - model.f(x, u, p))
        x = states[:, i]
        add_rows(("end", "both"), i, x, u)
    no_input = ca.MX(ca.DM.zeros(nu))
    cost += controller.terminal_cost(x, no_input, theta, p, setpoint, now)
    add_rows(("terminal",), horizon, x, no_input)
    for j, limit in enumerate(controller.limits):
        cost += limit.penalty * (slack[j] + slack[j] ** 2 / (2 * limit.scale))

    parameters = ca.vertcat(now, theta, setpoint, nominal)
    nlp = {"x": ca.vertcat(ca.vec(inputs), ca.vec(states), slack), "p": parameters, "f": cost, "g": ca.vertcat(*gaps, *rows)}
    arguments = [theta, nominal, now]
    bounds = [controller.input_lower(theta, p, now), controller.input_upper(theta, p, now)]
    return Nlp(
        solver=ca.nlpsol("nlp", "ipopt", nlp, OPTIONS),
        equalities=horizon * nx,
        inequalities=sum(row.shape[0] for row in rows),
        bounds=ca.Function("bounds", arguments, bounds),
        fallback=ca.Function("fallback", arguments, [controller.fallback(theta, p, now)]),
    )


def ipopt_act(
    controller: Controller, received: NDArray[np.float64], theta: NDArray[np.float64], memory: Memory
) -> tuple[NDArray[np.float64], Memory, Info]:
    """One control step by IPOPT, with the signature of `mpc.act`; kkt is 0 where IPOPT reports success, else infinite."""
    problem = problem_of(controller)
    nlp = cached(f"ipopt {controller.structure}", lambda: multiple_shooting(controller))
    model, horizon, nominal = controller.model, controller.horizon, controller.model.nominal
    blocks = controller.input_blocks
    count = len(blocks)
    nx, nu, size = len(model.states), len(model.inputs), count * len(model.inputs)
    q = problem.prepare(theta, ca.DM(controller.setpoint), nominal)
    estimate, corrected = problem.correct(memory.estimator, received, memory.last_input, q)
    now = np.array(estimate).ravel()
    lower, upper = (np.array(bound).ravel() for bound in nlp.bounds(theta, nominal, np.where(np.isfinite(now), now, 0.0)))

    warm = memory.warm[:size]
    slacks = len(controller.limits)
    guess = np.concatenate(
        [np.clip(warm, np.tile(lower, count), np.tile(upper, count)), _roll_out(controller, now, warm, theta), np.zeros(slacks)]
    )
    solution = nlp.solver(
        x0=guess,
        p=np.concatenate([now, theta, controller.setpoint, nominal]),
        lbx=np.concatenate([np.tile(lower, count), np.full(horizon * nx, -np.inf), np.zeros(slacks)]),
        ubx=np.concatenate([np.tile(upper, count), np.full(horizon * nx + slacks, np.inf)]),
        lbg=np.concatenate([np.zeros(nlp.equalities), np.full(nlp.inequalities, -np.inf)]),
        ubg=0.0,
    )
    found = np.array(solution["x"]).ravel()[:size]
    good = bool(nlp.solver.stats()["success"]) and bool(np.all(np.isfinite(found)))
    if not np.all(np.isfinite(found)):
        declared = np.array(nlp.fallback(theta, nominal, np.where(np.isfinite(now), now, 0.0))).ravel()
        found, status = np.tile(declared, count), SolveStatus.FALLBACK
    else:
        status = SolveStatus.CONVERGED if good else SolveStatus.NOT_CONVERGED
    plan = np.clip(found, np.tile(lower, count), np.tile(upper, count))
    u = plan[:nu]
    ahead = np.array(problem.predict(now, corrected, u, q)).ravel()
    following = np.concatenate([*problem.layout.later(list(plan.reshape(count, nu))), memory.warm[size:]])
    info = Info(status, 0.0 if good else np.inf, int(nlp.solver.stats()["iter_count"]), now)
    return u, Memory(ahead, u, following), info


def _roll_out(
    controller: Controller, now: NDArray[np.float64], inputs: NDArray[np.float64], theta: NDArray[np.float64]
) -> NDArray[np.float64]:
    p = controller.parameters(theta, controller.model.nominal)
    x, out = now, []
    for u in np.repeat(inputs.reshape(len(controller.input_blocks), -1), controller.input_blocks, axis=0):
        x = np.array(controller.model.f(x, u, p)).ravel()
        out.append(x)
    return np.concatenate(out)
