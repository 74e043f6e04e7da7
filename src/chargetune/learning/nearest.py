"""Nothing is risked for nothing: of the thetas that promise as much, the one nearest to what was tried."""

from __future__ import annotations

from contextlib import suppress

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from chargetune.learning.corner import STEP
from chargetune.learning.twin_search import Search
from chargetune.model.parameters import ParameterSpace

__all__ = ["nearest"]

# A change of theta that promises less than this share of the objective is not worth a risk.
GAIN = 1e-3
ITERATIONS = 12
# Beyond where it starts and where it is to be near it looks no further than this: SLSQP has no trust region, and left for good.
ASIDE = 0.1
# From afar SLSQP may end beside what is allowed: then a part of that way may do.
PARTS = (0.8, 0.6, 0.4, 0.2)
# Samples further inside their limits than so many tolerances say nothing.
FAR = 1000.0
# SLSQP ends a little on the wrong side: of a tolerance, and of the gain.
ROUNDING = 0.1
# SLSQP ends when distance and limits both are within one number of where they should be. In these units a rounding is that number;
# in tolerances it went on for a thousandth of one, four times as long.
CLOSE = 1e-5
UNIT = CLOSE / ROUNDING
# Two iterations that come nearer by less than this share of the first distance, squared, are the last ones after others won more: close to
# its goal the distance is so small beside the limits that SLSQP takes back every step for a thousandth of a tolerance, as long as it may.
NEARER = 0.01
# Below this share of it there is nothing left to go.
ARRIVED = 1e-3
# Where no linear program holds, SLSQP takes back every step until little is left of it, time and again.
STUCK = 5e-4


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
    excess <= allowed at every sample, by its window, in tolerances beyond the tolerance (`windows_of`), by SLSQP with finite differences.

    A change is a step into what has not been seen: entries that what is aimed at does not need stay where they were tried.
    ``search`` simulates the expected plant, so that ``allowed`` is to hold the margins. Where no point is found it is ``start``.
    """
    first, to = space.to_unit(start), space.to_unit(best)
    known = search.samples(first)
    if known is None:
        return start
    count = known[0].size
    worth = GAIN * abs(promised) or GAIN
    seen: dict[bytes, float] = {}

    def left(u: NDArray[np.float64]) -> NDArray[np.float64]:
        """What is left to every sample, in tolerances, and to the objective, in what a risk is worth."""
        score, samples = search.score(u), search.samples(u)
        if score is None or samples is None or samples[0].size != count:
            return np.full(count + 1, -FAR)
        excess, window = samples
        room = np.nan_to_num(allowed[window] - excess, nan=FAR)
        return np.append(np.clip(room, -FAR, FAR), (score.objective - promised) / worth + 1.0)

    def constraint(u: NDArray[np.float64]) -> NDArray[np.float64]:
        values = left(u)
        if float(np.min(values)) >= -ROUNDING:
            seen[np.clip(u, 0.0, 1.0).tobytes()] = float(np.sum((u - to) ** 2))
        return UNIT * values

    def slopes(u: NDArray[np.float64]) -> NDArray[np.float64]:
        steps = np.where(u + STEP <= 1.0, STEP, -STEP)
        around = [u + step for step in np.diag(steps)]
        search.scores(around)
        values, beyond = left(u)[:, None], np.stack([left(ahead) for ahead in around], axis=1)
        # A sample that enters or leaves a window that nothing is known of has no slope.
        return UNIT * np.where((values == FAR) | (beyond == FAR), 0.0, beyond - values) / steps

    way, nearer = [first], [float(np.sum((first - to) ** 2))]

    def follow(u: NDArray[np.float64]) -> None:
        way.append(np.array(u))
        nearer.append(min(seen.values(), default=np.inf))
        before, worth = nearer[-3:][0], NEARER * nearer[0]
        arrived = nearer[-1] <= ARRIVED * nearer[0]
        if arrived or np.max(np.abs(way[-1] - way[-2])) < STUCK or nearer[0] - before >= worth > before - nearer[-1]:
            raise StopIteration

    # Older SciPy lets it through, newer ends there.
    with suppress(StopIteration):
        minimize(
            lambda u: 0.5 * float(np.sum((u - to) ** 2)),
            first,
            jac=lambda u: u - to,
            method="SLSQP",
            bounds=[(max(0.0, low - ASIDE), min(1.0, high + ASIDE)) for low, high in np.sort([first, to], axis=0).T],
            constraints=[{"type": "ineq", "fun": constraint, "jac": slopes}],
            options={"maxiter": ITERATIONS, "ftol": CLOSE},
            callback=follow,
        )
    for share in PARTS:
        constraint(first + share * (way[-1] - first))
    found = min(seen, key=lambda key: seen[key], default=None)
    return start if found is None else space.from_unit(np.frombuffer(found))
