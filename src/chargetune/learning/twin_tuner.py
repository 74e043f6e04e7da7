"""Tuning by a twin: learn the plant from whole traces, then tune the controller on what was learnt."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm
from threadpoolctl import threadpool_limits

from chargetune.learning.belief import Belief, Prediction, TwinLoop, believe, episodes_of, windows_of
from chargetune.learning.constrained import ConstrainedLogEI
from chargetune.learning.corrected import Candidate, most_promising
from chargetune.learning.envelope import covering
from chargetune.learning.nearest import nearest
from chargetune.learning.safety import NoSafeThetaError, Safety
from chargetune.learning.tuner import TrialLike, check_count, initial_design, sobol_points
from chargetune.learning.twin_search import AIMED as SEARCHED
from chargetune.learning.twin_search import Search
from chargetune.model.parameters import ParameterSpace

__all__ = ["TwinTuner"]

# Times more wrong than allowed for, at which a twin is none.
MISTAKEN = 3.5
# Plants of an ensemble; the standard error of a probability of 0.95 is 0.039. Twice as many before the twin has foretold a trial:
# its plants are far apart, and the sd of few of them decided by chance whether the second trial was 2 mV below the limit or 4 above.
DRAWS, DRAWS_UNPROVED = 32, 64
# Envelope steps on the upper side of the prediction, which is that at the theta found last.
ROUNDS = 7
# A round that moves no entry by more than this share of its range was the last one.
SETTLED = 2e-3
# Beyond one limit's quantile, because several windows have to hold together.
TOGETHER = 1.0
# How sure a safe belief is that its errors are at most as large as it takes them for: few stretches tell, and as with Student's
# quantiles, the fewer there are the more is left to allow for.
SURE = 0.84
# Before it has foretold a trial the twin is trusted less: its prior is no more than a guess.
UNPROVED = 1.5
# Standard deviations that are taken back where nothing is promised; the acquisition chooses, none among them.
CAUTION = (2.0, 3.0)
# Envelope steps that take them back.
STEPS_BACK = 2
# Factor on the deviations where that does not suffice.
WIDER = 1.25
# Two starts that are closer than this share of the range in every entry lead to one end.
APART = 0.1
# Iterations of the search that ends it.
POLISHING = 8
# Times that the nearest theta that promises as much is looked for, each time with the margins of the one before.
NEARINGS = 3
# Shares of the way there: the longest that is safe is gone where none of these was.
PARTS = (0.8, 0.5)
# Of a limit's tolerance, what the upper side of the prediction may use.
AIMED = 0.5


@dataclass(frozen=True)
class TwinTuner:
    """First theta_0; then the theta that is best on the plant as the traces so far show it.

    Algorithm 1 with the twin's prediction of the score as the prior mean m(theta). Candidates begin where max objective s.t.
    excess <= tolerance, in every window where the score has a profile, is solved on the simulated closed loop with the twin at its
    posterior mode plus the mean discrepancy (`Search`), from theta_0, ``pool`` Sobol points and the thetas tried so far. They are
    envelope steps from there, by several sd of an ensemble (`CAUTION`), and the first of them polished. Constrained log expected
    improvement, on m corrected by the Gaussian process of what the trials left of it, picks one (`most_promising`). Further thetas of
    a batch, and those proposed beside running trials, are best on posterior draws. Deterministic: the same trials give the same
    thetas. Without a single trace the design is Sobol's.

    Where the newest trial differs from what those before it foretold by `MISTAKEN` times what was expected or more, the twin
    is no twin, and the black box `ConstrainedLogEI` proposes, with a warning.

    With ``safety`` the theta is one whose controller predicts the upper side of the belief: envelope steps (`covering`) on mean
    plus some sd of an ensemble of plants. Candidates are those that keep every limit on a share of the ensemble of at least the
    stated probability, and the same acquisition picks; the first theta is the declared start, or the most cautious corner. Where
    no such theta is found the best one tried that is still predicted to be safe is proposed again, with a warning; where there is
    none, or the budget of violation is spent, `NoSafeThetaError` is raised and nothing reaches the plant. Further thetas of a batch,
    and those proposed beside running trials, are the other candidates that passed; where there are too few they are repeated.
    """

    loop: TwinLoop
    seed: int = 0
    safety: Safety | None = None
    pool: int = 32
    steps: int = 5
    iterations: int = 10

    def ask(self, space: ParameterSpace, trials: Sequence[TrialLike], n: int = 1) -> NDArray[np.float64]:
        """``n`` thetas, shape (n, d). Raises ValueError when n is no count, `NoSafeThetaError`."""
        check_count(n)
        # Its matrices are small: a second thread mostly waits, and on a busy machine it waits ten times as long as one works.
        with threadpool_limits(1):
            return self._ask(space, trials, n)

    def _ask(self, space: ParameterSpace, trials: Sequence[TrialLike], n: int) -> NDArray[np.float64]:
        if self.safety:
            # A trial that is running has shown nothing yet, and what it tries need not be tried twice.
            running = [np.array(t.theta) for t in trials if t.status == "running"]
            safe = self._safe(space, [t for t in trials if t.status != "running"], self.safety)
            fresh = [theta for theta in safe if not any(np.array_equal(theta, other) for other in running)] or safe
            return np.array([fresh[i % len(fresh)] for i in range(n)])
        belief = believe(self.loop, trials) if trials else None
        if belief is None or belief.discrepancy is None:
            out = initial_design(space, max(n, len(trials) + n), self.seed, len(trials), n)
            return out[:n]
        if belief.mistake >= MISTAKEN and len(trials) > 2:
            warnings.warn(
                f"the twin did not foresee the last trial (off by {belief.mistake:.0f} times what it allows for): "
                "this proposal is the black box's",
                RuntimeWarning,
                stacklevel=2,
            )
            return ConstrainedLogEI(self.seed).ask(space, trials, n)
        first = self._points(space, trials)
        # What is best on the expected plant is on its way already when a trial is running.
        pending = any(t.status == "running" for t in trials)
        drawn = [belief.plant(self.seed + 7919 * len(trials) + k) for k in range(n if pending else n - 1)]
        plants = drawn if pending else [belief.expected, *drawn]
        searches = [self._searched(Search(self.loop, plant, space), first) for plant in plants]
        thetas = [space.from_unit(search.best()) for search in searches]
        if pending:
            return np.array(thetas)
        seed = self.seed + 7919 * len(trials)
        best, _ = most_promising(belief, space, trials, self._cautious(space, belief, thetas[0], seed), seed)
        return np.array([best, *thetas[1:]])

    def best(self, space: ParameterSpace, trials: Sequence[TrialLike]) -> int | None:
        """Index of the trial that is believed best: the best objective expected of those that keep every limit more likely than not.

        No single measurement decides whether it kept them, all traces do; where none is likely to, the likeliest. None without traces.
        """
        with threadpool_limits(1):
            belief = believe(self.loop, trials)
            if belief.discrepancy is None:
                return None
            seed = self.seed + 7919 * len(trials)
            predicted = {k: _predicted(belief, np.array(t.theta), seed) for k, t in enumerate(trials) if t.score is not None}

        def rank(k: int) -> tuple[float, float]:
            scores = predicted[k].scores
            objective = float(np.mean([s.objective for s in scores])) if scores else -np.inf
            return min(predicted[k].probability(), 0.5), objective

        return max(predicted, key=rank, default=None)

    def _points(self, space: ParameterSpace, trials: Sequence[TrialLike]) -> list[NDArray[np.float64]]:
        """Where a search may begin: theta_0, Sobol's points, the thetas tried so far, the last one last."""
        known = [space.to_unit(np.array(t.theta)) for t in trials]
        return [space.to_unit(space.default), *sobol_points(space.dimension, self.seed, 0, self.pool), *known]

    def _searched(self, search: Search, first: list[NDArray[np.float64]]) -> Search:
        search.scale(first)
        for start in (first[0], first[-1]):
            search.envelope(start, self.steps)
        search.refine(search.best(), self.iterations)
        # The best of the pool, in case a step by what is covered is not the way to it, and it has not led there.
        other = min(first, key=search.merit)
        if np.max(np.abs(other - search.best())) > APART:
            search.refine(other, self.iterations)
        return search

    def _safe(self, space: ParameterSpace, trials: Sequence[TrialLike], safety: Safety) -> list[NDArray[np.float64]]:
        """Every theta that is known to be safe enough for the next trial, each once, the most promising first."""
        belief = believe(self.loop, trials, SURE)
        if belief.discrepancy is None:
            # Trials that left no trace have taught nothing.
            return [self._start(space, belief, safety)]
        self._check_budget(trials, safety)
        seed = self.seed + 7919 * len(trials)
        deviations = float(norm.ppf(safety.probability)) + (TOGETHER if belief.proved else TOGETHER + UNPROVED)
        # What the plant would allow if the belief were true: from there on caution only takes back.
        theta = self._covered(belief, np.array(trials[-1].theta))
        passed: list[tuple[float, Candidate]] = []
        for k in range(ROUNDS):
            expected, predicted = belief.central(theta), _predicted(belief, theta, seed)
            score = None if expected is None else self.loop.score(expected)
            rows = predicted.upper_rows(deviations)
            if expected is None or score is None or rows is None:
                break
            if predicted.probability() >= safety.probability:
                passed.append((score.objective, (theta, predicted)))
            elif k > 1:
                deviations *= WIDER
            following = covering(self.loop.controller, expected, theta, rows - AIMED * self.loop.row_tolerances)
            # A margin is smaller at the smaller current that it leads to: two thetas would answer each other for ever.
            theta, before = following if k < 1 else (theta + following) / 2, theta
            if passed and _moved(space, before, theta) < SETTLED:
                break
        if not passed:
            return [self._tried(trials, belief, safety, seed)]
        candidates = [one for _, one in sorted(passed, key=lambda one: -one[0])]
        if belief.proved:
            polished = self._polished(space, belief, *candidates[0], deviations)
            predicted = _predicted(belief, polished, seed)
            if predicted.probability() >= safety.probability:
                candidates.insert(0, (polished, predicted))
        theta, predicted = most_promising(belief, space, trials, candidates, seed)
        # After a single trial the others are further ahead, and the prior has not yet been wrong.
        others = [other for other, _ in candidates if belief.proved and not np.array_equal(other, theta)]
        near = self._nearer(space, belief, trials, theta, predicted, deviations, safety, seed)
        return [near, *others]

    def _nearer(
        self,
        space: ParameterSpace,
        belief: Belief,
        trials: Sequence[TrialLike],
        theta: NDArray[np.float64],
        predicted: Prediction,
        deviations: float,
        safety: Safety,
        seed: int,
    ) -> NDArray[np.float64]:
        """Of the safe thetas that promise as much as ``theta`` the nearest to the best trial's, or one on the way to it."""
        search = Search(self.loop, belief.expected, space)
        score, known = search.score(space.to_unit(theta)), _kept(trials)
        if score is None or not known:
            return theta
        margin = np.nan_to_num(predicted.upper_windows(deviations) - windows_of(score))
        allowed = np.nanmax(windows_of(score) + margin, initial=0.0) - margin
        near = theta
        for _ in range(NEARINGS):
            near = nearest(search, space, known[0], near, score.objective, allowed)
            there, expected = _predicted(belief, near, seed), search.score(space.to_unit(near))
            if there.probability() >= safety.probability:
                return near
            if expected is not None:
                # It is less sure there, of some limits: those keep the margins of there.
                allowed = np.minimum(allowed, -np.nan_to_num(there.upper_windows(deviations) - windows_of(expected)))
        for share in PARTS:
            part = theta + share * (near - theta)
            if _predicted(belief, part, seed).probability() >= safety.probability:
                return part
        return theta

    def _polished(
        self,
        space: ParameterSpace,
        belief: Belief,
        theta: NDArray[np.float64],
        predicted: Prediction,
        deviations: float,
    ) -> NDArray[np.float64]:
        """Envelope steps keep the limits and come near the best objective; the rest of the way with the margins held."""
        expected = belief.central(theta)
        score = None if expected is None else self.loop.score(expected)
        if score is None:
            return theta
        margin = predicted.upper_windows(deviations) - windows_of(score) + (SEARCHED - AIMED)
        search = Search(self.loop, belief.expected, space, np.nan_to_num(margin))
        start = space.to_unit(theta)
        search.scale([start, space.to_unit(space.default)])
        search.refine(start, POLISHING)
        return space.from_unit(search.best(start))

    def _cautious(self, space: ParameterSpace, belief: Belief, theta: NDArray[np.float64], seed: int) -> list[Candidate]:
        """From the best theta on the expected plant envelope steps that take back some sd; it too where none is likely to do."""
        start, out = (theta, _predicted(belief, theta, seed)), []
        for deviations in CAUTION:
            at, predicted = start
            for _ in range(STEPS_BACK):
                expected, rows = belief.central(at), predicted.upper_rows(deviations)
                if expected is None or rows is None:
                    break
                at = covering(self.loop.controller, expected, at, rows - AIMED * self.loop.row_tolerances)
                predicted = _predicted(belief, at, seed)
                out.append((at, predicted))
        ordered = [*out[STEPS_BACK - 1 :], *out[: STEPS_BACK - 1]]
        likely = [one for one in ordered if one[1].probability() >= 0.5]
        # From a search that failed the steps lead to where the ensemble itself says that a limit breaks, and some limits they cannot
        # keep: then nothing is taken back, where that is likelier to keep them.
        if not likely:
            return sorted([*ordered, start], key=lambda one: -one[1].probability())
        polished = self._polished(space, belief, *likely[0], CAUTION[0])
        return [(polished, _predicted(belief, polished, seed)), *likely]

    def _covered(self, belief: Belief, theta: NDArray[np.float64]) -> NDArray[np.float64]:
        """Envelope steps on the plant that is expected."""
        for _ in range(self.steps):
            episode = belief.central(theta)
            if episode is None:
                break
            theta, before = covering(self.loop.controller, episode, theta, self.loop.measured_rows(episode)), theta
            if _moved(self.loop.controller.theta, before, theta) < SETTLED:
                break
        return theta

    def _tried(self, trials: Sequence[TrialLike], belief: Belief, safety: Safety, seed: int) -> NDArray[np.float64]:
        """The best theta that was tried, kept the limits, and is still predicted to."""
        for theta in _kept(trials):
            if _predicted(belief, theta, seed).probability() >= safety.probability:
                warnings.warn("no safe improvement is known: a theta that was tried is proposed again", RuntimeWarning, stacklevel=2)
                return theta
        what = f"no theta keeps every limit with probability {safety.probability:g}"
        raise NoSafeThetaError(f"{what} as far as the {len(trials)} trials show; nothing was proposed")

    def _check_budget(self, trials: Sequence[TrialLike], safety: Safety) -> None:
        if safety.budget is None:
            return
        spent = sum(self.loop.violation(e) for e in episodes_of(trials))
        if spent > safety.budget:
            raise NoSafeThetaError(f"the budget of violation is spent: {spent:.4g} of {safety.budget:g}; nothing was proposed")

    def _start(self, space: ParameterSpace, belief: Belief, safety: Safety) -> NDArray[np.float64]:
        """The declared start, or the corner with the least excess over plants of the prior, which has to be safe there."""
        if safety.start is not None:
            return space.validate(np.array(safety.start))
        corners = [np.concatenate(parts) for parts in product(*([np.zeros(p.size), np.ones(p.size)] for p in space.parameters))]
        predictions = [_predicted(belief, space.from_unit(u), self.seed) for u in corners]
        chances = [p.probability() for p in predictions]
        worst = [float(np.nanquantile(np.nanmax(p.excess, axis=1), safety.probability)) if len(p.excess) else np.inf for p in predictions]
        at = min(range(len(corners)), key=lambda i: (-chances[i], worst[i]))
        if chances[at] < safety.probability:
            raise NoSafeThetaError(
                f"no corner of theta keeps every limit with probability {safety.probability:g} on plants of the prior "
                f"(the most cautious one: {chances[at]:.2f}); declare a start that does"
            )
        return space.from_unit(corners[at])


def _predicted(belief: Belief, theta: NDArray[np.float64], seed: int) -> Prediction:
    return belief.predict(theta, DRAWS if belief.proved else DRAWS_UNPROVED, seed)


def _moved(space: ParameterSpace, before: NDArray[np.float64], theta: NDArray[np.float64]) -> float:
    """The largest change of an entry, as a share of its range."""
    return float(np.max(np.abs(theta - before) / (space.upper - space.lower)))


def _kept(trials: Sequence[TrialLike]) -> list[NDArray[np.float64]]:
    """The thetas that kept every limit as measured, the best first."""
    known = [(t.score.objective, np.array(t.theta)) for t in trials if t.score is not None and t.score.feasible]
    return [theta for _, theta in sorted(known, key=lambda one: -one[0])]
