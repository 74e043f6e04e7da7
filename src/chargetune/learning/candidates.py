"""What one ask works with: the ensemble after these trials, and what it foretells of a theta."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from chargetune.learning.candidate_choice import Candidate, choose_candidate
from chargetune.learning.closed_loop.covering import covering
from chargetune.learning.closed_loop.loop import windows_of
from chargetune.learning.closed_loop.search import Search
from chargetune.learning.tuner import TrialLike
from chargetune.learning.twin.ensemble import Ensemble, Prediction
from chargetune.learning.twin.twin_loop import TwinLoop
from chargetune.model.parameter_space import ParameterSpace

__all__ = ["Proposal"]

# Plants of an ensemble; the standard error of a probability of 0.95 is 0.039. Twice as many before the twin has predicted_before a trial:
# its plants are far apart, and the sd of few of them decided by chance whether the second trial was 2 mV below the limit or 4 above.
DRAWS, DRAWS_UNPROVED = 32, 64
# Of a limit's tolerance, what the upper side of the prediction may use after an envelope step and a search. The rest is for what the few
# standard deviations that are taken back without a promise do not hold.
AIMED = 0.5
# Iterations of the search that follows the envelope steps.
POLISHING = 8
# Of the objective, what an iteration of it has to promise, and it in all.
WON = 2e-3
# Of the objective, what another search would have to win.
WORTH = 0.01


@dataclass(frozen=True)
class Proposal:
    """One ask for thetas of ``space``, with what is believed of the plant after ``trials``; ``seed`` is of its draws."""

    loop: TwinLoop
    space: ParameterSpace
    ensemble: Ensemble
    trials: Sequence[TrialLike]
    seed: int
    aimed: ClassVar[float] = AIMED

    def draw(self) -> None:
        """Begins to draw the plants of `predicted`, while something else goes on."""
        self.ensemble.draw(self.draws, self.seed)

    @property
    def draws(self) -> int:
        """Plants of an ensemble."""
        return DRAWS if self.ensemble.proved else DRAWS_UNPROVED

    def predicted(self, theta: NDArray[np.float64]) -> Prediction:
        """What an ensemble of plants does with theta, the same plants for every theta."""
        return self.ensemble.predict(theta, self.draws, self.seed)

    def tried(self, trial: TrialLike) -> Candidate:
        """The theta of a trial with what an ensemble of plants does under the inputs of that trial, where they were recorded."""
        reader = getattr(trial, "episode", None)
        episode = None if reader is None else reader()
        theta = np.array(trial.theta)
        return self.candidate(theta) if episode is None else (theta, self.ensemble.replayed(episode, DRAWS, self.seed))

    def candidate(self, theta: NDArray[np.float64]) -> Candidate:
        return theta, self.predicted(theta)

    def covered(self, candidate: Candidate, deviations: float) -> NDArray[np.float64] | None:
        """An envelope step by so many sd of the ensemble; None where there is nothing to step from."""
        theta, predicted = candidate
        expected, rows = self.ensemble.central(theta), predicted.upper_rows(deviations)
        if expected is None or rows is None:
            return None
        return covering(self.loop.controller, expected, theta, rows - self.aimed * self.loop.row_tolerances)

    def polished(self, candidate: Candidate, deviations: float) -> Candidate:
        """From a candidate on, the best theta on the expected plant that keeps so many sd of the candidate's ensemble back."""
        theta, predicted = candidate
        expected = self.ensemble.central(theta)
        score = None if expected is None else self.loop.score(expected)
        if score is None or not predicted.scores:
            return candidate
        margin = np.nan_to_num(predicted.upper_windows(deviations) - windows_of(score))
        search = Search(self.loop, self.ensemble.expected, self.space, margin, self.aimed)
        start = self.space.to_unit(theta)
        search.refine(start, POLISHING, WON)
        return self.candidate(self.space.from_unit(search.best()))

    def as_good(self, theta: NDArray[np.float64], other: NDArray[np.float64], share: float = WORTH) -> bool:
        """Whether the objective expected of theta is that of another, less this share of it at most."""
        mine, its = self.ensemble.scores([theta, other])
        return mine is not None and its is not None and mine.objective >= its.objective - share * abs(its.objective)

    def choose_candidate(self, candidates: Sequence[Candidate]) -> Candidate:
        return choose_candidate(self.ensemble, self.space, self.trials, candidates, self.seed)

    def moved(self, before: NDArray[np.float64], theta: NDArray[np.float64]) -> float:
        """The largest change of an entry, as a share of its range."""
        return float(np.max(np.abs(theta - before) / (self.space.upper - self.space.lower)))
