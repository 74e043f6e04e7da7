"""The MPC's solver: Gauss-Newton SQP with an exact-penalty line search, one CasADi function for a whole control step.

    min over U, s >= 0   phi = J(U) + sum_j w_j (s_j + s_j^2 / (2 scale_j))
    s.t.                 lower <= U <= upper,   (1 + i / N) c_i(U) <= s_j

with one slack s_j for each limit over the whole horizon, c_i its value less its bound at stage i. Each iteration solves
the QP of the linearised outputs and the stage costs' Hessians with DAQP (the gradient is exact; of the curvature of
constraints and dynamics later iterations take the positive diagonal) and goes the full step; while phi rises the step is
halved. The first iterate is the shifted solution of the control step before. After each iteration the problem is
linearised anew and optimality and feasibility are measured THERE, from multipliers and derivatives, independently of what
the QP solver reports: one that is silently wrong cannot pass.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from chargetune.control.condensing import span_of
from chargetune.control.estimators import finite
from chargetune.control.ocp import Problem
from chargetune.control.qp import QPSolver, daqp
from chargetune.runtime.split import split

__all__ = ["KKT_TOLERANCE", "SolveStatus", "cold", "solver"]

# Tolerance of the scaled problem, where 1 is the whole range of an input or one `scale` of a limit: 1e-4 of 6 A is 0.6 mA.
KKT_TOLERANCE = 1e-4
HALVINGS_MAX = 6
# Iterations from this one on take the curvature of constraints and dynamics into account. Gauss-Newton steps are cheaper and
# mostly converge in one or two; along a limit that is bent in the input, as that of a temperature is, they go back and forth.
CURVED_FROM = 2
# A first iterate at which a derivative is infinite, as that of a root at an input's bound, moves in by the first share of the range of the
# input, as IPOPT's bound_push does. Where states still leave the domain, as a tank that runs empty does, it begins in the middle.
INSIDE = (1e-2, 0.5)
# Violations of this share of a limit's scale come from the QP solver's own tolerance.
MERIT_ROUNDING = 1e-9


class SolveStatus(IntEnum):
    """How a control step ended."""

    CONVERGED = 0
    NOT_CONVERGED = 1  # bounded input applied, but optimality or feasibility is not within tolerance
    FALLBACK = 2  # the solver returned something non-finite: the declared fallback input was applied


def solver(problem: Problem, qp: QPSolver = daqp) -> ca.Function:
    """The solve of one control step: (now, warm, q) -> (U, warm_next, status, kkt, iterations).

    U is finite and within the bounds whatever happened: status FALLBACK means that it is the fallback input repeated.
    kkt is `Problem.residual` at U. ``warm`` is U and the QP's multipliers; `cold` makes the first one.
    """
    size, nx, nq, duals = problem.size, problem.sweep.size1_in(0), problem.sweep.size1_in(2), _duals(problem)
    step = _iteration(problem, qp)
    last_one = problem.controller.iterations_max - 1
    curved_from = 0 if problem.controller.hessian == "exact" else CURVED_FROM
    arguments = step.mx_in()[:-1]
    *point, dual, kkt = step(*arguments, float(last_one >= curved_from))
    # Further iterations are nested branches, which cost nothing where the first iterate is a solution.
    more = ca.Function("more", arguments, [point[0], dual, kkt, ca.MX(1.0)])
    for iteration in reversed(range(last_one)):
        *point, dual, kkt = step(*arguments, float(iteration >= curved_from))
        inputs = more.mx_in()
        done = ca.Function("done", inputs, [inputs[1], inputs[5], ca.MX(0.0), ca.MX(0.0)])
        # A NaN is not converged either, hence the negation.
        unfinished = ca.logic_not(kkt <= KKT_TOLERANCE)
        again = ca.Function.if_else("again", more, done)
        last, last_dual, last_kkt, count = again(unfinished, arguments[0], *point, dual, *arguments[6:])
        more = ca.Function("more", arguments, [last, last_dual, ca.if_else(unfinished, last_kkt, kkt), count + 1])

    now, warm, q = ca.MX.sym("now", nx), ca.MX.sym("warm", size + duals), ca.MX.sym("q", nq)
    # Bounds may depend on the estimate; they must stay numbers when it is not one.
    estimate, last_inputs = split(now, (nx - len(problem.controller.carried), len(problem.controller.carried)))
    known = ca.vertcat(ca.if_else(finite(ca.sum1(ca.fabs(estimate))), estimate, ca.DM.zeros(estimate.shape[0])), last_inputs)
    lower, upper = problem.bounds(known, q)
    before, dual_before = split(warm, (size, duals))
    start, cost, rows, derivatives = _begin(problem)(now, known, problem.clip(known, before, q), lower, upper, q)
    found, dual, kkt, count = more(now, start, rows, derivatives, problem.merit(cost, rows), dual_before, lower, upper, q)
    usable = finite(ca.sum1(ca.fabs(found)))
    declared = ca.repmat(problem.fallback(known, q), len(problem.layout.blocks), 1)
    bounded = problem.clip(known, ca.if_else(usable, found, declared), q)
    status = ca.if_else(usable, ca.if_else(kkt <= KKT_TOLERANCE, SolveStatus.CONVERGED, SolveStatus.NOT_CONVERGED), SolveStatus.FALLBACK)
    usable_dual = ca.if_else(finite(ca.sum1(ca.fabs(dual))), dual, ca.DM.zeros(duals))
    held = split(bounded, [problem.layout.nu] * len(problem.layout.blocks))
    following = ca.vertcat(*problem.layout.later(held), usable_dual[_shift(problem)])
    names = ["U", "warm_next", "status", "kkt", "iterations"]
    return ca.Function("solver", [now, warm, q], [bounded, following, status, kkt, count], ["now", "warm", "q"], names)


def _begin(problem: Problem) -> ca.Function:
    """(now, known, U, lower, upper, q) -> (U, J, c, D) at U, or inside the bounds where a derivative at U is not finite."""
    names = (("now", problem.sweep.size1_in(0)), ("known", problem.sweep.size1_in(0)), ("U", problem.size))
    arguments = [ca.MX.sym(name, rows) for name, rows in (*names, ("lower", problem.size), ("upper", problem.size))]
    now, known, inputs, lower, upper = arguments
    q = ca.MX.sym("q", problem.sweep.size1_in(2))
    there = [inputs, *problem.sweep(now, inputs, q)]
    for share in INSIDE:
        room = share * span_of(lower, upper)
        moved = problem.clip(known, ca.fmin(ca.fmax(inputs, lower + room), upper - room), q)
        kept = [ca.MX.sym("kept", *part.shape) for part in there]
        stay = ca.Function("stay", [*arguments, q, *kept], kept)
        inside = ca.Function("inside", [*arguments, q, *kept], [moved, *problem.sweep(now, moved, q)])
        branch = ca.Function.if_else("where", inside, stay)
        lost = ca.logic_not(finite(ca.sum1(ca.fabs(there[-1]))))
        there = list(branch(lost, *arguments, q, *there))
    return ca.Function("begin", [*arguments, q], there)


def cold(problem: Problem, inputs: NDArray[np.float64]) -> NDArray[np.float64]:
    """The first ``warm`` of `solver`: one input vector, shape (nu,), in each block, nothing active."""
    return np.concatenate([np.tile(inputs, len(problem.layout.blocks)), np.zeros(_duals(problem))])


def _duals(problem: Problem) -> int:
    return len(problem.controller.limits) + problem.size + len(problem.groups)


def _shift(problem: Problem) -> list[int]:
    """Where each of the next multipliers stands in these: an interval later, the last one repeated; a block of several keeps its own."""
    layout, bounds = problem.layout, len(problem.controller.limits)
    first_row, width = bounds + layout.size, len(layout.stage_groups)

    def later(offset: int, size: int, lengths: Sequence[int]) -> list[int]:
        last = len(lengths) - 1
        return [offset + min(i + (length == 1), last) * size + k for i, length in enumerate(lengths) for k in range(size)]

    terminal = range(first_row + layout.horizon * width, first_row + len(layout.groups))
    rows = later(first_row, width, (1,) * layout.horizon)
    return [*range(bounds), *later(bounds, layout.nu, layout.blocks), *rows, *terminal]


def _iteration(problem: Problem, qp: QPSolver) -> ca.Function:
    """One SQP iteration: (now, U, c, D, merit, dual, lower, upper, q, bend) -> (U, c, D, merit, dual, kkt) at the next U.

    With ``bend`` = 1 it takes the curvature of constraints and dynamics into account, with 0 it is Gauss-Newton's.
    """
    limits = problem.controller.limits
    nx, nq, rows = problem.sweep.size1_in(0), problem.sweep.size1_in(2), len(problem.groups)
    now, inputs, c, derivatives = (
        ca.MX.sym(n, k) for n, k in (("now", nx), ("U", problem.size), ("c", rows), ("D", problem.sweep.size1_out(2)))
    )
    merit, dual, q = ca.MX.sym("merit"), ca.MX.sym("dual", _duals(problem)), ca.MX.sym("q", nq)
    lower, upper = ca.MX.sym("lower", problem.size), ca.MX.sym("upper", problem.size)
    bend = ca.MX.sym("bend")
    of = problem.curvature.mx_in()
    straight = ca.Function("straight", of, [of[2]])
    curvature = ca.Function.if_else("curvature", problem.curvature, straight)
    # Multipliers, of the cost as it is: of the slacks' bounds, of the inputs' bounds, of the rows.
    sizes = (len(limits) + problem.size, rows)
    _, prices = split(dual, sizes)
    bent = curvature(bend, now, inputs, derivatives, prices, q)
    if problem.controller.hessian == "exact":
        bent = problem.convex(bent, lower, upper)
        gamma, near = problem.scaling(bent, lower, upper)
    else:
        gamma, near = problem.scaling(derivatives, lower, upper)
    *data, span = problem.quadratic(inputs, c, bent, lower, upper, gamma, near)
    values, new_dual = qp(len(limits), problem.size, problem.size + rows)(*data, dual)
    # What phi may rise by is below the solver's tolerance in the scaled cost, and above the rounding of the penalties.
    rounding = MERIT_ROUNDING * sum(limit.penalty * limit.scale for limit in limits)
    allowed = merit + KKT_TOLERANCE**2 / gamma + rounding
    direction, _ = split(values, (problem.size, rows))
    point = list(_line_search(problem)(now, inputs, span * direction, 1.0, allowed, q))
    _, prices = split(new_dual, sizes)
    kkt = problem.residual(*point[:3], prices, gamma, lower, upper)
    return ca.Function("iteration", [now, inputs, c, derivatives, merit, dual, lower, upper, q, bend], [*point, new_dual / gamma, kkt])


def _line_search(problem: Problem) -> ca.Function:
    """(now, U, d, length, allowed, q) -> (U, c, D, phi) at U + length d, the length halved while phi > allowed."""
    sizes = {
        "now": problem.sweep.size1_in(0),
        "U": problem.size,
        "d": problem.size,
        "length": 1,
        "allowed": 1,
        "q": problem.sweep.size1_in(2),
    }
    arguments = [ca.MX.sym(name, rows) for name, rows in sizes.items()]
    now, base, direction, length, allowed, q = arguments

    where = base + length * direction
    cost, rows, derivatives = problem.sweep(now, where, q)
    trial = [where, rows, derivatives, problem.merit(cost, rows)]
    search = ca.Function("search", arguments, trial)
    for _ in range(HALVINGS_MAX):
        kept = [ca.MX.sym("kept", *t.shape) for t in trial]
        keep = ca.Function("keep", [*arguments, *kept], kept)
        shorter = ca.Function("shorter", [*arguments, *kept], list(search(now, base, direction, length / 2, allowed, q)))
        branch = ca.Function.if_else("halve", shorter, keep)
        search = ca.Function("search", arguments, list(branch(ca.logic_not(trial[-1] <= allowed), *arguments, *trial)))
    return search
