"""Closed loops of one controller on the plants of a range of use, and the verdict on them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from chargetune.control.controller import Controller
from chargetune.episode.compiled import CompiledEpisode, compiled_episode
from chargetune.episode.episode import Ending, Episode
from chargetune.episode.score import Score
from chargetune.episode.score_limits import ScoredLimit, limit_samples, score_limits
from chargetune.model.given import Given, checked_given
from chargetune.plants.range_of_use import DrawnPlant, OwnDraws, RangeOfUse

__all__ = ["RangeLoop", "SimulatedRange"]


class RangeLoop(Protocol):
    """Draws of a range of use, and closed loops on them that are judged by their true outputs."""

    @property
    def largest_of(self) -> tuple[str, ...]:
        """Metrics of which the largest of all plants counts; of the others it is their mean."""
        ...

    def draw(self, count: int, seed: int, *, extreme: float | None = None) -> Sequence[DrawnPlant]:
        """So many plants with their episodes; more draws of a seed begin with the same ones. ``extreme``: `RangeOfUse.draw`."""
        ...

    def simulate(self, thetas: Sequence[NDArray[np.float64]], plants: Sequence[DrawnPlant]) -> list[Episode | None]:
        """The episode of each theta on the plant of the same place, with its true outputs; None where it did not come to its end."""
        ...

    def score(self, episode: Episode, *, metrics: bool = True) -> Score | None:
        """The verdict on an episode, without figures for people where ``metrics`` is False; None when it has none."""
        ...

    def samples(self, episode: Episode) -> Mapping[str, tuple[NDArray[np.float64], NDArray[np.int_]]]:
        """By limit of the score the excess of every sample, and its window (`episode.score_limits.limit_samples`)."""
        ...


@dataclass(frozen=True)
class SimulatedRange:
    """The `RangeLoop` of a controller and a simulated plant whose numbers differ (`Variation`), or draws of yours (`OwnDraws`).

    The estimator reads what the drawn sensors measure; the limits are judged by the true outputs, `ScoredLimit` by `ScoredLimit`.
    ``given``: the given signals of controller and plant, one set for all draws or several cases (days, forecasts), of which each draw
    has the one that its seed draws.
    """

    controller: Controller
    range_of_use: RangeOfUse | OwnDraws
    steps: int
    limits: tuple[ScoredLimit, ...]
    objective: Callable[[Episode], float]
    largest_of: tuple[str, ...] = ()
    given: Given | Sequence[Given] | None = None

    def __post_init__(self) -> None:
        names = tuple(dict.fromkeys((*self.controller.given_names, *self.range_of_use.plant.given)))
        if not self._cases:
            raise ValueError("range: given has no case, allowed is one set of signals or several")
        for case in self._cases:
            checked_given(names, case, self.steps, self.controller.horizon)

    @property
    def _cases(self) -> list[Given]:
        return [self.given or {}] if self.given is None or isinstance(self.given, Mapping) else list(self.given)

    def draw(self, count: int, seed: int, scores: NDArray[np.float64] | None = None, *, extreme: float | None = None) -> list[DrawnPlant]:
        return self.range_of_use.draw(count, seed, scores=scores, extreme=extreme)

    def simulate(self, thetas: Sequence[NDArray[np.float64]], plants: Sequence[DrawnPlant]) -> list[Episode | None]:
        cases = self._cases
        told = [cases[one.seed % len(cases)] for one in plants]
        episodes = self._loop.run_each(list(thetas), [one.plant for one in plants], [one.seed for one in plants], given=told)
        return [e.noise_free() if e.ending is Ending.DONE else None for e in episodes]

    def score(self, episode: Episode, *, metrics: bool = True) -> Score | None:
        return score_limits(episode, self.limits, objective=self.objective).score

    def samples(self, episode: Episode) -> dict[str, tuple[NDArray[np.float64], NDArray[np.int_]]]:
        return limit_samples(episode, self.limits)

    @cached_property
    def _loop(self) -> CompiledEpisode:
        return compiled_episode(self.controller, self.range_of_use.plant, self.steps)
