"""Learning on real episodes over a range of use: the same ensemble that theta was first chosen on, conditioned by every trace."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from chargetune.episode.score import Score
from chargetune.learning.range_of_use.conditioned_range import ConditionedRange
from chargetune.learning.range_of_use.range_tuner import RangeSettings, RangeTuner
from chargetune.learning.range_of_use.range_twin import RangeTwinLoop
from chargetune.learning.range_of_use.range_verdict import RangeEvaluation, check_quantile
from chargetune.learning.safety import NoSafeThetaError, Safety
from chargetune.learning.tuner import TrialLike, check_count
from chargetune.learning.twin.ensemble import Learnt, episodes_of, learn
from chargetune.learning.twin.settings import TwinSettings
from chargetune.model.parameter_space import ParameterSpace
from chargetune.runtime.cache import Built

__all__ = ["Choice", "Proposed", "RangeTwinSettings", "RangeTwinTuner"]

# With which the draws that judge a theta have to show that it keeps its limits on the stated share.
CONFIDENCE = 0.95
# Most draws that judge a theta, a minute of charges: 0.9999 can be shown with as many, hardly more is known of any range.
JUDGES_MAX = 30_000
# Proposals that are kept: a study that is opened again asks for the same ones.
_PROPOSED: Built = Built(16, casadi=False)


class Choice(StrEnum):
    """Where a proposed theta is from."""

    DECLARED = "the declared start"
    ROBUST = "chosen on the range of use, without a trace"
    CONDITIONED = "chosen on the plants that the traces leave"
    REPEATED = "no theta is better on the plants that the traces leave; one that was tried is tried again"
    NO_TWIN = "the traces are of no plant of the range: the theta that was chosen without a trace"


@dataclass(frozen=True)
class Proposed:
    """A theta, where it is from, and on which share of fresh draws it kept every limit; None: nothing judged it."""

    theta: tuple[float, ...]
    choice: Choice
    probability: float | None = None
    why: str = ""


@dataclass(frozen=True)
class RangeTwinSettings:
    """Numbers of the learning over a range, each with the reason for its value.

    rounds, judges
        Searches for one theta, each on the plants that were nearest to a limit in those before it, and the fresh draws that judge each;
        more where so few cannot show the demanded probability (0.999: 2995). One search leaves a per cent of the draws beyond a limit,
        three about none.
    first, later
        Settings of the search without a trace, and after one, when what is left differs less. From the last theta alone it stops at one
        that is careful where nothing asks for it any more, so it has other starts too.
    contradicted
        Share of the draws from which a charge that kept its limits contradicts them: if fewer keep them, such a charge had that small a
        chance.
    objective_quantile
        As of `RangeEvaluation`: what theta is chosen for on the draws.
    twin
        Settings of the posterior and of the discrepancy. Episodes begin differently, so that each has an error of its own.
    """

    rounds: int = 4
    judges: int = 300
    contradicted: float = 0.05
    first: RangeSettings = field(default_factory=RangeSettings)
    later: RangeSettings = field(default_factory=lambda: RangeSettings(plants=32, pool=8, iterations=12))
    twin: TwinSettings = field(default_factory=lambda: TwinSettings(of_episode=0.1))
    # A study's configuration has it.
    objective_quantile: float | None = field(default=None, metadata={"identity": False})

    def __post_init__(self) -> None:
        for name in ("rounds", "judges"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise ValueError(f"range twin settings: {name} = {value!r}, allowed is an integer >= 1")
        share = self.contradicted
        if isinstance(share, bool) or not isinstance(share, (int, float)) or not 0 <= share < 1:
            raise ValueError(f"range twin settings: contradicted = {share!r}, allowed is [0, 1)")
        check_quantile("range twin settings", self.objective_quantile)


@dataclass(frozen=True)
class _Round:
    """A theta of a search, as `RangeTuner` reads it."""

    number: int
    theta: tuple[float, ...]
    score: Score | None
    seed: int
    status: str = "done"


@dataclass(frozen=True)
class RangeTwinTuner:
    """Each trial is one real episode, under a condition of its own; the range of use is what is known before the first one.

    1. Without a trace: the declared start, else theta chosen on draws of the range (`RangeTuner`), which no real episode is needed for.
    2. With traces: the numbers of the plant are those that the traces leave (Laplace, with the range as prior), with what the model cannot
       represent (`Discrepancy`); those of the episode are drawn anew, as before. theta is chosen on draws of that in the same way.
    3. It is proposed if it keeps every limit on so many of the fresh draws that they show ``safety.probability`` with a confidence of 95 %
       (of 300 all for 0.99, and 292 for 0.95; of 2995 all for 0.999), and is better there than the theta tried last; else that one again,
       if it does; else whichever keeps them on at least the stated share; else the one of the first trial.
    4. Where the traces are of no plant of the range (`Learnt.rejected`) the first trial's theta again, with a warning. Where the newest
       episode kept every limit, and hardly a draw does with its theta, that one again, with a warning: the draws are not of this plant.

    Deterministic. All thetas of a batch are the same, since the next one needs the trace of this one. ``proposed`` says what was chosen and
    why. Raises `NoSafeThetaError` when the budget of violation is spent.
    """

    loop: RangeTwinLoop
    seed: int = 0
    safety: Safety = field(default_factory=Safety)
    settings: RangeTwinSettings = field(default_factory=RangeTwinSettings)

    def ask(self, space: ParameterSpace, trials: Sequence[TrialLike], n: int = 1) -> NDArray[np.float64]:
        """``n`` times the next theta, shape (n, d)."""
        check_count(n)
        found = self.proposed(space, trials)
        if found.choice in (Choice.NO_TWIN, Choice.REPEATED):
            warnings.warn(f"{found.choice.value}{f' ({found.why})' if found.why else ''}", RuntimeWarning, stacklevel=2)
        return np.tile(np.array(found.theta), (n, 1))

    def proposed(self, space: ParameterSpace, trials: Sequence[TrialLike]) -> Proposed:
        """What `ask` proposes after these trials, and why."""
        if any(t.number < 0 for t in trials):
            raise ValueError(
                "range: there are trials of earlier studies, allowed are this study's own trials: those may be of another plant"
            )
        done = [t for t in trials if t.status != "running"]
        # Its matrices are small: a second thread mostly waits.
        with threadpool_limits(1):
            self._check_budget(done)
            learnt = learn(self.loop, done, self.settings.twin)
            if learnt.discrepancy is None:
                return self._first(space, learnt)
            first = np.array(done[0].theta)
            if learnt.rejected:
                return Proposed(tuple(first), Choice.NO_TWIN, why=learnt.rejected)
            return self._next(space, learnt, done)

    def best(self, space: ParameterSpace, trials: Sequence[TrialLike]) -> int | None:
        """Index of the newest trial with a score: each theta is chosen on all that was known, and is better there than the one before."""
        return max((k for k, t in enumerate(trials) if t.score is not None), default=None)

    def _first(self, space: ParameterSpace, learnt: Learnt) -> Proposed:
        if self.safety.start is not None:
            return Proposed(tuple(float(v) for v in space.validate(np.array(self.safety.start))), Choice.DECLARED)

        def build() -> tuple[Proposed, RangeTwinTuner]:
            theta, kept, _ = self._search(space, ConditionedRange.of(self.loop, learnt, space.default), self.settings.first, 0)
            if kept < self.safety.probability:
                raise NoSafeThetaError(
                    f"no theta keeps every limit on {self.safety.probability:g} of the range of use (the best one: {kept:.3f}); "
                    "declare a start that is safe, or narrow the range"
                )
            # Kept with the tuner: no other object has the address that its text may hold.
            return Proposed(theta, Choice.ROBUST, kept), self

        found, _ = _PROPOSED.get(repr((self, self.loop.twin.content, space)), build)
        return found

    def _next(self, space: ParameterSpace, learnt: Learnt, done: Sequence[TrialLike]) -> Proposed:
        last, number, score = np.array(done[-1].theta), len(done), done[-1].score
        whole = ConditionedRange(self.loop, learnt, last, np.ones(len(last), dtype=bool))
        evaluation, seed = self._evaluation(whole), self._seed(number, self.settings.rounds)
        share, value = _judged(evaluation(last, seed)[0])
        if share < self.settings.contradicted and score is not None and score.feasible:
            why = f"it kept every limit, which it does on {share:.3f} of the draws: these are not of this plant"
            return Proposed(tuple(last), Choice.REPEATED, share, why)
        theta, kept, worth = self._search(space, ConditionedRange.of(self.loop, learnt, last), self.settings.later, number)
        for demanded in (self._surely, self.safety.probability):
            # A last one that keeps the stated share is not given up for one that is surer and slower.
            if kept >= demanded and (share < self.safety.probability or worth > value):
                return Proposed(theta, Choice.CONDITIONED, kept)
            if share >= demanded:
                return Proposed(tuple(last), Choice.REPEATED, share)
        first = np.array(done[0].theta)
        share, _ = _judged(evaluation(first, seed)[0])
        return Proposed(tuple(first), Choice.REPEATED, share, f"the first one keeps every limit on {share:.3f} of them")

    def _evaluation(self, loop: ConditionedRange) -> RangeEvaluation:
        return RangeEvaluation(loop, self._judges, self.settings.objective_quantile)

    def _search(
        self, space: ParameterSpace, loop: ConditionedRange, settings: RangeSettings, number: int
    ) -> tuple[tuple[float, ...], float, float]:
        """The best theta of several rounds, the share of fresh draws that it keeps every limit on, and its objective."""
        part, evaluation, rounds = loop.space(space), self._evaluation(loop), list[_Round]()
        tuner = RangeTuner(evaluation, self._seed(number, -1), settings)
        for k in range(self.settings.rounds):
            # Later rounds only mend what the first one left.
            tuner = replace(tuner, settings=replace(settings, pool=0)) if k else tuner
            theta = tuner.ask(part, rounds)[0]
            seed = self._seed(number, k)
            rounds.append(_Round(k, tuple(float(v) for v in theta), evaluation(theta, seed)[0], seed))

        def rank(one: _Round) -> tuple[int, float]:
            """By the largest of both shares that it keeps, then by the objective; of those that keep neither by the share."""
            share, objective = _judged(one.score)
            tier = int(share >= self.safety.probability) + int(share >= self._surely)
            return tier, objective if tier else share

        best = max(rounds, key=rank)
        return tuple(float(v) for v in loop.whole(np.array(best.theta))), *_judged(best.score)

    @property
    def _surely(self) -> float:
        """The share of fresh draws that is aimed at: the least that shows the stated one (Clopper and Pearson); inf where there is none."""
        from scipy.stats import beta

        kept = np.arange(1, self._judges + 1)
        enough = kept[beta.ppf(1.0 - CONFIDENCE, kept, self._judges - kept + 1) >= self.safety.probability]
        # Half a draw less, so that rounding decides nothing.
        return float(enough[0] - 0.5) / self._judges if enough.size else np.inf

    @property
    def _judges(self) -> int:
        """Fresh draws that judge a theta: if all of n keep the limits, that shows p where p^n <= 1 - confidence."""
        needed = math.ceil(math.log(1.0 - CONFIDENCE) / math.log(self.safety.probability))
        return max(self.settings.judges, min(needed, JUDGES_MAX))

    def _check_budget(self, done: Sequence[TrialLike]) -> None:
        if self.safety.budget is None:
            return
        spent = sum(self.loop.violation(e) for e in episodes_of(done))
        if spent > self.safety.budget:
            raise NoSafeThetaError(f"the budget of violation is spent: {spent:.4g} of {self.safety.budget:g}; nothing was proposed")

    def _seed(self, number: int, part: int) -> int:
        """Of the draws of a search (part -1), of those that judge a round, and of those that judge what was tried before."""
        # A study's own trials have keys of one number, a range's noise and charges other ones.
        state = np.random.SeedSequence(self.seed, spawn_key=(number, part + 1, 5)).generate_state(1, np.uint64)
        return int(state[0]) >> 11


def _judged(score: Score | None) -> tuple[float, float]:
    """Share of the draws that kept every limit, and the objective; of a failed one 0 and -inf."""
    if score is None:
        return 0.0, -np.inf
    plants, over = score.metrics["plants"] or 1.0, score.metrics["violating_plants"] or 0.0
    return 1.0 - over / plants, score.objective
