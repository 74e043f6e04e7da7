"""A range of use after traces: plants that they leave, each with fresh episodes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from chargetune.episode.episode import Episode
from chargetune.episode.score import Score
from chargetune.learning.range_of_use.range_twin import RangeTwinLoop
from chargetune.learning.twin.ensemble import Learnt
from chargetune.model.parameter_space import ParameterSpace
from chargetune.plants.range_of_use import DrawnPlant

__all__ = ["ConditionedRange"]


@dataclass(frozen=True)
class ConditionedRange:
    """The `RangeLoop` of what traces leave of a range: theta is chosen on it as on the range itself.

    A draw is a plant of the posterior with its own discrepancy, in an episode of the range: what is of the episode is drawn anew. Without
    a trace it is the range. With ``theta`` only the entries that ``searched`` names are searched: a loop's thetas are those entries, the
    others are ``theta``'s.
    """

    loop: RangeTwinLoop
    learnt: Learnt
    theta: NDArray[np.float64]
    searched: NDArray[np.bool_]

    @classmethod
    def of(cls, loop: RangeTwinLoop, learnt: Learnt, theta: NDArray[np.float64]) -> ConditionedRange:
        """Entries of the controller's model are those of the expected plant; all others are searched, from theta on."""
        matched = loop.matched(learnt.posterior.mode)
        searched = np.ones(len(theta), dtype=bool) if matched is None else ~matched[1]
        return cls(loop, learnt, np.asarray(theta) if matched is None else np.where(searched, theta, matched[0]), searched)

    @property
    def largest_of(self) -> tuple[str, ...]:
        return self.loop.largest_of

    def space(self, space: ParameterSpace) -> ParameterSpace:
        """Of the space of the whole theta the part that is searched, with theta's own entries as the default."""
        parts = []
        for one in space.parameters:
            at = space.slices[one.name]
            if self.searched[at].all():
                parts.append(replace(one, default=tuple(float(v) for v in self.theta[at])))
        return ParameterSpace(tuple(parts))

    def whole(self, searched: NDArray[np.float64]) -> NDArray[np.float64]:
        """The whole theta of these searched entries."""
        out = self.theta.copy()
        out[self.searched] = searched
        return out

    def draw(self, count: int, seed: int, *, extreme: float | None = None) -> list[DrawnPlant]:
        known, discrepancy = self._drawn, self.learnt.discrepancy
        if discrepancy is None:
            return list(self.loop.draw(count, seed, extreme=extreme))
        key = count, seed, extreme
        if key not in known:
            scores = discrepancy.posterior.draw_scores(count, seed)
            seeds = [int(s) for s in np.random.SeedSequence(seed).generate_state(count)]
            errors = discrepancy.samples(self.loop.twin.unknowns_at(scores), self.learnt.scale, seeds)
            plants = self.loop.draw(count, seed, scores, extreme=extreme)
            known[key] = [replace(one, error=error.table) for one, error in zip(plants, errors, strict=True)]
        return known[key]

    def simulate(self, thetas: Sequence[NDArray[np.float64]], plants: Sequence[DrawnPlant]) -> list[Episode | None]:
        return self.loop.simulate([self.whole(theta) for theta in thetas], plants)

    def score(self, episode: Episode, *, metrics: bool = True) -> Score | None:
        return self.loop.score(episode, metrics=metrics)

    def samples(self, episode: Episode) -> Mapping[str, tuple[NDArray[np.float64], NDArray[np.int_]]]:
        return self.loop.samples(episode)

    @cached_property
    def _drawn(self) -> dict[tuple[int, int, float | None], list[DrawnPlant]]:
        return {}
