"""The fastest theta that keeps its limits on a whole range of use, by sequential linear programs on drawn plants."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from chargetune.episode.score import Score
from chargetune.learning.closed_loop.loop import samples_of
from chargetune.learning.closed_loop.slp import Point, solve_slp
from chargetune.learning.initial_design import sobol_points
from chargetune.learning.range_of_use.range_verdict import PlantResult, RangeEvaluation, objective_over
from chargetune.learning.range_of_use.worth import without_idle
from chargetune.learning.tuner import TrialLike, check_count
from chargetune.model.parameter_space import ParameterSpace
from chargetune.plants.range_of_use import DrawnPlant

__all__ = ["RangeSettings", "RangeTuner"]


# Searches that go on with corners: each leaves others, fewer ones.
CORNER_ROUNDS = 2


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
        Plants on which starts of the search are compared, the worst of the last trial if there is one, and how many Sobol points are
        among the starts: which is clearly worse shows on a few. Without Sobol points the search begins at the last theta alone.
    corners, extreme
        Draws at the corners of the range, and the share of each number that is farther out. Of those on which the theta found breaks a
        limit the worst join the rows, and the search goes on: hardly one of some ten draws is near a given corner.
    iterations, gain
        Of the search, and the share of the objective that one has to win.
    drop_idle
        Entries of the theta found that are worth nothing on its plants are put back (`without_idle`).
    """

    plants: int = 48
    added: int = 12
    aim: float = 0.5
    first: int = 8
    pool: int = 32
    corners: int = 32
    extreme: float = 0.005
    iterations: int = 20
    gain: float = 5e-4
    # A study's configuration has it.
    drop_idle: bool = field(default=False, metadata={"identity": False})

    def __post_init__(self) -> None:
        for name in ("plants", "added", "first", "pool", "corners", "iterations"):
            value, least = getattr(self, name), int(name not in ("pool", "corners"))
            if isinstance(value, bool) or not isinstance(value, int) or value < least:
                raise ValueError(f"range settings: {name} = {value!r}, allowed is an integer >= {least}")
        for name in ("aim", "gain"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 <= value <= 1:
                raise ValueError(f"range settings: {name} = {value!r}, allowed is [0, 1]")
        if isinstance(self.extreme, bool) or not isinstance(self.extreme, (int, float)) or not 0 < self.extreme < 0.5:
            raise ValueError(f"range settings: extreme = {self.extreme!r}, allowed is (0, 0.5)")


@dataclass(frozen=True)
class RangeTuner:
    """Tuner of `RangeEvaluation`: one theta for all plants of a range of use.

        max over theta of mean_j J_j(theta)  s.t.  e_jk(theta) + m <= aim * tolerance  for every sample k of every plant j chosen on

    (or the worst J_j) by `solve_slp`. The first theta is chosen on `RangeSettings.plants` draws, with the margin m = 0; each trial
    tries a theta on fresh draws. Those on which it was nearest to a limit join the rows, not the mean (the scenario approach with
    sampling and discarding none: Calafiore and Campi, IEEE Trans. Autom. Control 51 (2006) 742). m is by how much their worst excess
    is above the least of theirs, the median over ln 2: the scale of the tail, if it is exponential, beyond what was drawn; one plant that
    is far out joins the rows and does not make all others careful. The result is the best of
    several trials that kept every limit, so its own draws flatter it a little: a certificate draws others.
    """

    evaluation: RangeEvaluation
    seed: int = 0
    settings: RangeSettings = field(default_factory=RangeSettings)

    def ask(self, space: ParameterSpace, trials: Sequence[TrialLike], n: int = 1) -> NDArray[np.float64]:
        """The next theta; of several all are the same one, since each is the best that is known."""
        check_count(n)
        done = [t for t in trials if t.score is not None]
        common, worst = self.evaluation.loop.draw(self.settings.plants, self.seed), [self._worst(trial) for trial in done]
        tail = [one.beyond for one in worst[-1]] if done else [0.0]
        margin = float(np.median(tail) - tail[-1]) / math.log(2.0)
        # The newest trial's worst plants come first: starts are compared on them.
        added = [one.plant for results in reversed(worst) for one in results]
        search = _RangeSearch(self.evaluation, space, common, added, margin, self.settings)
        last = space.to_unit(np.array(done[-1].theta) if done else space.default)
        # From both: near the last theta there is mostly the best one, but not where a violation of it has no slope.
        starts = (last, self._start(space, search, last)) if self.settings.pool else (last,)
        found = [search.refine(start) for start in {u.tobytes(): u for u in starts}.values()]
        search, u = self._at_corners(search, min(found, key=search.merit_of_all))
        theta = space.from_unit(u)
        if self.settings.drop_idle:
            theta = without_idle(self.evaluation, space, theta, search.plants)
        return np.tile(theta, (n, 1))

    def _at_corners(self, search: _RangeSearch, u: NDArray[np.float64]) -> tuple[_RangeSearch, NDArray[np.float64]]:
        """From a point to one that keeps the limits at the corners of the range too, and the search that has them."""
        loop, settings = self.evaluation.loop, self.settings
        corners = list(loop.draw(settings.corners, self.seed, extreme=settings.extreme)) if settings.corners else []
        for _ in range(CORNER_ROUNDS):
            violations = [search.violation(u, one) for one in corners]
            worst = [k for k in np.argsort(violations)[::-1][: settings.added] if violations[k] > 0]
            if not worst:
                break
            search = search.with_rows_of([corners[k] for k in worst])
            corners = [one for k, one in enumerate(corners) if k not in worst]
            u = search.refine(u)
        return search, u

    def _worst(self, trial: TrialLike) -> list[PlantResult]:
        """The plants of a trial that say the most about the limits, the worst first."""
        results = self.evaluation.results(np.array(trial.theta), int(trial.seed))  # type: ignore[attr-defined]
        return sorted(results, key=lambda one: -one.beyond)[: self.settings.added]

    def _start(self, space: ParameterSpace, search: _RangeSearch, last: NDArray[np.float64]) -> NDArray[np.float64]:
        """The best of this point, the two extreme corners and Sobol points on a few plants.

        A start within the limits matters: where the input is saturated, a violation does not change with theta, and beside one that
        cannot be mended all others would be let grow as large.
        """
        corners = [np.zeros(space.dimension), np.ones(space.dimension)]
        points = [last, *corners, *sobol_points(space.dimension, self.seed, 0, self.settings.pool)]
        return min(points, key=search.merit)


class _RangeSearch:
    """Points of the unit cube on several plants: the objective is that of ``common`` ones, rows are those of ``added`` ones too.

    ``margin`` in tolerances.
    """

    def __init__(
        self,
        evaluation: RangeEvaluation,
        space: ParameterSpace,
        common: Sequence[DrawnPlant],
        added: Sequence[DrawnPlant],
        margin: float,
        settings: RangeSettings,
    ) -> None:
        self._evaluation, self._space, self._settings = evaluation, space, settings
        self.plants, self._added, self._margin = [*added, *common], len(added), margin

    def refine(self, start: NDArray[np.float64]) -> NDArray[np.float64]:
        settings = self._settings
        found = solve_slp(self._points, start, settings.iterations, settings.gain)
        return np.clip(found, 0.0, 1.0)

    def merit(self, u: NDArray[np.float64]) -> float:
        """The objective on a few plants, to be minimised, and the worst violation with a penalty."""
        return _merit(self._point(u, self.plants[: self._settings.first]))

    def merit_of_all(self, u: NDArray[np.float64]) -> float:
        """The same on all plants."""
        return _merit(self._point(u, self.plants))

    def violation(self, u: NDArray[np.float64], plant: DrawnPlant) -> float:
        """That of the rows of one plant; inf where it has no verdict."""
        point = self._point(u, [plant])
        return np.inf if point is None else point.violation

    def with_rows_of(self, plants: Sequence[DrawnPlant]) -> _RangeSearch:
        """The same search with the rows of these plants too."""
        added, common = self.plants[: self._added], self.plants[self._added :]
        return _RangeSearch(self._evaluation, self._space, common, [*plants, *added], self._margin, self._settings)

    def _points(self, us: Sequence[NDArray[np.float64]]) -> list[Point | None]:
        return [self._point(u, self.plants) for u in us]

    def _point(self, u: NDArray[np.float64], plants: Sequence[DrawnPlant]) -> Point | None:
        theta = self._space.from_unit(np.clip(u, 0.0, 1.0))
        rows, worth = [], []
        for episode in self._evaluation.loop.simulate([theta] * len(plants), plants):
            score: Score | None = None if episode is None else self._evaluation.loop.score(episode, metrics=False)
            if episode is None or score is None:
                return None
            excess, _ = samples_of(score, self._evaluation.loop.samples(episode), self._settings.aim)
            rows.append(excess + self._margin)
            worth.append(score.objective)
        # The worst plants of trials are no fair sample of what a theta is worth.
        common = worth[self._added :] if len(plants) == len(self.plants) else worth
        return Point(-objective_over(self._evaluation.aim, common), np.concatenate(rows))


def _merit(point: Point | None) -> float:
    """A violation of a whole tolerance counts as a tenth of the objective: fresh plants judge, and the next search mends it."""
    return np.inf if point is None else point.objective + 0.1 * abs(point.objective) * point.violation
