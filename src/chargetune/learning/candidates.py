"""Candidates for the next theta: the best on the expected plant, with the margins that an ensemble of plants asks for."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from chargetune.episode.score import Score
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
        return self.fresh(theta).probability() >= self.probability

    def fresh(self, theta: NDArray[np.float64]) -> Prediction:
        """What `holds` judges by: theta on plants of their own seed."""
        return self.ensemble.predict(theta, self.seed + FRESH, self.ensemble.settings.judges)

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

        with a proximal term around the best trial (`solve_slp`). A margin is the difference between the upper bound over the ensemble and
        the expected excess, by window, at one theta: in the first round at the best trial's, then the mean of the last margin and of that
        at the theta found, because a margin grows with the current that it allows.
        """
        settings, theta = self.ensemble.settings, self.space.from_unit(self._centre)
        margin, _ = self._margin(self.candidate(theta))
        accepted: list[tuple[float, Candidate]] = []
        refused: list[tuple[float, Candidate]] = []
        starts = [self._centre, self._start]
        for _ in range(settings.rounds):
            start = min(starts, key=lambda point: self.expected.merit(point, margin))
            u = self.expected.refine(start, settings.iterations, settings.gain, margin, settings.proximal, self._centre)
            candidate = self.candidate(self.space.from_unit(u))
            new, score = self._margin(candidate)
            if score is None:
                break
            (accepted if self.accepts(candidate) else refused).append((score.objective, candidate))
            margin = (margin + new) / 2
            starts.append(u)
        ranked = [one for _, one in sorted(accepted, key=lambda one: -one[0])]
        if not ranked:
            return [], candidate
        # A refused candidate may promise more: go as far towards the most probable of them as is accepted.
        ahead = [one for objective, one in refused if objective > max(value for value, _ in accepted)]
        aim = max(ahead, key=lambda one: one[1].probability(), default=ranked[0])
        further = self.backtrack(ranked[0][0], aim[0], lambda theta: self.accepts(self.candidate(theta))) if ahead else None
        return ranked if further is None else [self.candidate(further), *ranked], candidate

    def _margin(self, candidate: Candidate) -> tuple[NDArray[np.float64] | float, Score | None]:
        """By window, in tolerances, and the verdict on the expected plant; half of what is not promised is kept back."""
        score = self.expected.score(self.space.to_unit(candidate[0]))
        if score is None:
            return 0.0, None
        upper = candidate[1].upper_windows((1 + self.probability) / 2)
        return np.maximum(np.nan_to_num(upper - windows_of(score)), 0.0), score

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
