"""The independent reference: the same problem by IPOPT, written as the equations stand.

Direct multiple shooting with the states as variables and the model as equality constraints, slacks as variables, exact
Hessians. It shares the controller's own functions with `ocp` and nothing else: no condensing, no scaling, no
linearisation. Some hundred times slower; for tests, and on request: ``Controller.build(..., solver="ipopt")``, or as
``first_guess="ipopt"``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from chargetune.control.control_step import Info, Memory, numbers, problem_of
from chargetune.control.controller import Controller
from chargetune.control.ocp import row_weight
from chargetune.control.sqp import SolveStatus
from chargetune.runtime.cache import cached
from chargetune.runtime.split import split

__all__ = ["Nlp", "ipopt_act", "ipopt_plan", "multiple_shooting"]

# At 1e-9 IPOPT stops 2 mA early where a charge is nearly done and the cost is flat.
OPTIONS: dict[str, Any] = {
    "ipopt": {"print_level": 0, "sb": "yes", "tol": 1e-11, "max_iter": 500, "bound_relax_factor": 0.0},
    "print_time": False,
    "error_on_fail": False,
}


@dataclass(frozen=True)
class Nlp:
    """The problem for IPOPT: variables (an input a block, x_1 .. x_N, s), parameters (now, theta, setpoint, p_nominal, u_last, given).

    bounds: (theta, p_nominal, now, u_last, given) -> (lower, upper) at the start of each block, shapes (blocks nu,).
    """

    solver: ca.Function
    equalities: int
    inequalities: int
    bounds: ca.Function


def multiple_shooting(controller: Controller) -> Nlp:
    """min J + sum_j w_j (s_j + s_j^2 / (2 scale_j)) s.t. x_{i+1} = f(x_i, u_i), (1 + i / N) rows <= s, bounds on u, s >= 0."""
    model, horizon = controller.model, controller.horizon
    nx, nu, ng = len(model.states), len(model.inputs), len(controller.given)
    now, theta = ca.MX.sym("now", nx), ca.MX.sym("theta", controller.theta.dimension)
    setpoint, nominal = ca.MX.sym("setpoint", nx + nu), ca.MX.sym("p", model.nominal.size)
    last, given = ca.MX.sym("u_last", nu), ca.MX.sym("given", ng * (horizon + 2))
    _, *signals = split(given, [ng] * (horizon + 2))
    blocks = controller.input_blocks
    inputs, states = ca.MX.sym("U", nu, len(blocks)), ca.MX.sym("X", nx, horizon)
    block_of = [k for k, length in enumerate(blocks) for _ in range(length)]
    slack = ca.MX.sym("s", len(controller.limits))
    cost: Any = ca.MX(0.0)
    gaps: list[Any] = []
    rows: list[Any] = []
    bounds: list[Any] = []

    def add_rows(places: tuple[str, ...], stage: int, *arguments: Any) -> None:
        weight = row_weight(stage, horizon)
        rows.extend(weight * limit.rows(*arguments) - slack[j] for j, limit in enumerate(controller.limits) if limit.at in places)

    x, before = now, last
    for i in range(horizon):
        u, p = inputs[:, block_of[i]], controller.parameters(theta, nominal, signals[i])
        cost += controller.stage_cost(x, u, theta, p, setpoint, now, before, signals[i])
        add_rows(("start", "both"), i, x, u, theta, p, now, before, signals[i])
        gaps.append(states[:, i] - model.f(x, u, p))
        x = states[:, i]
        add_rows(("end", "both"), i, x, u, theta, p, now, before, signals[i + 1])
        low, high, rate = (of(theta, p, now, signals[i]) for of in (controller.input_lower, controller.input_upper, controller.input_rate))
        for j in controller.rated:
            most, least = ca.fmax(before[j] + rate[j], low[j]), ca.fmin(before[j] - rate[j], high[j])
            rows += [u[j] - most, least - u[j]] if i else []
            low[j], high[j] = (low[j], high[j]) if i else (ca.fmax(low[j], least), ca.fmin(high[j], most))
        if i == 0 or block_of[i] > block_of[i - 1]:
            bounds.append((low, high))
        before = u
    no_input, p = ca.MX(ca.DM.zeros(nu)), controller.parameters(theta, nominal, signals[horizon])
    cost += controller.terminal_cost(x, no_input, theta, p, setpoint, now, before, signals[horizon])
    add_rows(("terminal",), horizon, x, no_input, theta, p, now, before, signals[horizon])
    for j, limit in enumerate(controller.limits):
        cost += limit.penalty * (slack[j] + slack[j] ** 2 / (2 * limit.scale))

    parameters = ca.vertcat(now, theta, setpoint, nominal, last, given)
    nlp = {"x": ca.vertcat(ca.vec(inputs), ca.vec(states), slack), "p": parameters, "f": cost, "g": ca.vertcat(*gaps, *rows)}
    arguments = [theta, nominal, now, last, given]
    lower, upper = zip(*bounds, strict=True)
    return Nlp(
        solver=ca.nlpsol("nlp", "ipopt", nlp, OPTIONS),
        equalities=horizon * nx,
        inequalities=sum(row.shape[0] for row in rows),
        bounds=ca.Function("bounds", arguments, [ca.vertcat(*lower), ca.vertcat(*upper)]),
    )


def ipopt_act(
    controller: Controller,
    received: NDArray[np.float64],
    theta: NDArray[np.float64],
    memory: Memory,
    given: NDArray[np.float64] | None = None,
) -> tuple[NDArray[np.float64], Memory, Info]:
    """One control step by IPOPT, with the signature of `control_step.act`; kkt is 0 where IPOPT reports success, else infinite."""
    problem, last = problem_of(controller), memory.last_input
    q = numbers(controller, theta, given)
    estimate, corrected = problem.correct(memory.estimator, received, last, q)
    now = np.array(estimate).ravel()
    plan, good = ipopt_plan(controller, now, theta, memory, given)
    status = SolveStatus.CONVERGED if good else SolveStatus.NOT_CONVERGED
    if not np.all(np.isfinite(plan)):
        known = problem.first(np.where(np.isfinite(now), now, 0.0), last)
        declared = np.tile(np.array(problem.fallback(known, q)).ravel(), len(controller.input_blocks))
        plan, status = np.array(problem.clip(known, declared, q)).ravel(), SolveStatus.FALLBACK
    nu = len(controller.model.inputs)
    u = plan[:nu]
    ahead = np.array(problem.predict(now, corrected, u, q)).ravel()
    following = np.concatenate([*problem.layout.later(list(plan.reshape(-1, nu))), memory.warm[plan.size :]])
    return u, Memory(ahead, u, following), Info(status, 0.0 if good else np.inf, _iterations(controller), now)


def ipopt_plan(
    controller: Controller, now: NDArray[np.float64], theta: NDArray[np.float64], memory: Memory, given: NDArray[np.float64] | None = None
) -> tuple[NDArray[np.float64], bool]:
    """(the inputs over the horizon from state ``now``, shape (size,), whether IPOPT reports success); NaN where it has no numbers.

    It starts from the plan that ``memory`` holds.
    """
    nlp = _nlp(controller)
    horizon, nominal = controller.horizon, controller.model.nominal
    nx, slacks = len(controller.model.states), len(controller.limits)
    size = len(controller.input_blocks) * len(controller.model.inputs)
    signals = np.zeros(len(controller.given) * (horizon + 2)) if given is None else given
    arguments = (theta, nominal, np.where(np.isfinite(now), now, 0.0), memory.last_input, signals)
    lower, upper = (np.array(bound).ravel() for bound in nlp.bounds(*arguments))
    warm = memory.warm[:size]
    guess = np.concatenate([np.clip(warm, lower, upper), _roll_out(controller, now, warm, theta, signals), np.zeros(slacks)])
    solution = nlp.solver(
        x0=guess,
        p=np.concatenate([now, theta, controller.setpoint, nominal, memory.last_input, signals]),
        lbx=np.concatenate([lower, np.full(horizon * nx, -np.inf), np.zeros(slacks)]),
        ubx=np.concatenate([upper, np.full(horizon * nx + slacks, np.inf)]),
        lbg=np.concatenate([np.zeros(nlp.equalities), np.full(nlp.inequalities, -np.inf)]),
        ubg=0.0,
    )
    found = np.array(solution["x"]).ravel()[:size]
    if not np.all(np.isfinite(found)):
        return np.full(size, np.nan), False
    problem = problem_of(controller)
    known = problem.first(arguments[2], memory.last_input)
    return np.array(problem.clip(known, found, numbers(controller, theta, given))).ravel(), bool(nlp.solver.stats()["success"])


def _nlp(controller: Controller) -> Nlp:
    return cached(f"ipopt {controller.structure}", lambda: multiple_shooting(controller))


def _iterations(controller: Controller) -> int:
    return int(_nlp(controller).solver.stats()["iter_count"])


def _roll_out(
    controller: Controller, now: NDArray[np.float64], inputs: NDArray[np.float64], theta: NDArray[np.float64], given: NDArray[np.float64]
) -> NDArray[np.float64]:
    x, out, horizon = now, [], controller.horizon
    every = np.repeat(inputs.reshape(len(controller.input_blocks), -1), controller.input_blocks, axis=0)
    for u, signals in zip(every, given.reshape(horizon + 2, -1)[1:], strict=False):
        p = controller.parameters(theta, controller.model.nominal, signals)
        x = np.array(controller.model.f(x, u, p)).ravel()
        out.append(x)
    return np.concatenate(out)
