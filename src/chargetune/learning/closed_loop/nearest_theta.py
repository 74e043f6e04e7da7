"""Nothing is risked for nothing: of the thetas that promise as much, the one nearest to what was tried."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from chargetune.learning.closed_loop.search import Search
from chargetune.learning.closed_loop.slp import Linearisation, Point, solve_slp
from chargetune.model.parameter_space import ParameterSpace

__all__ = ["nearest"]

# A change of theta that promises less than this share of the objective is not worth a risk.
GAIN = 1e-3
# From the best trial's theta, where slopes are those of what is near, and where that leads nowhere from what was aimed at.
ITERATIONS_NEAR, ITERATIONS = 3, 8
# A search ends a little on the wrong side: of a tolerance, and of the gain.
ROUNDING = 0.1
# A step that comes nearer by less than this share of the first distance, squared, is not worth its slopes; nor is one below this distance.
NEARER, ARRIVED = 0.01, 0.1
# The first step may go all the way: most thetas that are looked for are near the best trial's, and far from what was aimed at.
RADIUS = 1.0
# A tolerance broken costs at first this share of the first distance, squared: at a higher price the way was left for limits that are broken
# on it and not at its end.
PRICE = 0.1
# For a least distance the price of a violation is the slope of a square, so far from its least: further ones are nearer to a line, and
# to rounding.
PULL = 50.0


def nearest(
    search: Search,
    space: ParameterSpace,
    best: NDArray[np.float64],
    start: NDArray[np.float64],
    promised: float,
    allowed: NDArray[np.float64],
) -> NDArray[np.float64]:
    """The theta nearest to ``best``, the best trial's, that promises an objective of ``promised``, as ``start`` about does.

    min |u - u_best|^2 in the unit cube  s.t.  objective >= promised, less the share `GAIN` of its size, and
    excess <= allowed at every sample, by its window, in tolerances beyond the tolerance (`windows_of`), by least distances (`solve_slp`).

    A change is a step into what has not been seen: entries that what is aimed at does not need stay where they were tried.
    ``search`` simulates the expected plant, so that ``allowed`` is to hold the margins. Where no point is found it is ``start``.
    """
    first, to = space.to_unit(start), space.to_unit(best)
    whole = max(float(np.linalg.norm(first - to)), ARRIVED)
    worth = GAIN * abs(promised) or GAIN
    seen: dict[bytes, float] = {}

    def point(u: NDArray[np.float64]) -> Point | None:
        """The distance, squared; what every sample is beyond what it may, in tolerances, and the objective, in what a risk is worth."""
        score, samples = search.score(u), search.samples(u)
        if score is None or samples is None:
            return None
        excess, window = samples
        # What nothing is known of, or is allowed anything, is no row.
        beyond = np.nan_to_num(excess - allowed[window], nan=-np.inf)
        distance = float(np.sum((u - to) ** 2)) / whole**2
        # What a step wins is seen beside where it began.
        found = Point(1.0 + distance, np.append(beyond, (promised - score.objective) / worth - 1.0))
        if found.violation <= ROUNDING:
            seen[np.clip(u, 0.0, 1.0).tobytes()] = distance
        return found

    def points(us: Sequence[NDArray[np.float64]]) -> list[Point | None]:
        search.scores(us)
        return [point(u) for u in us]

    subproblem = _LeastDistance(to, whole)
    if np.linalg.norm(first - to) > ARRIVED:
        solve_slp(points, to, ITERATIONS_NEAR, NEARER, ROUNDING, subproblem)
    if not seen:
        solve_slp(points, first, ITERATIONS, NEARER, ROUNDING, subproblem)
    found = min(seen, key=lambda key: seen[key], default=None)
    return start if found is None else space.from_unit(np.frombuffer(found))


@dataclass(frozen=True)
class _LeastDistance:
    """1 + |u - to|^2 within the lines; ``whole`` is 1.

    Source: Lawson and Hanson, Solving Least Squares Problems (1995), section 23.4, least distance programming.
    """

    to: NDArray[np.float64]
    whole: float
    radius: ClassVar[float] = RADIUS
    price: ClassVar[float] = PRICE
    least: ClassVar[float] = 1.0

    def step(
        self, lines: Linearisation, radius: float, price: float, bent: NDArray[np.float64] | float = 0.0
    ) -> tuple[NDArray[np.float64], float]:
        """min |u + d - to|^2 + rho t + (rho t / 2 PULL)^2  s.t.  c + J d <= t,  t >= 0,  |d| <= radius,  0 <= u + d <= 1.

        With s = rho t / (2 PULL) it is the least distance of (d, s) to (to - u, -PULL).
        """
        size = lines.u.size
        rows, jacobian = lines.near(radius, bent)
        low, high = lines.room(radius)
        aim = np.append((self.to - lines.u) / self.whole, -PULL)
        sides = np.eye(size, size + 1)
        kept = np.column_stack([-self.whole * jacobian, np.full(rows.size, 2 * PULL / price)])
        matrix = np.vstack([kept, np.eye(1, size + 1, size), sides, -sides])
        least = np.concatenate([rows, [0.0], low / self.whole, -high / self.whole]) - matrix @ aim
        # min |z| s.t. G z >= h:  with w >= 0 of least |[G'; h'] w - (0, 1)|, and r the residual there, z_j = -r_j / r_last.
        every = np.vstack([matrix.T, least]) / np.linalg.norm(matrix, axis=1)
        try:
            weights, _ = nnls(every, np.append(np.zeros(size + 1), 1.0))
        except RuntimeError as error:
            # SciPy's limit of iterations.
            warnings.warn(f"a least distance within {len(matrix)} lines was not found, no step ({error})", RuntimeWarning, stacklevel=2)
            return np.zeros(size), float(np.max(rows, initial=0.0))
        residual = every @ weights
        residual[-1] -= 1.0
        step = np.clip(self.whole * (aim - residual[:-1] / residual[-1])[:size], low, high)
        return step, float(np.max(rows + jacobian @ step, initial=0.0))

    def falls(self, lines: Linearisation, step: NDArray[np.float64]) -> float:
        before, after = lines.u - self.to, lines.u + step - self.to
        return float(before @ before - after @ after) / self.whole**2
