"""The fastest theta that keeps its limits on a whole range of use, by sequential linear programs on drawn plants."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from chargetune.episode.score import Score
from chargetune.learning.closed_loop.loop import samples_of
from chargetune.learning.closed_loop.slp import Point, solve_slp
from chargetune.learning.initial_design import sobol_points
from chargetune.learning.range_of_use.range_verdict import RangeEvaluation, objective_over
from chargetune.learning.tuner import TrialLike, check_count
from chargetune.model.parameter_space import ParameterSpace
from chargetune.plants.range_of_use import DrawnPlant

__all__ = ["RangeSettings", "RangeTuner"]


@dataclass(frozen=True)
class RangeSettings:
    """Numbers of the search over a range of use, each with the reason for its value.

    plants
        Draws that the first theta is chosen on. A theta of some ten entries rests on about as many of them.
    added
        Of each trial the plants nearest to a limit, or farthest beyond it, that the next theta is chosen on too.
    aim
        Share of a limit's tolerance that a plant may use; the rest is for plants that were not drawn.
    first, pool
        Plants on which Sobol points are compared before the search begins, and how many: which is clearly worse shows on a few.
    iterations, gain
        Of the search, and the share of the objective that one has to win.
    """

    plants: int = 48
    added: int = 12
    aim: float = 0.5
    first: int = 8
    pool: int = 32
    iterations: int = 20
    gain: float = 5e-4

    def __post_init__(self) -> None:
        for name in ("plants", "added", "first", "pool", "iterations"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise ValueError(f"range settings: {name} = {value!r}, allowed is an integer >= 1")
        for name in ("aim", "gain"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 <= value <= 1:
                raise ValueError(f"range settings: {name} = {value!r}, allowed is [0, 1]")


@dataclass(frozen=True)
class RangeTuner:
    """Tuner of `RangeEvaluation`: one theta for all plants of a range of use.

        max over theta of mean_j J_j(theta)  s.t.  e_jk(theta) <= aim * tolerance  for every sample k of every plant j chosen on

    (or the worst J_j) by `solve_slp`. The first theta is chosen on `RangeSettings.plants` draws; each trial tries a theta on fresh
    draws, and those on which it was nearest to a limit are chosen on too from then on (the scenario approach with sampling and
    discarding none: Calafiore and Campi, IEEE Trans. Autom. Control 51 (2006) 742). A trial that kept every limit on all its fresh
    draws is evidence that the share of plants that break one is small: with none of 300 it is at most 1 % with confidence 95 %.
    """

    evaluation: RangeEvaluation
    seed: int = 0
    settings: RangeSettings = field(default_factory=RangeSettings)

    def ask(self, space: ParameterSpace, trials: Sequence[TrialLike], n: int = 1) -> NDArray[np.float64]:
        """The next theta; of several all are the same one, since each is the best that is known."""
        check_count(n)
        done = [t for t in trials if t.score is not None]
        plants = [*self.evaluation.loop.draw(self.settings.plants, self.seed), *self._worst(done)]
        search = _RangeSearch(self.evaluation, space, plants, self.settings)
        start = space.to_unit(np.array(done[-1].theta)) if done else self._first(space, search)
        return np.tile(space.from_unit(search.refine(start)), (n, 1))

    def _worst(self, trials: Sequence[TrialLike]) -> list[DrawnPlant]:
        """Of each trial the plants that say the most about the limits."""
        out = []
        for trial in trials:
            results = self.evaluation.results(np.array(trial.theta), int(trial.seed))  # type: ignore[attr-defined]
            out += [one.plant for one in sorted(results, key=lambda one: -one.beyond)[: self.settings.added]]
        return out

    def _first(self, space: ParameterSpace, search: _RangeSearch) -> NDArray[np.float64]:
        """The best of theta_0, the two extreme corners and Sobol points on a few plants.

        A start within the limits matters: where the input is saturated, a violation does not change with theta.
        """
        corners = [np.zeros(space.dimension), np.ones(space.dimension)]
        points = [space.to_unit(space.default), *corners, *sobol_points(space.dimension, self.seed, 0, self.settings.pool)]
        return min(points, key=search.merit)


class _RangeSearch:
    """Points of the unit cube on several plants at once."""

    def __init__(self, evaluation: RangeEvaluation, space: ParameterSpace, plants: Sequence[DrawnPlant], settings: RangeSettings) -> None:
        self._loop, self._aim, self._space, self._plants, self._settings = evaluation.loop, evaluation.aim, space, plants, settings

    def refine(self, start: NDArray[np.float64]) -> NDArray[np.float64]:
        settings = self._settings
        found = solve_slp(self._points, start, settings.iterations, settings.gain)
        return np.clip(found, 0.0, 1.0)

    def merit(self, u: NDArray[np.float64]) -> float:
        """The objective on a few plants, to be minimised, and the worst violation at the penalty that `solve_slp` begins with."""
        point = self._point(u, self._plants[: self._settings.first])
        return np.inf if point is None else point.objective + abs(point.objective) * point.violation

    def _points(self, us: Sequence[NDArray[np.float64]]) -> list[Point | None]:
        return [self._point(u, self._plants) for u in us]

    def _point(self, u: NDArray[np.float64], plants: Sequence[DrawnPlant]) -> Point | None:
        theta = self._space.from_unit(np.clip(u, 0.0, 1.0))
        rows, worth = [], []
        for episode in self._loop.simulate([theta] * len(plants), plants):
            score: Score | None = None if episode is None else self._loop.score(episode, metrics=False)
            if episode is None or score is None:
                return None
            excess, _ = samples_of(score, self._loop.samples(episode), self._settings.aim)
            rows.append(excess)
            worth.append(score.objective)
        return Point(-objective_over(self._aim, worth), np.concatenate(rows))
