"""The verdict on one theta over many plants of a range of use."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from chargetune.episode.episode import Episode
from chargetune.episode.score import Score
from chargetune.learning.range_of_use.range_loop import RangeLoop
from chargetune.learning.range_of_use.range_trace import RangeTrace
from chargetune.plants.range_of_use import DrawnPlant
from chargetune.runtime.counted import counted

__all__ = ["PlantResult", "RangeEvaluation", "check_quantile", "objective_over", "run_plants"]

# Episodes that are simulated together: what they recorded has to fit into memory.
BATCH = 64


@dataclass(frozen=True)
class PlantResult:
    """One theta on one drawn plant; no score where the episode did not come to its end."""

    plant: DrawnPlant
    episode: Episode | None
    score: Score | None

    @property
    def beyond(self) -> float:
        """Worst excess less tolerance, in tolerances; inf without a score."""
        return float("inf") if self.score is None else self.score.worst


def run_plants(loop: RangeLoop, theta: NDArray[np.float64], plants: Sequence[DrawnPlant]) -> list[PlantResult]:
    """This theta on each of these plants."""
    out = []
    for first in range(0, len(plants), BATCH):
        batch = plants[first : first + BATCH]
        for plant, episode in zip(batch, loop.simulate([theta] * len(batch), batch), strict=True):
            out.append(PlantResult(plant, episode, None if episode is None else loop.score(episode)))
    return out


def objective_over(quantile: float | None, values: Sequence[float]) -> float:
    """What a theta is worth over plants: their mean, or with a ``quantile`` what this share of them has at least; 1: the worst of them."""
    return float(np.mean(values) if quantile is None else np.quantile(values, 1.0 - quantile))


def check_quantile(where: str, quantile: float | None) -> None:
    """Raises ValueError unless this is None or a number in [0, 1]."""
    if quantile is not None and (isinstance(quantile, bool) or not isinstance(quantile, (int, float)) or not 0 <= quantile <= 1):
        raise ValueError(f"{where}: objective_quantile = {quantile!r}, allowed is [0, 1], or None for the mean")


@dataclass(frozen=True)
class RangeEvaluation:
    """What a study runs: a trial is one theta on ``plants`` draws that are made of the trial's own seed.

    So no draw that chose a theta judges it. The score's objective is that over the plants, its excesses are the worst of any plant;
    ``metrics`` hold how many plants broke a limit, of how many, and every figure of the plants as mean, or as largest
    (`RangeLoop.largest_of`). The trace holds the figures of every plant and three episodes (`RangeTrace`); the others follow from the
    seed (`results`). A plant whose episode did not come to its end fails the trial.

    objective_quantile
        None: the objective is the mean over the plants. Else what so large a share of them has at least; of a charging time what this
        share needs at most. 1: the worst of them.
    """

    loop: RangeLoop
    plants: int = 1000
    objective_quantile: float | None = None

    def __post_init__(self) -> None:
        if isinstance(self.plants, bool) or not isinstance(self.plants, int) or self.plants < 1:
            raise ValueError(f"range evaluation: plants = {self.plants!r}, allowed is an integer >= 1")
        check_quantile("range evaluation", self.objective_quantile)

    def results(self, theta: NDArray[np.float64], seed: int) -> list[PlantResult]:
        """Every plant of the trial with this seed."""
        return run_plants(self.loop, theta, self.loop.draw(self.plants, seed))

    def __call__(self, theta: NDArray[np.float64], seed: int) -> tuple[Score | None, RangeTrace | None, str]:
        results = self.results(theta, seed)
        trace, failed = self._trace(results), sum(one.score is None for one in results)
        if failed:
            return None, trace, f"{failed} of {counted(len(results), 'plant')}: the episode did not come to an end or have no verdict"
        return self._score(results), trace, "done"

    def _trace(self, results: Sequence[PlantResult]) -> RangeTrace | None:
        """None where no plant's episode came to its end."""
        ended = [(one.beyond, place, one.episode) for place, one in enumerate(results) if one.episode is not None]
        if not ended:
            return None
        ended.sort(key=lambda one: one[:2])
        three = {"worst": ended[-1], "median": ended[(len(ended) - 1) // 2], "best": ended[0]}
        places = {name: place for name, (_, place, _) in three.items()}
        return RangeTrace(**{name: episode for name, (_, _, episode) in three.items()}, places=places, plants=self._table(results))

    def _table(self, results: Sequence[PlantResult]) -> dict[str, NDArray[np.float64]]:
        rows: list[dict[str, float | None]] = []
        for one in results:
            row: dict[str, float | None] = {f"drawn {n}": v[0] for n, v in one.plant.values.items() if len(v) == 1}
            if one.score is not None:
                row |= {"objective": one.score.objective, **{f"excess of {n}": v for n, v in one.score.excess.items()}}
                row |= one.score.metrics
            rows.append(row)
        names = dict.fromkeys(name for row in rows for name in row)
        return {name: np.array([np.nan if row.get(name) is None else row[name] for row in rows], dtype=float) for name in names}

    def _score(self, results: Sequence[PlantResult]) -> Score:
        scores = [one.score for one in results if one.score is not None]
        metrics: dict[str, float | None] = {
            "violating_plants": float(sum(not score.feasible for score in scores)),
            "plants": float(len(scores)),
            "objective_worst": min(score.objective for score in scores),
        }
        for name in scores[0].metrics:
            values = [v for score in scores if (v := score.metrics.get(name)) is not None]
            # A mean over those that got there would praise the theta that leaves the slow ones out.
            over = max if name in self.loop.largest_of else np.mean
            metrics[name] = float(over(values)) if len(values) == len(scores) else None
        return Score(
            objective=objective_over(self.objective_quantile, [score.objective for score in scores]),
            performance=objective_over(self.objective_quantile, [score.performance for score in scores]),
            excess={name: max(score.excess[name] for score in scores) for name in scores[0].excess},
            tolerance=dict(scores[0].tolerance),
            metrics=metrics,
        )
