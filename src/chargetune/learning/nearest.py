"""Nothing is risked for nothing: of the thetas that promise as much, the one nearest to what was tried."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from chargetune.learning.belief import windows_of
from chargetune.learning.twin_search import STEP, Search
from chargetune.model.parameters import ParameterSpace

__all__ = ["nearest"]

# A change of theta that promises less than this share of the objective is not worth a risk.
GAIN = 1e-3
# Runs of entries that go back, one after the other; ways back that are simulated together; iterations from there.
BACKS, TOGETHER, ITERATIONS = 3, 16, 8
PARTS = (0.8, 0.6, 0.4, 0.2)
# Windows further inside their limits than so many tolerances say nothing.
FAR = 1000.0
# SLSQP ends a little on the wrong side: of a tolerance, and of the gain.
ROUNDING = 0.1


def nearest(
    search: Search,
    space: ParameterSpace,
    best: NDArray[np.float64],
    theta: NDArray[np.float64],
    upper: NDArray[np.float64],
) -> NDArray[np.float64]:
    """The theta nearest to ``best``, the best trial's, that promises as much as ``theta`` does.

    min |u - u_best|^2 in the unit cube  s.t.  objective >= that of theta, less the share `GAIN` of its size, and
    excess + margin <= 0 in every window, or <= what it is at theta. First whole runs of neighbouring entries go back, the longest
    first, since the way may be far; from there SLSQP with finite differences.

    A change is a step into what has not been seen: entries that what is aimed at does not need stay where they were tried.
    ``upper`` is the upper side of the excess by window at ``theta``, in tolerances; its distance to what is expected there is
    held as margin. ``search`` simulates the expected plant. Where no other point is found, it is ``theta``.
    """
    start, to = space.to_unit(theta), space.to_unit(best)
    own = search.score(start)
    if own is None:
        return theta
    margin = np.nan_to_num(upper - windows_of(own))
    most = float(np.nanmax(windows_of(own) + margin, initial=0.0))
    worth = GAIN * abs(own.objective) or GAIN
    seen: dict[bytes, float] = {}

    def left(u: NDArray[np.float64]) -> NDArray[np.float64]:
        """What is left to every window, in tolerances, and to the objective, in what a risk is worth."""
        score = search.score(u)
        if score is None:
            return np.full(margin.size + 1, -FAR)
        room = np.nan_to_num(most - margin - windows_of(score), nan=FAR)
        return np.append(np.clip(room, -FAR, FAR), (score.objective - own.objective) / worth + 1.0)

    def constraint(u: NDArray[np.float64]) -> NDArray[np.float64]:
        values = left(u)
        if float(np.min(values)) >= -ROUNDING:
            seen[np.clip(u, 0.0, 1.0).tobytes()] = float(np.sum((u - to) ** 2))
        return values

    def slopes(u: NDArray[np.float64]) -> NDArray[np.float64]:
        steps = np.where(u + STEP <= 1.0, STEP, -STEP)
        around = [u + step for step in np.diag(steps)]
        search.scores(around)
        return np.stack([left(ahead) - left(u) for ahead in around], axis=1) / steps

    runs = _runs(space)
    for _ in range(BACKS):
        moved = [np.concatenate([start[:i], to[i:j], start[j:]]) for i, j in runs]
        way = [float(np.sum(np.abs(one - start))) for one in moved]
        order = [i for i in np.argsort([-w for w in way], kind="stable") if way[i] > 0]
        longest = None
        for first in range(0, len(order), TOGETHER):
            some = order[first : first + TOGETHER]
            search.scores([moved[i] for i in some])
            longest = next((moved[i] for i in some if np.min(constraint(moved[i])) >= 0.0), None)
            if longest is not None:
                break
        if longest is None:
            break
        start = longest
    end = minimize(
        lambda u: 0.5 * float(np.sum((u - to) ** 2)),
        start,
        jac=lambda u: u - to,
        method="SLSQP",
        bounds=[(0.0, 1.0)] * start.size,
        constraints=[{"type": "ineq", "fun": constraint, "jac": slopes}],
        options={"maxiter": ITERATIONS, "ftol": 1e-7},
    ).x
    # From afar it may end beside what is allowed; then a part of that way may do.
    for share in PARTS:
        constraint(start + share * (end - start))
    found = min(seen, key=lambda key: seen[key], default=None)
    return theta if found is None else space.from_unit(np.frombuffer(found))


def _runs(space: ParameterSpace) -> list[tuple[int, int]]:
    """First and one past the last entry of every run of neighbours, and of all of theta.

    Neighbours are nodes of one curve, and one of them alone would bend it; entries of two parameters are no neighbours.
    """
    out = [(i, j) for s in space.slices.values() for i in range(s.start, s.stop) for j in range(i + 1, s.stop + 1)]
    whole = (0, space.dimension)
    return out if whole in out else [*out, whole]
