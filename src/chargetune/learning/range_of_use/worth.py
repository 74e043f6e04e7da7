"""What each entry of a theta is worth over a range of use, and theta without those that are worth nothing."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from chargetune.learning.range_of_use.range_verdict import RangeEvaluation, objective_over, run_plants
from chargetune.model.parameter_space import ParameterSpace
from chargetune.plants.range_of_use import DrawnPlant

__all__ = ["EntryWorth", "entry_worths", "without_idle"]

# An objective that is lower by less than this share of it is the same: what the search stops at.
SAME = 5e-4


@dataclass(frozen=True)
class EntryWorth:
    """One entry put back, all others kept: ``lost`` of the objective, and by how many more of the plants break a limit.

    ``put_to``: "untuned", or "neighbours", the mean of those beside it in its table in the scale of the tuner; ``value``: what that is.
    A loss below 0 was bought with limits. ``idle``: it is worth nothing, since no more plants break a limit and nothing is lost.
    """

    entry: str
    put_to: str
    value: float
    lost: float
    more_violating: int
    idle: bool


def entry_worths(
    evaluation: RangeEvaluation, space: ParameterSpace, theta: NDArray[np.float64], plants: Sequence[DrawnPlant]
) -> list[EntryWorth]:
    """For each entry the cheaper way of doing without it, on these plants; the least worth is not first, the order is that of theta."""
    base = _verdict(evaluation, theta, plants)
    out = []
    for i, entry in enumerate(space.entries):
        ways = []
        for put_to, other in _without(space, theta, i):
            violating, objective = _verdict(evaluation, other, plants)
            more, lost = violating - base[0], base[1] - objective
            ways.append(EntryWorth(entry, put_to, float(other[i]), lost, more, _idle(more, lost, base[1])))
        out += [min(ways, key=lambda one: (max(one.more_violating, 0), one.lost))] if ways else []
    return out


def without_idle(
    evaluation: RangeEvaluation, space: ParameterSpace, theta: NDArray[np.float64], plants: Sequence[DrawnPlant]
) -> NDArray[np.float64]:
    """Theta with every entry put back that is worth nothing, one after the other, the cheapest first.

    All together they lose at most the share `SAME` of the objective, and no more plants break a limit.
    """
    base, found = _verdict(evaluation, theta, plants), theta
    idle = [one for one in entry_worths(evaluation, space, theta, plants) if one.idle]
    for one in sorted(idle, key=lambda worth: worth.lost):
        i = space.entries.index(one.entry)
        # Of its neighbours some may have been put back by now.
        other = dict(_without(space, found, i)).get(one.put_to)
        if other is None:
            continue
        violating, objective = _verdict(evaluation, other, plants)
        if _idle(violating - base[0], base[1] - objective, base[1]):
            found = other
    return found


def _idle(more: int, lost: float, objective: float) -> bool:
    return more <= 0 and lost <= SAME * abs(objective)


def _verdict(evaluation: RangeEvaluation, theta: NDArray[np.float64], plants: Sequence[DrawnPlant]) -> tuple[int, float]:
    """Plants that break a limit or do not come to their end, and the objective over the others."""
    scores = [one.score for one in run_plants(evaluation.loop, theta, plants)]
    known = [score.objective for score in scores if score is not None]
    violating = sum(score is None or not score.feasible for score in scores)
    return violating, objective_over(evaluation.objective_quantile, known) if known else -np.inf


def _without(space: ParameterSpace, theta: NDArray[np.float64], i: int) -> Iterator[tuple[str, NDArray[np.float64]]]:
    """Theta without entry i: untuned, and tied to its neighbours where it has some; only where that changes it."""
    unit, rest = space.to_unit(theta), space.to_unit(space.default)
    beside = _beside(space, i)
    ways = [("untuned", rest[i]), *([("neighbours", float(np.mean(unit[beside])))] if beside else [])]
    for put_to, value in ways:
        if abs(value - unit[i]) > 1e-9:
            other = unit.copy()
            other[i] = value
            yield put_to, space.from_unit(other)


def _beside(space: ParameterSpace, i: int) -> list[int]:
    """The entries beside this one along each axis of its table."""
    p, first = next((p, part.start) for p, part in zip(space.parameters, space.slices.values(), strict=True) if part.start <= i < part.stop)
    at, out = [int(k) for k in np.unravel_index(i - first, p.shape)], []
    for axis, count in enumerate(p.shape):
        for step in (-1, 1):
            place = list(at)
            place[axis] += step
            if 0 <= place[axis] < count:
                out.append(first + int(np.ravel_multi_index(place, p.shape)))
    return out
