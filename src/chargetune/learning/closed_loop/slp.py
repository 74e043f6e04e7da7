"""Sequential linear programming: the best point within many limits at once."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linprog

from chargetune.runtime.counted import counted

__all__ = ["Evaluate", "Linearisation", "Point", "solve_slp"]

# Step of the finite differences: far above the rounding of a closed loop, far below where it bends.
STEP = 2e-3
# First and longest step in any entry, and the shortest one that is still a step.
RADIUS, LONGEST, SHORTEST = 0.1, 0.3, 1e-4
# Share of the promised decrease below which a step is not taken; below POOR the radius is halved, above GOOD it is doubled.
# The usual values of trust-region methods (Nocedal and Wright, section 4.1).
HOLDS, POOR, GOOD = 0.1, 0.3, 0.75
# Second-order corrections of a step that does not hold, and the factor by which it is shortened after them.
CORRECTIONS, SHORTER = 2, 0.25
# Factor on the penalty where a violation is not worth mending at the present one, and how often it is raised.
DEARER, TIMES = 10.0, 4


class Point(NamedTuple):
    """What is to be minimised, and rows that are kept where they are at most 0."""

    objective: float
    rows: NDArray[np.float64]

    @property
    def violation(self) -> float:
        return float(np.max(self.rows, initial=0.0))


Evaluate = Callable[[Sequence[NDArray[np.float64]]], Sequence[Point | None]]
"""Points of the unit cube -> what they are worth, None where that is not known."""


@dataclass(frozen=True)
class Linearisation:
    """Objective and rows around a point u, by their slopes there, and the proximal term w |u + d - centre|_1."""

    u: NDArray[np.float64]
    rows: NDArray[np.float64]
    gradient: NDArray[np.float64]
    jacobian: NDArray[np.float64]
    weight: float
    centre: NDArray[np.float64]

    def step(self, radius: float, penalty: float, bent: NDArray[np.float64] | float = 0.0) -> tuple[NDArray[np.float64], float]:
        """The best step and the violation that it leaves; ``bent``: by how much the rows are known to be above these lines.

        No step, with a warning, where the program could not be solved.
        """
        d, rows = self.u.size, self.rows + bent
        # Rows that no step of this radius can break are left out.
        near = rows + radius * np.abs(self.jacobian).sum(axis=1) > 0
        low, high = np.maximum(-radius, -self.u), np.minimum(radius, 1.0 - self.u)
        # Variables d, the violation t, and s_i >= |u_i + d_i - centre_i|.
        matrix = np.hstack([self.jacobian[near], -np.ones((int(near.sum()), 1))])
        cost, most = np.append(self.gradient, penalty), -rows[near]
        bounds = [*zip(low, high, strict=True), (0.0, None)]
        if self.weight > 0:
            away, eye = self.u - self.centre, np.eye(d)
            sides = [np.hstack([sign * eye, np.zeros((d, 1)), -eye]) for sign in (1.0, -1.0)]
            matrix = np.vstack([np.hstack([matrix, np.zeros((len(matrix), d))]), *sides])
            cost, most = np.append(cost, np.full(d, self.weight)), np.concatenate([most, -away, away])
            bounds += [(0.0, None)] * d
        message = ""
        # The simplex method gives up now and then where slopes are of many sizes; the interior point method does not.
        for method in ("highs", "highs-ipm"):
            found = linprog(cost, A_ub=matrix, b_ub=most, bounds=bounds, method=method)
            if found.x is not None:
                return found.x[:d], float(found.x[d])
            message = found.message
        warnings.warn(f"a linear program of {counted(len(most), 'row')} failed, no step ({message})", RuntimeWarning, stacklevel=2)
        return np.zeros(d), float(np.max(rows, initial=0.0))

    def decrease(self, step: NDArray[np.float64]) -> float:
        """By how much a step lowers objective and proximal term."""
        return -float(self.gradient @ step) + self.proximal(self.u) - self.proximal(self.u + step)

    def proximal(self, u: NDArray[np.float64]) -> float:
        return self.weight * float(np.sum(np.abs(u - self.centre)))


def solve_slp(
    evaluate: Evaluate,
    start: NDArray[np.float64],
    iterations: int,
    gain: float,
    kept: float = 0.0,
    proximal: float = 0.0,
    centre: NDArray[np.float64] | None = None,
) -> NDArray[np.float64]:
    """The best point of the unit cube that keeps all rows, from ``start``, which need not.

        min f(u) + w |u - centre|_1  s.t.  c(u) <= 0,  0 <= u <= 1

    by linear programs (HiGHS) with finite differences g, J, within a trust region,

        min g'd + rho t + w |u + d - centre|_1  s.t.  c + J d <= t,  t >= 0,  |d| <= radius,  0 <= u + d <= 1,

    w the share ``proximal`` of |f(start)|; ``centre`` is the start unless it is given. A step is taken when
    f + w |u - centre|_1 + rho max(0, max c) falls as it says. When it does not it is corrected with what the rows were found to be
    there, c(u + d) - J d, and then shortened. It ends after so many ``iterations``, or when a step promises less than the share
    ``gain`` of f. That it mends rows does not count where none is broken by more than ``kept``; where one is, the penalty rho is raised
    first. A charge that rides its limits all the way has as many samples at a limit as theta has entries: its theta is a corner of
    them, at which a linear program arrives like Newton's method. A row of which nothing is known is -inf.
    Source: Fletcher and Sainz de la Maza, Math. Program. 43 (1989) 235; the correction: Nocedal and Wright, Numerical Optimization
    (2006), section 15.6.
    """
    (here,) = evaluate([start])
    if here is None:
        return start
    size = abs(here.objective) or 1.0
    u, radius, penalty, weight = start, RADIUS, size, proximal * size
    dearest, centre = penalty * DEARER**TIMES, start if centre is None else centre
    for _ in range(iterations):
        lines = _linearised(evaluate, u, here, weight, centre)

        def merit(point: Point, at: NDArray[np.float64], penalty: float, lines: Linearisation = lines) -> float:
            return point.objective + lines.proximal(at) + penalty * point.violation

        while True:
            step, left = lines.step(radius, penalty)
            won = lines.decrease(step)
            promised = penalty * (here.violation - left) + won
            if radius < SHORTEST:
                return u
            if (won if here.violation <= kept else promised) < gain * abs(here.objective):
                if here.violation <= kept or penalty >= dearest:
                    return u
                penalty *= DEARER
                continue
            before = merit(here, u, penalty)
            there = _taken(evaluate, u + step, here)
            for _ in range(CORRECTIONS):
                if there is None or before - merit(there, u + step, penalty) >= HOLDS * promised:
                    break
                step, _ = lines.step(radius, penalty, _rise(here.rows, there.rows) - lines.jacobian @ step)
                there = _taken(evaluate, u + step, here)
            held = -np.inf if there is None else before - merit(there, u + step, penalty)
            if there is not None and held >= HOLDS * promised:
                break
            radius = SHORTER * min(radius, float(np.max(np.abs(step))))
        if held < POOR * promised:
            radius /= 2
        elif held > GOOD * promised and np.max(np.abs(step)) > 0.9 * radius:
            radius = min(2 * radius, LONGEST)
        penalty *= DEARER if left > 0 and here.violation - left < HOLDS * here.violation else 1.0
        u, here = u + step, there
    return u


def _taken(evaluate: Evaluate, u: NDArray[np.float64], here: Point) -> Point | None:
    (there,) = evaluate([u])
    return None if there is None or there.rows.shape != here.rows.shape else there


def _linearised(evaluate: Evaluate, u: NDArray[np.float64], here: Point, weight: float, centre: NDArray[np.float64]) -> Linearisation:
    steps = np.where(u + STEP <= 1.0, STEP, -STEP)
    gradient, jacobian = np.zeros(u.size), np.zeros((here.rows.size, u.size))
    for i, (step, ahead) in enumerate(zip(steps, evaluate([u + one for one in np.diag(steps)]), strict=True)):
        if ahead is not None and ahead.rows.shape == here.rows.shape:
            gradient[i] = (ahead.objective - here.objective) / step
            jacobian[:, i] = _rise(here.rows, ahead.rows) / step
    return Linearisation(u, here.rows, gradient, jacobian, weight, centre)


def _rise(before: NDArray[np.float64], after: NDArray[np.float64]) -> NDArray[np.float64]:
    """From rows to rows; 0 where one of them is not known."""
    return np.subtract(after, before, out=np.zeros_like(before), where=np.isfinite(before) & np.isfinite(after))
