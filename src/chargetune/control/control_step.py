"""One control step of a `Controller`: estimate, solve, predict. Built functions are cached by content."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from chargetune.control.controller import Controller
from chargetune.control.ocp import Problem, control_problem
from chargetune.control.qp import QPSolver, daqp, daqp_warm, warm_sources
from chargetune.control.sqp import SolveStatus, cold, solver
from chargetune.runtime.cache import cached
from chargetune.runtime.compiler import compile_library, compiler_flags, find_compiler
from chargetune.runtime.split import split

__all__ = ["Act", "Info", "Memory", "act", "begin", "compiled_act", "control_step", "numbers", "problem_of"]


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


def problem_of(controller: Controller) -> Problem:
    return cached(f"problem {controller.structure}", lambda: control_problem(controller))


def numbers(controller: Controller, theta: NDArray[np.float64], given: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
    """q of the problem's functions: what is fixed at theta, and ``given``, a row of `model.given.windows` (by default all are 0)."""
    # Controllers of one structure share one problem, and each has its own numbers.
    q = np.array(problem_of(controller).prepare(theta, ca.DM(controller.setpoint), controller.model.nominal)).ravel()
    return np.concatenate([q, np.zeros(len(controller.given) * (controller.horizon + 2)) if given is None else given])


def control_step(problem: Problem, qp: QPSolver = daqp) -> ca.Function:
    """(estimator memory, y, last input, warm, q) -> (input, memory, warm, status, kkt, iterations, estimate).

    q holds a row of `model.given.windows` below `Problem.prepare`, see `numbers`.
    """
    nu = len(problem.controller.model.inputs)
    solve = solver(problem, qp)
    memory, y = problem.correct.mx_in()[:2]
    last, warm, q = ca.MX.sym("u", nu), ca.MX.sym("warm", solve.size1_in(1)), ca.MX.sym("q", solve.size1_in(2))
    estimate, corrected = problem.correct(memory, y, last, q)
    now = ca.vertcat(estimate, *(last[i] for i in problem.controller.carried))
    inputs, following, status, kkt, count = solve(now, warm, q)
    u, _ = split(inputs, (nu, problem.size - nu))
    ahead = problem.predict(estimate, corrected, u, q)
    return ca.Function("control_step", [memory, y, last, warm, q], [u, ahead, following, status, kkt, count, estimate])


def begin(controller: Controller) -> Memory:
    """The memory before the first measurement: no input has been applied yet."""
    before = np.array(controller.input_before)
    initial = controller.estimator.initial(controller.model, np.array(controller.start))
    return Memory(initial, before, cold(problem_of(controller), before))


# (controller, received, theta, memory), and where there are given signals what is known of them now -> (input, memory, info)
Act = Callable[..., tuple[NDArray[np.float64], Memory, Info]]


def act(
    controller: Controller,
    received: NDArray[np.float64],
    theta: NDArray[np.float64],
    memory: Memory,
    given: NDArray[np.float64] | None = None,
) -> tuple[NDArray[np.float64], Memory, Info]:
    """One control step: the input for the next interval, the new memory and how the solve went.

    ``received`` holds the signals that the estimator reads, in its order, ``given`` the given signals over the horizon as a
    row of `model.given.windows`, shape ((N + 2) signals,). The input, shape (nu,), is finite and within
    the bounds of the controller whatever the measurement or the solver was.
    """
    problem = problem_of(controller)
    step = cached(f"step {controller.structure}", lambda: control_step(problem))
    q = numbers(controller, theta, given)
    out = step(memory.estimator, received, memory.last_input, memory.warm, q)
    u, ahead, warm, status, kkt, count, estimate = (np.array(o).ravel() for o in out)
    info = Info(SolveStatus(int(status[0])), float(kkt[0]), int(count[0]), estimate)
    return u, Memory(ahead, u, warm), info


def compiled_act(controller: Controller) -> Act:
    """`act` of one controller for one episode as machine code where there is a C compiler: 0.03 ms a step instead of 0.2.

    The result holds buffers, so it is for one thread. Without a compiler, or where it fails (with a warning), it is `act`.
    """
    if find_compiler() is None:
        return act
    problem = problem_of(controller)
    try:
        function = cached(f"compiled step {controller.structure} {compiler_flags()}", lambda: _machine_code(problem))
    except (RuntimeError, OSError) as error:
        warnings.warn(f"the controller runs on the virtual machine, several times slower: {error}", RuntimeWarning, stacklevel=2)
        return act
    return _CompiledStep(function)


class _CompiledStep:
    """An `Act` on buffers that CasADi reads and writes in place; it keeps them and the function alive."""

    def __init__(self, function: ca.Function) -> None:
        self._function = function
        self._given, self._out = np.zeros(function.size1_in(0)), np.zeros(function.size1_out(0))
        self._buffer: Any
        self._buffer, self._evaluate = function.buffer()
        self._buffer.set_arg(0, self._given.data)
        self._buffer.set_res(0, self._out.data)
        self._theta, self._q = b"", np.zeros(0)

    def __call__(
        self,
        controller: Controller,
        received: NDArray[np.float64],
        theta: NDArray[np.float64],
        memory: Memory,
        given: NDArray[np.float64] | None = None,
    ) -> tuple[NDArray[np.float64], Memory, Info]:
        key = theta.tobytes()
        if key != self._theta or not self._q.size:
            self._q = numbers(controller, theta)
            self._theta = key
        if given is not None and given.size:
            self._q[-given.size :] = given
        self._given[:] = np.concatenate((memory.estimator, received, memory.last_input, memory.warm, self._q))
        self._evaluate()
        out, nu, nm = self._out.copy(), len(memory.last_input), len(memory.estimator)
        facts = nu + nm + len(memory.warm)
        info = Info(SolveStatus(int(out[facts])), float(out[facts + 1]), int(out[facts + 2]), out[facts + 3 :])
        return out[:nu], Memory(out[nu : nu + nm], out[:nu], out[nu + nm : facts]), info


def _machine_code(problem: Problem) -> ca.Function:
    """The control step with its arguments and its results in one vector each."""
    step = control_step(problem, daqp_warm)
    arguments = step.mx_in()
    sizes = [a.shape[0] for a in arguments]
    given = ca.MX.sym("given", sum(sizes))
    u, ahead, warm, status, kkt, count, estimate = step(*split(given, sizes))
    control = ca.Function("control", [given], [ca.vertcat(u, ahead, warm, status, kkt, count, estimate)])
    generator = ca.CodeGenerator("control", {"with_header": False})
    generator.add(control)
    sources, defines = warm_sources(len(problem.controller.limits), problem.size, problem.size + len(problem.groups))
    return ca.external("control", str(compile_library("control", (generator.dump(), *sources), defines)))
