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

    (or a quantile of J_j) by `solve_slp`. The first theta is chosen on `RangeSettings.plants` draws, with the margin m = 0; each trial
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
        search, u = self._mended(search, min(found, key=search.merit_of_all))
        search, u = self._at_corners(search, u)
        theta = space.from_unit(u)
        if self.settings.drop_idle:
            theta = without_idle(self.evaluation, space, theta, search.plants)
        return np.tile(theta, (n, 1))

    def _at_corners(self, search: _RangeSearch, u: NDArray[np.float64]) -> tuple[_RangeSearch, NDArray[np.float64]]:
        """From a point to one that keeps the limits at the corners of the range too, and the search that has them."""
        loop, settings = self.evaluation.loop, self.settings
        corners = list(loop.draw(settings.corners, self.seed, extreme=settings.extreme)) if settings.corners else []
        for _ in range(CORNER_ROUNDS):
            violations = search.violations(u, corners)
            worst = [k for k in np.argsort(violations)[::-1][: settings.added] if violations[k] > 0]
            if not worst:
                break
            search = search.with_rows_of([corners[k] for k in worst])
            corners = [one for k, one in enumerate(corners) if k not in worst]
            search, u = self._mended(search, search.refine(u))
        return search, u

    def _mended(self, search: _RangeSearch, u: NDArray[np.float64]) -> tuple[_RangeSearch, NDArray[np.float64]]:
        """Where a search ended beyond a tolerance on many drawn plants: the same from the best of a few points on all plants.

        Where the input is saturated a violation has no slope, and beside one that is not mended all others are let grow as large. If that
        mends it not, what each plant has left at its best point is left behind, where so fewer plants are beyond a tolerance. As many
        plants as a trial adds are mended by the next search.
        """
        few = self.settings.added
        if search.broken(u) <= few:
            return search, u
        points = [u, np.zeros(u.size), np.ones(u.size), *sobol_points(u.size, self.seed, 0, self.settings.pool)]
        begin = min(points, key=search.merit_of_all)
        if begin is not u:
            points[0] = u = min(u, search.refine(begin), key=search.merit_of_all)
        if search.broken(u) <= few:
            return search, u
        relaxed = search.leaving_behind(points)
        found = relaxed.refine(min(points, key=relaxed.merit_of_all))
        return (relaxed, found) if search.broken(found) < search.broken(u) else (search, u)

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

    ``margin`` in tolerances; ``left`` is the violation of each of all plants that is left behind, in tolerances; None: of none.
    """

    def __init__(
        self,
        evaluation: RangeEvaluation,
        space: ParameterSpace,
        common: Sequence[DrawnPlant],
        added: Sequence[DrawnPlant],
        margin: float,
        settings: RangeSettings,
        left: Sequence[float] | None = None,
    ) -> None:
        self._evaluation, self._space, self._settings = evaluation, space, settings
        self.plants, self._added, self._margin = [*added, *common], len(added), margin
        self._left = [0.0] * len(self.plants) if left is None else list(left)

    def refine(self, start: NDArray[np.float64]) -> NDArray[np.float64]:
        settings = self._settings
        found = solve_slp(self._points, start, settings.iterations, settings.gain)
        return np.clip(found, 0.0, 1.0)

    def merit(self, u: NDArray[np.float64]) -> float:
        """The objective on a few plants, to be minimised, and the worst violation with a penalty."""
        return _merit(self._point(u, self._settings.first))

    def merit_of_all(self, u: NDArray[np.float64]) -> float:
        """The same on all plants."""
        return _merit(self._point(u))

    def broken(self, u: NDArray[np.float64]) -> int:
        """On how many plants a limit is broken by more than its tolerance, or there is no verdict."""
        return int(np.sum(self.violations(u, self.plants) > 1.0 - self._settings.aim + self._margin))

    def violations(self, u: NDArray[np.float64], plants: Sequence[DrawnPlant], left: Sequence[float] | None = None) -> NDArray[np.float64]:
        """That of each of these plants; inf where it has no verdict."""
        found = self._of_each(u, plants, [0.0] * len(plants) if left is None else left)
        return np.array([np.inf if one is None else float(np.max(one[0], initial=0.0)) for one in found])

    def with_rows_of(self, plants: Sequence[DrawnPlant]) -> _RangeSearch:
        """The same search with the rows of these plants too."""
        return self._with([*plants, *self.plants[: self._added]], [*[0.0] * len(plants), *self._left])

    def leaving_behind(self, points: Sequence[NDArray[np.float64]]) -> _RangeSearch:
        """The same search without what each plant violates at the best of these points too."""
        least = np.min([self.violations(u, self.plants, self._left) for u in points], axis=0)
        return self._with(self.plants[: self._added], self._left + np.where(np.isfinite(least), least, 0.0))

    def _with(self, added: Sequence[DrawnPlant], left: Sequence[float] | NDArray[np.float64]) -> _RangeSearch:
        common = self.plants[self._added :]
        return _RangeSearch(self._evaluation, self._space, common, added, self._margin, self._settings, [float(v) for v in left])

    def _points(self, us: Sequence[NDArray[np.float64]]) -> list[Point | None]:
        return [self._point(u) for u in us]

    def _point(self, u: NDArray[np.float64], first: int | None = None) -> Point | None:
        """Of all plants, or the first so many."""
        found = self._of_each(u, self.plants[:first], self._left[:first])
        if None in found:
            return None
        known = [one for one in found if one is not None]
        # The worst plants of trials are no fair sample of what a theta is worth.
        common = [worth for _, worth in (known[self._added :] if first is None else known)]
        return Point(-objective_over(self._evaluation.objective_quantile, common), np.concatenate([rows for rows, _ in known]))

    def _of_each(
        self, u: NDArray[np.float64], plants: Sequence[DrawnPlant], left: Sequence[float]
    ) -> list[tuple[NDArray[np.float64], float] | None]:
        """Rows and objective of each plant; None where it has no verdict."""
        theta, loop = self._space.from_unit(np.clip(u, 0.0, 1.0)), self._evaluation.loop
        found: list[tuple[NDArray[np.float64], float] | None] = []
        for episode, behind in zip(loop.simulate([theta] * len(plants), plants), left, strict=True):
            score: Score | None = None if episode is None else loop.score(episode, metrics=False)
            if episode is None or score is None:
                found.append(None)
                continue
            excess, _ = samples_of(score, loop.samples(episode), self._settings.aim)
            found.append((excess + (self._margin - behind), score.objective))
        return found


def _merit(point: Point | None) -> float:
    """A violation of a whole tolerance counts as a tenth of the objective: fresh plants judge, and the next search mends it."""
    return np.inf if point is None else point.objective + 0.1 * abs(point.objective) * point.violation
