"""One control step of a `Controller`: estimate, solve, predict. Built functions are cached by content."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from chargetune.control.controller import Controller
from chargetune.control.ocp import Problem, control_problem
from chargetune.control.qp import QPSolver, daqp
from chargetune.control.sqp import SolveStatus, cold, solver

__all__ = ["Act", "Info", "Memory", "act", "begin", "cached", "control_step", "problem_of"]


@dataclass(frozen=True)
class Memory:
    """What a controller carries from one step to the next: estimator memory, last input, warm start."""

    estimator: NDArray[np.float64]
    last_input: NDArray[np.float64]
    warm: NDArray[np.float64]


@dataclass(frozen=True)
class Info:
    """How the step went. kkt is the natural residual of the scaled problem at the input that was applied."""

    status: SolveStatus
    kkt: float
    iterations: int
    estimate: NDArray[np.float64]


T = TypeVar("T")
_BUILT: OrderedDict[str, Any] = OrderedDict()
BUILT_MAX = 32


def cached(key: str, build: Callable[[], T]) -> T:
    """What ``build`` makes, kept under ``key``; the oldest of many goes first."""
    if key not in _BUILT:
        _BUILT[key] = build()
        while len(_BUILT) > BUILT_MAX:
            _BUILT.popitem(last=False)
    _BUILT.move_to_end(key)
    built: T = _BUILT[key]
    return built


def problem_of(controller: Controller) -> Problem:
    return cached(f"problem {controller.structure}", lambda: control_problem(controller))


def control_step(problem: Problem, qp: QPSolver = daqp) -> ca.Function:
    """(estimator memory, y, last input, warm, q) -> (input, memory, warm, status, kkt, iterations, estimate)."""
    nu = len(problem.controller.model.inputs)
    solve = solver(problem, qp)
    memory, y = problem.correct.mx_in()[:2]
    last, warm, q = ca.MX.sym("u", nu), ca.MX.sym("warm", solve.size1_in(1)), ca.MX.sym("q", solve.size1_in(2))
    estimate, corrected = problem.correct(memory, y, last, q)
    inputs, following, status, kkt, count = solve(estimate, warm, q)
    u = inputs[:nu]
    ahead = problem.predict(estimate, corrected, u, q)
    return ca.Function("control_step", [memory, y, last, warm, q], [u, ahead, following, status, kkt, count, estimate])


def begin(controller: Controller) -> Memory:
    """The memory before the first measurement: no input has been applied yet."""
    no_input = np.zeros(len(controller.model.inputs))
    initial = controller.estimator.initial(controller.model, np.array(controller.start))
    return Memory(initial, no_input, cold(problem_of(controller), no_input))


# (controller, received, theta, memory) -> (input, memory, info)
Act = Callable[[Controller, NDArray[np.float64], NDArray[np.float64], Memory], tuple[NDArray[np.float64], Memory, Info]]


def act(
    controller: Controller, received: NDArray[np.float64], theta: NDArray[np.float64], memory: Memory
) -> tuple[NDArray[np.float64], Memory, Info]:
    """One control step: the input for the next interval, the new memory and how the solve went.

    ``received`` holds the signals that the estimator reads, in its order. The input, shape (nu,), is finite and within
    the bounds of the controller whatever the measurement or the solver was.
    """
    problem = problem_of(controller)
    step = cached(f"step {controller.structure}", lambda: control_step(problem))
    q = problem.prepare(theta, ca.DM(controller.setpoint), controller.model.nominal)
    out = step(memory.estimator, received, memory.last_input, memory.warm, q)
    u, ahead, warm, status, kkt, count, estimate = (np.array(o).ravel() for o in out)
    info = Info(SolveStatus(int(status[0])), float(kkt[0]), int(count[0]), estimate)
    return u, Memory(ahead, u, warm), info
