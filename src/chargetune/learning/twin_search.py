"""The best theta on one simulated plant: envelope steps to come near, SLSQP on objective and excess to arrive."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from chargetune.episode.score import Score
from chargetune.learning.belief import Simulate, TwinLoop, windows_of
from chargetune.learning.envelope import covering
from chargetune.model.parameters import ParameterSpace

__all__ = ["Search"]

# Objective and excess are scaled to their spread over the pool, so that one step and one penalty fit any problem.
PENALTY = 10.0
# Of a limit's tolerance: what the search aims at, and what it accepts, since SLSQP ends a little on the wrong side. The rest
# is left to noise and to what the twin does not know.
AIMED, ACCEPTED = -0.5, 0.0
STEP = 2e-3
# Where no linear program holds, SLSQP takes back every step until little is left of it, time and again.
STUCK = 5e-4
# Far inside a limit its excess says nothing: windows are cut here, in scaled units.
FAR = -1.0


class Search:
    """Verdicts on the episodes of one plant by point of the unit cube, remembered.

    ``margin`` is added to the excess of each window, in tolerances.
    """

    def __init__(
        self,
        loop: TwinLoop,
        simulate: Simulate,
        space: ParameterSpace,
        margin: NDArray[np.float64] | float = 0.0,
    ) -> None:
        self._loop, self._simulate, self._space, self._margin = loop, simulate, space, margin
        self._seen: dict[bytes, Score | None] = {}
        self._slopes: dict[bytes, tuple[NDArray[np.float64], NDArray[np.float64]]] = {}
        self._unit = (1.0, 1.0)

    def score(self, u: NDArray[np.float64]) -> Score | None:
        return self.scores([u])[0]

    def scores(self, points: Sequence[NDArray[np.float64]]) -> list[Score | None]:
        """Verdicts at several points, simulated together."""
        fresh = list({u.tobytes(): u for u in points if u.tobytes() not in self._seen}.values())
        episodes = self._simulate([self._space.from_unit(np.clip(u, 0.0, 1.0)) for u in fresh]) if fresh else []
        for u, episode in zip(fresh, episodes, strict=True):
            self._seen[u.tobytes()] = None if episode is None else self._loop.score(episode)
        return [self._seen[u.tobytes()] for u in points]

    def envelope(self, start: NDArray[np.float64], iterations: int) -> None:
        """From ``start``, ``iterations`` times the theta whose predictions cover what the plant did last; all are remembered."""
        theta = self._space.from_unit(start)
        for _ in range(iterations):
            episode = self._simulate([theta])[0]
            if episode is None:
                return
            theta = covering(self._loop.controller, episode, theta, self._loop.measured_rows(episode))
            self.score(self._space.to_unit(theta))

    def scale(self, points: Sequence[NDArray[np.float64]]) -> None:
        """Take the units from the spread over these points."""
        scores = [s for s in self.scores(points) if s is not None]
        objective = [s.objective for s in scores]
        excess = [float(np.nanmax(windows_of(s, AIMED), initial=0.0)) for s in scores]
        self._unit = (float(np.ptp(objective)) or 1.0 if objective else 1.0, max(excess, default=0.0) or 1.0)

    def refine(self, start: NDArray[np.float64], iterations: int, gain: float = 0.0, than: NDArray[np.float64] | None = None) -> None:
        """SLSQP with finite differences of ``STEP``; every point it visits is remembered.

        With a ``gain`` it ends with the first iteration that wins less than this share of the objective after others won more, and
        with one that hardly moves (`STUCK`). What counts is the objective of what `best` would choose with ``than``.
        """
        if self.score(start) is None:
            return
        allowed = self._allowed(than)
        won, way = [self._won(allowed)], [start]

        def follow(u: NDArray[np.float64]) -> None:
            won.append(self._won(allowed))
            way.append(np.array(u))
            worth = gain * abs(won[-1])
            stuck = gain > 0.0 and np.max(np.abs(way[-1] - way[-2])) < STUCK
            if stuck or won[-2] - won[0] >= worth > won[-1] - won[-2]:
                raise StopIteration

        constraint: dict[str, Any] = {
            "type": "ineq",
            "fun": lambda u: -np.maximum(self._values(u)[1], FAR),
            "jac": lambda u: -self._derivatives(u)[1],
        }
        # Older SciPy lets it through, newer ends there.
        with suppress(StopIteration):
            minimize(
                lambda u: self._values(u)[0],
                start,
                jac=lambda u: self._derivatives(u)[0],
                method="SLSQP",
                bounds=[(0.0, 1.0)] * start.size,
                constraints=[constraint],
                options={"maxiter": iterations, "ftol": 1e-6},
                callback=follow,
            )

    def merit(self, u: NDArray[np.float64]) -> float:
        value, excess = self._values(u)
        return float(value + PENALTY * np.sum(np.maximum(excess, 0.0)))

    def best(self, start: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
        """The seen point of the best objective that keeps the limits, or breaks them as little as ``start``; else of the least excess."""
        allowed = self._allowed(start)

        def rank(key: bytes) -> tuple[bool, float]:
            score = self._seen[key]
            worst = self._worst(score)
            return worst > allowed, -score.objective if score is not None and worst <= allowed else worst

        return np.clip(np.frombuffer(min(self._seen, key=rank)), 0.0, 1.0)

    def _allowed(self, start: NDArray[np.float64] | None) -> float:
        return 0.0 if start is None else max(0.0, self._worst(self.score(start)))

    def _won(self, allowed: float) -> float:
        """The best objective seen whose windows are all at most as allowed; -inf where there is none."""
        return max((s.objective for s in self._seen.values() if s is not None and self._worst(s) <= allowed), default=-np.inf)

    def _worst(self, score: Score | None) -> float:
        """Of the windows, in tolerances; inf where there is no episode."""
        return np.inf if score is None else float(np.nanmax(windows_of(score, ACCEPTED) + self._margin, initial=-np.inf))

    def _values(self, u: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        """(objective to be minimised, excess beyond what is aimed at, of every window; -inf where none was visited), scaled."""
        score = self.score(u)
        if score is None:
            return np.inf, np.zeros(0)
        excess = windows_of(score, AIMED) + self._margin
        return -score.objective / self._unit[0], np.where(np.isfinite(excess), excess, -np.inf) / self._unit[1]

    def _derivatives(self, u: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        key = u.tobytes()
        if key not in self._slopes:
            value, excess = self._values(u)
            gradient, jacobian = np.zeros(u.size), np.zeros((excess.size, u.size))
            steps = np.where(u + STEP <= 1.0, STEP, -STEP)
            around = [u + step for step in np.diag(steps)]
            self.scores(around)
            for i, (step, ahead) in enumerate(zip(steps, around, strict=True)):
                other, beyond = self._values(ahead)
                if np.isfinite(other) and beyond.shape == excess.shape:
                    gradient[i] = (other - value) / step
                    both = np.isfinite(excess) & np.isfinite(beyond)
                    jacobian[both, i] = (beyond[both] - excess[both]) / step
            jacobian[excess <= FAR] = 0.0
            self._slopes[key] = gradient, jacobian
        return self._slopes[key]
