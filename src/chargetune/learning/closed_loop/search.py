"""The best theta on one simulated plant: envelope steps to come near, linear programs on every sample to arrive."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from chargetune.episode.score import Score
from chargetune.learning.closed_loop.covering import covering
from chargetune.learning.closed_loop.loop import Simulate, samples_of, windows_of
from chargetune.learning.closed_loop.slp import Point, solve_slp
from chargetune.learning.twin.twin_loop import TwinLoop
from chargetune.model.parameter_space import ParameterSpace

__all__ = ["Search"]

# Of a limit's tolerance, by how much less than what it accepts the search aims at: it may end a little on the wrong side.
ROUNDING = 0.05
# Of the objective, what the last step of a search promises at least.
LEAST = 1e-6


class _Seen(NamedTuple):
    """The verdict on an episode, and the samples that it is on (`TwinLoop.samples`)."""

    score: Score
    samples: Mapping[str, tuple[NDArray[np.float64], NDArray[np.int_]]]


class Search:
    """Verdicts on the episodes of one plant by point of the unit cube, remembered.

    ``margin`` is added to the excess of each window, in tolerances; ``share`` of the tolerance may be used, the rest is left to noise and
    to what the twin does not know.
    """

    def __init__(
        self,
        loop: TwinLoop,
        simulate: Simulate,
        space: ParameterSpace,
        margin: NDArray[np.float64] | float = 0.0,
        share: float = 0.0,
    ) -> None:
        self._loop, self._simulate, self._space, self._margin, self._share = loop, simulate, space, margin, share
        self._seen: dict[bytes, _Seen | None] = {}

    def score(self, u: NDArray[np.float64]) -> Score | None:
        return self.scores([u])[0]

    def samples(self, u: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.int_]] | None:
        """The samples at u that `windows_of` are the largest of, and the window of each (`samples_of`); None without a verdict."""
        seen = self._at(u)
        return None if seen is None else samples_of(seen.score, seen.samples)

    def scores(self, points: Sequence[NDArray[np.float64]]) -> list[Score | None]:
        """Verdicts at several points, simulated together."""
        fresh = list({u.tobytes(): u for u in points if u.tobytes() not in self._seen}.values())
        episodes = self._simulate([self._space.from_unit(np.clip(u, 0.0, 1.0)) for u in fresh]) if fresh else []
        for u, episode in zip(fresh, episodes, strict=True):
            score = None if episode is None else self._loop.score(episode)
            self._seen[u.tobytes()] = None if episode is None or score is None else _Seen(score, self._loop.samples(episode))
        return [None if seen is None else seen.score for seen in (self._seen[u.tobytes()] for u in points)]

    def _at(self, u: NDArray[np.float64]) -> _Seen | None:
        self.scores([u])
        return self._seen[u.tobytes()]

    def envelope(self, start: NDArray[np.float64], iterations: int) -> None:
        """From ``start``, ``iterations`` times the theta whose predictions cover what the plant did last; all are remembered."""
        theta = self._space.from_unit(start)
        for _ in range(iterations):
            episode = self._simulate([theta])[0]
            if episode is None:
                return
            theta = covering(self._loop.controller, episode, theta, self._loop.measured_rows(episode))
            self.score(self._space.to_unit(theta))

    def refine(self, start: NDArray[np.float64], iterations: int, gain: float = LEAST) -> None:
        """From ``start`` to the best point near it (`solve_slp`); every point it visits is remembered.

        Its rows are the samples, not the windows of the verdict: the largest of many that all ride their limit has a kink wherever
        another one becomes it, and what is linear about a kink leads nowhere.
        """
        solve_slp(self._points, start, iterations, gain, ROUNDING)

    def _points(self, points: Sequence[NDArray[np.float64]]) -> list[Point | None]:
        self.scores(points)
        return [None if seen is None else self._point(seen) for seen in (self._seen[u.tobytes()] for u in points)]

    def _point(self, seen: _Seen) -> Point:
        excess, window = samples_of(seen.score, seen.samples, self._share - ROUNDING)
        return Point(-seen.score.objective, excess + (self._margin if np.ndim(self._margin) == 0 else np.asarray(self._margin)[window]))

    def merit(self, u: NDArray[np.float64]) -> float:
        """The objective, to be minimised, and the worst violation at its price in `solve_slp`."""
        seen = self._at(u)
        return np.inf if seen is None else abs(seen.score.objective) * max(0.0, self._worst(seen)) - seen.score.objective

    def best(self) -> NDArray[np.float64]:
        """The seen point of the best objective that keeps the limits; else of the least excess."""

        def rank(key: bytes) -> tuple[bool, float]:
            seen = self._seen[key]
            worst = self._worst(seen)
            return worst > 0.0, -seen.score.objective if seen is not None and worst <= 0.0 else worst

        return np.clip(np.frombuffer(min(self._seen, key=rank)), 0.0, 1.0)

    def _worst(self, seen: _Seen | None) -> float:
        """Of the windows, in tolerances; inf where there is no episode."""
        return np.inf if seen is None else float(np.nanmax(windows_of(seen.score, self._share) + self._margin, initial=-np.inf))
