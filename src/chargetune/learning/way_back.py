"""Nothing is risked for nothing: entries of theta whose change promises nothing go back to where they were in the best trial."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from chargetune.learning.belief import windows_of
from chargetune.learning.twin_search import Search
from chargetune.model.parameters import ParameterSpace

__all__ = ["way_back"]

# A change of theta that promises less than this share of the objective is not worth a risk.
GAIN = 1e-3
# Runs of neighbouring entries that go back, one after the other, and how many ways back are simulated together.
BACKS, TOGETHER = 3, 16


def way_back(
    search: Search,
    space: ParameterSpace,
    best: NDArray[np.float64],
    theta: NDArray[np.float64],
    upper: NDArray[np.float64],
    shares: tuple[float, ...],
) -> NDArray[np.float64]:
    """``theta`` with all entries whose change promises nothing moved by these shares of the way back to ``best``, the best trial's theta.

    A change is a step into what has not been seen. Where no change promises anything, and a whole way back is allowed, it is ``best``.
    ``upper`` is the upper side of the excess by window at ``theta``; its distance to what is expected there is held on the way.
    ``search`` simulates the expected plant.
    """
    own = search.score(space.to_unit(theta))
    if own is None:
        return theta
    margin = np.nan_to_num(upper - windows_of(own))
    most = max(0.0, float(np.nanmax(windows_of(own) + margin)))

    def promised(points: list[NDArray[np.float64]]) -> NDArray[np.float64]:
        scores = search.scores([space.to_unit(p) for p in points])
        kept = [s is not None and float(np.nanmax(windows_of(s) + margin)) <= most for s in scores]
        return np.array([s.objective if s is not None and k else -np.inf for s, k in zip(scores, kept, strict=True)])

    ahead, least = (float(value) for value in promised([best, theta]))
    least -= GAIN * abs(least)
    if ahead >= least and shares[0] == 1.0:
        return best
    runs = _runs(space)
    for share in shares:
        for _ in range(BACKS):
            moved = [np.concatenate([theta[:i], (theta + share * (best - theta))[i:j], theta[j:]]) for i, j in runs]
            way = [float(np.sum(np.abs(one - theta) / (space.upper - space.lower))) for one in moved]
            # The longest way back that costs nothing: it is looked for from the longest on.
            order = [i for i in np.argsort([-w for w in way], kind="stable") if way[i] > 0]
            parts = (order[first : first + TOGETHER] for first in range(0, len(order), TOGETHER))
            free = (i for part in parts for i, value in zip(part, promised([moved[k] for k in part]), strict=True) if value >= least)
            longest = next(free, None)
            if longest is None:
                break
            theta = moved[longest]
    return theta


def _runs(space: ParameterSpace) -> list[tuple[int, int]]:
    """First and one past the last entry of every run of neighbours, and of all of theta.

    Neighbours are nodes of one curve, and one of them alone would bend it; entries of two parameters are no neighbours.
    """
    out = [(i, j) for s in space.slices.values() for i in range(s.start, s.stop) for j in range(i + 1, s.stop + 1)]
    whole = (0, space.dimension)
    return out if whole in out else [*out, whole]
