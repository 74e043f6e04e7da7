"""Sequential programming: the best point within many limits at once, which is a corner of them."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linprog

__all__ = ["Evaluate", "Linearisation", "Point", "Subproblem", "solve_slp"]

# Step of the finite differences.
STEP = 2e-3
# The first step is at most this long in any entry, every other one at most `LONGEST`; below `SHORTEST` there is none.
RADIUS, LONGEST, SHORTEST = 0.1, 0.3, 1e-4
# Of what a step promises the share that it has to hold, and those below and above which the next may be half or twice as long.
HOLDS, POOR, GOOD = 0.1, 0.3, 0.75
# A step that does not hold it is corrected so often, and then taken this much shorter.
CORRECTIONS, SHORTER = 2, 0.25
# Where a row stays broken for what mending it costs, it may cost this much more, so often.
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
    """Objective and rows around a point u, by their slopes there."""

    u: NDArray[np.float64]
    rows: NDArray[np.float64]
    gradient: NDArray[np.float64]
    jacobian: NDArray[np.float64]

    def room(self, radius: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The least and the largest step, within the unit cube."""
        return np.maximum(-radius, -self.u), np.minimum(radius, 1.0 - self.u)

    def near(self, radius: float, bent: NDArray[np.float64] | float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The rows that a step of this radius may break, and their slopes; ``bent``: by how much they are known to be above these lines."""
        rows = self.rows + bent
        near = rows + radius * np.abs(self.jacobian).sum(axis=1) > 0
        return rows[near], self.jacobian[near]


class Subproblem(Protocol):
    """What a step is taken by."""

    @property
    def radius(self) -> float:
        """Of the first step."""
        ...

    @property
    def price(self) -> float:
        """Of a violation at first, as a share of the objective."""
        ...

    @property
    def least(self) -> float:
        """What the objective cannot be below."""
        ...

    def step(
        self, lines: Linearisation, radius: float, price: float, bent: NDArray[np.float64] | float = 0.0
    ) -> tuple[NDArray[np.float64], float]:
        """The best step and the violation it leaves; ``bent`` as in `Linearisation.near`."""
        ...

    def falls(self, lines: Linearisation, step: NDArray[np.float64]) -> float:
        """By how much a step lowers the objective."""
        ...


class _Linear:
    radius: ClassVar[float] = RADIUS
    price: ClassVar[float] = 1.0
    least: ClassVar[float] = -np.inf

    def step(
        self, lines: Linearisation, radius: float, price: float, bent: NDArray[np.float64] | float = 0.0
    ) -> tuple[NDArray[np.float64], float]:
        d = lines.u.size
        rows, jacobian = lines.near(radius, bent)
        matrix = np.hstack([jacobian, -np.ones((rows.size, 1))])
        bounds = [*zip(*lines.room(radius), strict=True), (0.0, None)]
        message = ""
        # The simplex method gives up now and then where slopes are of many sizes; the interior point method does not.
        for method in ("highs", "highs-ipm"):
            found = linprog(np.append(lines.gradient, price), A_ub=matrix, b_ub=-rows, bounds=bounds, method=method)
            if found.x is not None:
                return found.x[:d], float(found.x[d])
            message = found.message
        warnings.warn(f"a linear program of {rows.size} rows failed, no step ({message})", RuntimeWarning, stacklevel=2)
        return np.zeros(d), float(np.max(lines.rows + bent, initial=0.0))

    def falls(self, lines: Linearisation, step: NDArray[np.float64]) -> float:
        return -float(lines.gradient @ step)


def solve_slp(
    evaluate: Evaluate,
    start: NDArray[np.float64],
    iterations: int,
    gain: float,
    kept: float = 0.0,
    subproblem: Subproblem | None = None,
) -> NDArray[np.float64]:
    """The best point of the unit cube that keeps all rows, from ``start``, which need not.

        min f(u)  s.t.  c(u) <= 0,  0 <= u <= 1

    by linear programs (HiGHS; or another ``subproblem``) with finite differences g, J, within a trust region,

        min g'd + rho t  s.t.  c + J d <= t,  t >= 0,  |d| <= radius,  0 <= u + d <= 1.

    A step is taken when f + rho max(0, max c) falls as it says. When it does not it is corrected with what the rows were found to be
    there, c(u + d) - J d, and then shortened. It ends after so many ``iterations``, or when a step promises less than the share
    ``gain`` of f; that it mends rows does not count where none is broken by more than ``kept``, and where one is it costs more first.
    A charge that rides its limits all the way has as many samples at a limit as theta has entries: its theta is a corner of them, at
    which a linear program arrives like Newton's method. A row of which nothing is known is -inf.
    Source: Fletcher and Sainz de la Maza, Math. Program. 43 (1989) 235; the correction: Nocedal and Wright, Numerical Optimization
    (2006), section 15.6.
    """
    (here,) = evaluate([start])
    if here is None:
        return start
    subproblem = subproblem or _Linear()
    u, radius, price = start, subproblem.radius, subproblem.price * (abs(here.objective) or 1.0)
    longest, dearest = max(radius, LONGEST), price * DEARER**TIMES
    for _ in range(iterations):
        if here.violation <= kept and here.objective - subproblem.least < gain * abs(here.objective):
            return u
        lines = _linearised(evaluate, u, here)
        while True:
            step, left = subproblem.step(lines, radius, price)
            promised = price * (here.violation - left) + subproblem.falls(lines, step)
            mended = price * (here.violation - left) if here.violation <= kept else 0.0
            if radius < SHORTEST:
                return u
            if promised - mended < gain * abs(here.objective):
                if here.violation <= kept or price >= dearest:
                    return u
                price *= DEARER
                continue
            there, held = _held(evaluate, u, here, step, price)
            for _ in range(CORRECTIONS):
                if there is None or held >= HOLDS * promised:
                    break
                step, _ = subproblem.step(lines, radius, price, _rise(here.rows, there.rows) - lines.jacobian @ step)
                there, held = _held(evaluate, u, here, step, price)
            if there is not None and held >= HOLDS * promised:
                break
            radius = SHORTER * min(radius, float(np.max(np.abs(step))))
        if held < POOR * promised:
            radius /= 2
        elif held > GOOD * promised and np.max(np.abs(step)) > 0.9 * radius:
            radius = min(2 * radius, longest)
        price *= DEARER if left > 0 and here.violation - left < HOLDS * here.violation else 1.0
        u, here = u + step, there
    return u


def _held(evaluate: Evaluate, u: NDArray[np.float64], here: Point, step: NDArray[np.float64], price: float) -> tuple[Point | None, float]:
    """What a step leads to, and by how much the merit falls."""
    (there,) = evaluate([u + step])
    if there is None or there.rows.shape != here.rows.shape:
        return None, -np.inf
    return there, here.objective - there.objective + price * (here.violation - there.violation)


def _linearised(evaluate: Evaluate, u: NDArray[np.float64], here: Point) -> Linearisation:
    steps = np.where(u + STEP <= 1.0, STEP, -STEP)
    gradient, jacobian = np.zeros(u.size), np.zeros((here.rows.size, u.size))
    for i, (step, ahead) in enumerate(zip(steps, evaluate([u + one for one in np.diag(steps)]), strict=True)):
        if ahead is not None and ahead.rows.shape == here.rows.shape:
            gradient[i] = (ahead.objective - here.objective) / step
            jacobian[:, i] = _rise(here.rows, ahead.rows) / step
    return Linearisation(u, here.rows, gradient, jacobian)


def _rise(before: NDArray[np.float64], after: NDArray[np.float64]) -> NDArray[np.float64]:
    """From rows to rows; 0 where one of them is not known."""
    return np.subtract(after, before, out=np.zeros_like(before), where=np.isfinite(before) & np.isfinite(after))
