"""Tuning by a twin: learn the plant from whole traces, then tune the controller on what was learnt."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from chargetune.episode.episode import Episode
from chargetune.episode.score import Score
from chargetune.learning.tuner import TrialLike, check_count, initial_design, sobol_points
from chargetune.learning.twin import Posterior, Twin
from chargetune.model.parameters import ParameterSpace

__all__ = ["TracedTrial", "TwinLoop", "TwinTuner"]

# Traces beyond the newest ones add time and hardly information: each holds some hundred samples.
TRACES_MAX = 6
# Objective and excess are scaled to their spread over the pool, so that one step and one penalty fit any problem.
PENALTY = 10.0
# Of a limit's tolerance: what the search aims at, and what it accepts, since SLSQP ends a little on the wrong side. The rest
# is left to noise and to what the twin does not know.
AIMED, ACCEPTED = 0.25, 0.75
STEP = 2e-3


class TracedTrial(TrialLike, Protocol):
    """A trial whose measured episode can be read; None when it has none."""

    @property
    def episode(self) -> Callable[[], Episode | None] | None: ...


class TwinLoop(Protocol):
    """The user's closed loop on the twin: what is unknown of the plant, and an episode of any plant of that kind."""

    @property
    def twin(self) -> Twin: ...

    def simulate(self, theta: NDArray[np.float64], unknowns: NDArray[np.float64]) -> Score | None:
        """The verdict on a noise-free episode with the controller at theta and the plant at ``unknowns``; None when it fails."""
        ...


@dataclass(frozen=True)
class TwinTuner:
    """First theta_0; then the theta that is best on the twin's posterior mode, further ones of a batch on posterior draws.

    Each theta solves max objective s.t. excess <= tolerance, in every window where the score has a profile, on the
    simulated closed loop: SLSQP with finite differences of ``STEP`` in the unit cube, from the ``starts`` best of ``pool``
    Sobol points, theta_0 and the thetas tried so far, and from the theta tried last. The best point seen that keeps the
    limits is proposed. Deterministic: the same trials give the same thetas. Without a single trace the design is Sobol's.
    """

    loop: TwinLoop
    seed: int = 0
    pool: int = 128
    starts: int = 2
    iterations: int = 25

    def ask(self, space: ParameterSpace, trials: Sequence[TrialLike], n: int = 1) -> NDArray[np.float64]:
        """``n`` thetas, shape (n, d). Raises ValueError when n is no count."""
        check_count(n)
        posterior = None if not trials else self.posterior(trials)
        if posterior is None:
            out = initial_design(space, max(n, len(trials) + n), self.seed, len(trials), n)
            return out[:n]
        plants = np.vstack([posterior.mode, posterior.draw(n, self.seed + len(trials))])[:n]
        known = [space.to_unit(np.array(t.theta)) for t in trials]
        return np.array([self._best(space, plant, known) for plant in plants])

    def posterior(self, trials: Sequence[TrialLike]) -> Posterior | None:
        """What the traces of these trials say; None when there is none."""
        readers = [reader for t in trials if (reader := getattr(t, "episode", None)) is not None]
        episodes = [e for reader in readers[-TRACES_MAX:] if (e := reader()) is not None and len(e)]
        return self.loop.twin.fit(episodes) if episodes else None

    def _best(self, space: ParameterSpace, plant: NDArray[np.float64], known: list[NDArray[np.float64]]) -> NDArray[np.float64]:
        search = _Search(self.loop, space, plant)
        first = [space.to_unit(space.default), *known, *sobol_points(space.dimension, self.seed, 0, self.pool)]
        search.scale(first)
        ordered = sorted(first, key=search.merit)
        # The theta tried last is where the twin knows the plant best; on its own it may be a local optimum.
        for start in (*ordered[: self.starts], *known[-1:]):
            search.refine(start, self.iterations)
        return space.from_unit(search.best())


class _Search:
    """Values of objective and excesses on one plant, remembered by point."""

    def __init__(self, loop: TwinLoop, space: ParameterSpace, plant: NDArray[np.float64]) -> None:
        self._loop, self._space, self._plant = loop, space, plant
        self._seen: dict[bytes, tuple[float, NDArray[np.float64]]] = {}
        self._beyond: dict[bytes, float] = {}
        self._unit = (1.0, 1.0)
        self._slopes: dict[bytes, tuple[NDArray[np.float64], NDArray[np.float64]]] = {}

    def scale(self, points: Sequence[NDArray[np.float64]]) -> None:
        raw = [self.values(u) for u in points]
        objective = [value for value, _ in raw if np.isfinite(value)]
        excess = np.concatenate([np.maximum(e, 0.0) for _, e in raw]) if raw else np.zeros(1)
        self._unit = (float(np.ptp(objective)) or 1.0 if objective else 1.0, float(np.max(excess, initial=0.0)) or 1.0)

    def values(self, u: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        """(objective to be minimised, excess less tolerance of every limit and window), scaled."""
        key = u.tobytes()
        if key not in self._seen:
            score = self._loop.simulate(self._space.from_unit(np.clip(u, 0.0, 1.0)), self._plant)
            self._seen[key] = (np.inf, np.zeros(0)) if score is None else (-score.objective, _constraints(score, AIMED))
            self._beyond[key] = np.inf if score is None else float(np.max(_constraints(score, ACCEPTED)))
        value, excess = self._seen[key]
        return value / self._unit[0], excess / self._unit[1]

    def merit(self, u: NDArray[np.float64]) -> float:
        value, excess = self.values(u)
        return float(value + PENALTY * np.sum(np.maximum(excess, 0.0)))

    def slopes(self, u: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        key = u.tobytes()
        if key not in self._slopes:
            value, excess = self.values(u)
            gradient, jacobian = np.zeros(u.size), np.zeros((excess.size, u.size))
            for i in range(u.size):
                step = STEP if u[i] + STEP <= 1.0 else -STEP
                ahead = u.copy()
                ahead[i] += step
                other, beyond = self.values(ahead)
                if np.isfinite(other) and beyond.shape == excess.shape:
                    gradient[i] = (other - value) / step
                    both = (excess > -1.0) & (beyond > -1.0)
                    jacobian[both, i] = (beyond[both] - excess[both]) / step
            self._slopes[key] = gradient, jacobian
        return self._slopes[key]

    def refine(self, start: NDArray[np.float64], iterations: int) -> None:
        if not np.isfinite(self.values(start)[0]):
            return
        constraint: dict[str, Any] = {
            "type": "ineq",
            "fun": lambda u: -np.maximum(self.values(u)[1], -1.0),
            "jac": lambda u: -self.slopes(u)[1],
        }
        minimize(
            lambda u: self.values(u)[0],
            start,
            jac=lambda u: self.slopes(u)[0],
            method="SLSQP",
            bounds=[(0.0, 1.0)] * start.size,
            constraints=[constraint],
            options={"maxiter": iterations, "ftol": 1e-6},
        )

    def best(self) -> NDArray[np.float64]:
        """The seen point of the best objective that keeps the limits, else the one of the least worst excess."""

        def rank(key: bytes) -> tuple[bool, float]:
            worst = self._beyond[key]
            return worst > 0, self._seen[key][0] if worst <= 0 else worst

        return np.clip(np.frombuffer(min(self._seen, key=rank)), 0.0, 1.0)


def _constraints(score: Score, share: float) -> NDArray[np.float64]:
    """Excess less this share of its tolerance, one entry a limit, or one a window where there is a profile.

    A window that was not visited is -inf: it is kept, and says nothing of a slope.
    """
    out: list[float] = []
    for name, worst in score.excess.items():
        tolerance = share * score.tolerance.get(name, 0.0)
        windows = score.profile.get(name, (worst,))
        out += [-np.inf if w is None else w - tolerance for w in windows]
    return np.array(out)
