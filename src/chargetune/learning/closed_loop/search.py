"""The best theta on one simulated plant, by sequential linear programs on every sample."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from chargetune.episode.score import Score
from chargetune.learning.closed_loop.loop import JudgedLoop, Simulate, samples_of, windows_of
from chargetune.learning.closed_loop.slp import Point, solve_slp
from chargetune.model.parameter_space import ParameterSpace

__all__ = ["Search"]

# Safety gap as a share of the tolerance: a linear program ends a little on the wrong side.
GAP = 0.05


class _Seen(NamedTuple):
    """The verdict on an episode, and the samples that it is on (`JudgedLoop.samples`)."""

    score: Score
    samples: Mapping[str, tuple[NDArray[np.float64], NDArray[np.int_]]]


class Search:
    """Verdicts on the episodes of one plant by point of the unit cube, remembered; points are compared by what margins are kept.

    ``margin`` is added to the excess of each window, in tolerances; ``share`` of the tolerance may be used.
    """

    def __init__(self, loop: JudgedLoop, simulate: Simulate, space: ParameterSpace, share: float = 0.0) -> None:
        self._loop, self._simulate, self._space, self._share = loop, simulate, space, share
        self._seen: dict[bytes, _Seen | None] = {}

    def score(self, u: NDArray[np.float64]) -> Score | None:
        """The verdict at one point; None where there is no episode or it has none."""
        return self.scores([u])[0]

    def scores(self, points: Sequence[NDArray[np.float64]]) -> list[Score | None]:
        """Verdicts at several points, simulated together."""
        fresh = list({u.tobytes(): u for u in points if u.tobytes() not in self._seen}.values())
        episodes = self._simulate([self._space.from_unit(np.clip(u, 0.0, 1.0)) for u in fresh]) if fresh else []
        for u, episode in zip(fresh, episodes, strict=True):
            score = None if episode is None else self._loop.score(episode)
            self._seen[u.tobytes()] = None if episode is None or score is None else _Seen(score, self._loop.samples(episode))
        return [None if seen is None else seen.score for seen in (self._seen[u.tobytes()] for u in points)]

    def refine(
        self,
        start: NDArray[np.float64],
        iterations: int,
        gain: float,
        margin: NDArray[np.float64] | float = 0.0,
        proximal: float = 0.0,
        centre: NDArray[np.float64] | None = None,
    ) -> NDArray[np.float64]:
        """From ``start`` to the best point near it (`solve_slp`).

        Its rows are the samples, not the windows of the verdict: the largest of many that all ride their limit has a kink wherever
        another one becomes it, and what is linear about a kink leads nowhere.
        """

        def points(us: Sequence[NDArray[np.float64]]) -> list[Point | None]:
            self.scores(us)
            return [None if seen is None else self._point(seen, margin) for seen in (self._seen[u.tobytes()] for u in us)]

        return np.clip(solve_slp(points, start, iterations, gain, GAP, proximal, centre), 0.0, 1.0)

    def _point(self, seen: _Seen, margin: NDArray[np.float64] | float) -> Point:
        excess, window = samples_of(seen.score, seen.samples, self._share - GAP)
        return Point(-seen.score.objective, excess + (margin if np.ndim(margin) == 0 else np.asarray(margin)[window]))

    def merit(self, u: NDArray[np.float64], margin: NDArray[np.float64] | float = 0.0) -> float:
        """The objective, to be minimised, and the worst violation at the penalty that `solve_slp` begins with."""
        score = self.score(u)
        if score is None:
            return np.inf
        worst = float(np.nanmax(windows_of(score, self._share) + margin, initial=-np.inf))
        return abs(score.objective) * max(0.0, worst) - score.objective
