"""Candidates for the next theta: the best on the expected plant, with the margins that an ensemble of plants asks for."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from chargetune.learning.closed_loop.loop import windows_of
from chargetune.learning.closed_loop.search import Search
from chargetune.learning.initial_design import sobol_points
from chargetune.learning.tuner import TrialLike
from chargetune.learning.twin.ensemble import Ensemble, Prediction
from chargetune.model.parameter_space import ParameterSpace

__all__ = ["Candidate", "Proposal"]

# Added to the seed of the plants that candidates are chosen by: that of those which judge.
FRESH = 104_729

Candidate = tuple[NDArray[np.float64], Prediction]
"""A theta and what the ensemble of plants does with it."""


@dataclass(frozen=True)
class Proposal:
    """The search for the next theta of ``space`` after ``trials``; ``seed`` is that of the plants that it is judged on.

    A candidate is accepted where it keeps every limit on at least the share ``probability`` of the ensemble.
    """

    space: ParameterSpace
    ensemble: Ensemble
    trials: Sequence[TrialLike]
    probability: float
    seed: int

    def candidate(self, theta: NDArray[np.float64]) -> Candidate:
        """A theta with what the ensemble does with it, the same plants for every theta."""
        return theta, self.ensemble.predict(theta, self.seed)

    def holds(self, theta: NDArray[np.float64]) -> bool:
        """Whether theta is accepted by fresh plants, which nothing was chosen by.

        Of many candidates that are judged by the same plants those are found that just these allow: their share says too much.
        """
        fresh = self.ensemble.predict(theta, self.seed + FRESH, self.ensemble.settings.judges)
        return fresh.probability() >= self.probability

    def accepts(self, candidate: Candidate) -> bool:
        """Whether it keeps every limit on the share of the ensemble that is asked for."""
        return candidate[1].probability() >= self.probability

    def backtrack(
        self, safe: NDArray[np.float64], aim: NDArray[np.float64], passes: Callable[[NDArray[np.float64]], bool]
    ) -> NDArray[np.float64] | None:
        """The longest part of the way from a theta that passes to one that does not, and that passes; None where no part does."""
        parts = (safe + share * (aim - safe) for share in self.ensemble.settings.steps_back)
        return next((theta for theta in parts if passes(theta)), None)

    def search(self) -> tuple[list[Candidate], Candidate]:
        """(accepted candidates, the best first; the candidate found last).

        Each round solves

            max objective  s.t.  excess <= tolerance - margin  on the expected plant,

        with a proximal term around the best trial (`solve_slp`). The margin of a round is the difference between the upper bound over the
        ensemble and the expected excess at the theta of the round before, by window; 0 in the first round. A margin falls with the
        current that it leads to, so from the third round on it is the mean of the new one and the one before.
        """
        settings, u = self.ensemble.settings, self._start
        margin: NDArray[np.float64] | float = 0.0
        accepted: list[tuple[float, Candidate]] = []
        for k in range(settings.rounds):
            before = u
            start = min((u, self._centre), key=lambda point: self.expected.merit(point, margin))
            u = self.expected.refine(start, settings.iterations, settings.gain, margin, settings.proximal, self._centre)
            candidate, score = self.candidate(self.space.from_unit(u)), self.expected.score(u)
            if score is None:
                break
            if self.accepts(candidate):
                accepted.append((score.objective, candidate))
            if k and np.max(np.abs(u - before)) < settings.settled:
                break
            new = np.maximum(np.nan_to_num(candidate[1].upper_windows((1 + self.probability) / 2) - windows_of(score)), 0.0)
            margin = new if k == 0 else (margin + new) / 2
        ranked = [one for _, one in sorted(accepted, key=lambda one: -one[0])]
        if ranked and not self.accepts(candidate):
            further = self.backtrack(ranked[0][0], candidate[0], lambda theta: self.accepts(self.candidate(theta)))
            ranked = ranked if further is None else [self.candidate(further), *ranked]
        return ranked, candidate

    @cached_property
    def expected(self) -> Search:
        """Verdicts on the expected plant."""
        return Search(self.ensemble.loop, self.ensemble.expected, self.space, self.ensemble.settings.aim)

    @cached_property
    def kept(self) -> list[NDArray[np.float64]]:
        """The thetas that kept every limit as measured, the best first."""
        known = [(t.score.objective, np.array(t.theta)) for t in self.trials if t.score is not None and t.score.feasible]
        return [theta for _, theta in sorted(known, key=lambda one: -one[0])]

    @property
    def _centre(self) -> NDArray[np.float64]:
        return self.space.to_unit(self.kept[0] if self.kept else np.array(self.trials[-1].theta))

    @property
    def _start(self) -> NDArray[np.float64]:
        """The best on the expected plant of the thetas tried so far, theta_0 and Sobol's points."""
        space = self.space
        pool = sobol_points(space.dimension, self.seed, 0, self.ensemble.settings.pool)
        points = [*(space.to_unit(np.array(t.theta)) for t in self.trials), space.to_unit(space.default), *pool]
        self.expected.scores(points)
        return min(points, key=self.expected.merit)
