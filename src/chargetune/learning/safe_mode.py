"""Safe mode: envelope steps on the upper side of the ensemble, and of what is safe enough the nearest that promises as much."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from itertools import islice, product
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

from chargetune.learning.candidate_choice import Candidate
from chargetune.learning.candidates import WON, Proposal
from chargetune.learning.closed_loop.covering import covering
from chargetune.learning.closed_loop.loop import windows_of
from chargetune.learning.closed_loop.nearest_theta import nearest
from chargetune.learning.closed_loop.search import Search
from chargetune.learning.safety import NoSafeThetaError, Safety
from chargetune.learning.twin.ensemble import episodes_of

__all__ = ["SURE", "SURE_UNPROVED", "SafeProposal"]

# How sure a safe ensemble is that its errors are at most as large as it takes them for: few stretches tell, and as with Student's
# quantiles, the fewer there are the more is left to allow for. Before a trial was predicted_before: so that 90 % intervals of the second one
# cover 90 % of it, on plants that the twin can be and on such as it cannot.
SURE, SURE_UNPROVED = 0.84, 0.93
# Of a limit's tolerance, what the upper side of the prediction may use after envelope steps, searches, and the one for the nearest theta.
AIMED = 0.75
# IterativeLearning steps on the upper side of the prediction, which is that at the theta found last.
ROUNDS = 7
# A round that moves no entry by more than this share of its range was the last one,
SETTLED = 5e-3
# or that changes the objective expected of what is safe by less than this share. Before a trial was predicted_before no search follows that goes
# the rest of the way.
UNCHANGED, UNCHANGED_UNPROVED = 3e-3, 1e-3
# A window that so many standard deviations keep below its limit does not count among those that have to hold together.
NEAR = 3.0
# Beyond the quantile for these windows together: draws are few, and not Gaussian. The more trials were predicted_before by those before them the
# more of it is proved needless: it is divided by their number.
BEYOND = 0.5
# Before it has predicted_before a trial the twin is trusted less: its prior is no more than a guess.
UNPROVED = 1.0
# Factor on the deviations where they do not suffice.
WIDER = 1.25
# Searches, each with the margins of what the one before found.
SEARCHES = 3
# Times that the nearest theta that promises as much is looked for, each time with the margins of the one before.
NEARINGS = 2
# Of the way to what is aimed at where that is not safe, the shares that are tried; the first that is safe is taken.
PARTS = (0.8, 0.5, 0.25)
# Added to the seed of the plants that candidates are chosen by: that of those which the chosen one is judged by, and how many these are.
# The standard error of a probability of 0.95 is 0.019; of 32 fresh plants 4 refused a theta that 97 of 100 allow.
FRESH, JUDGES = 104_729, 128
# Parameters whose corners are all tried for a start: eight ensembles.
CORNERS_OF = 3


@dataclass(frozen=True)
class SafeProposal(Proposal):
    """An ask whose thetas keep every limit as ``safety`` states, as far as the ensemble tells; begun by ``steps`` on the expected plant."""

    safety: Safety
    steps: int
    aimed: ClassVar[float] = AIMED

    def thetas(self, count: int = 1) -> list[NDArray[np.float64]]:
        """At most ``count`` thetas that are known to be safe enough for the next trial, each once, the most promising first.

        Raises NoSafeThetaError where there is none, or the budget is spent.
        """
        if self.ensemble.discrepancy is None:
            # Trials that left no trace have taught nothing.
            return [self._start()]
        self._check_budget()
        if self.ensemble.mistaken or self.ensemble.beyond_scale:
            return [self._kept_again()]
        # Only what comes after the envelope steps needs the ensemble.
        self.draw()
        begin = self.candidate(self._expected_best())
        deviations = self._deviations(begin)
        passed = self._rounds(begin, deviations)
        if not passed:
            return [self._tried()]
        if self.ensemble.proved:
            passed = [*self._searched(passed[0], deviations), *passed[1:]]
        first = self._nearer(self.choose_candidate(passed), deviations)
        # After a single trial the others are further ahead, and the prior has not yet been wrong.
        others = [theta for theta, _ in passed if self.ensemble.proved and not np.array_equal(theta, first)]
        held = list(islice(filter(self._holds, [first, *others]), count))
        return held or [self._back_from(first)]

    def _holds(self, theta: NDArray[np.float64]) -> bool:
        """Whether theta is safe on plants that nothing was chosen by.

        Of many candidates that are judged by the same plants those are found that just these allow: their share says too much.
        """
        return self.ensemble.predict(theta, JUDGES, self.seed + FRESH).probability() >= self.safety.probability

    def _back_from(self, theta: NDArray[np.float64]) -> NDArray[np.float64]:
        """Of the way from the best trial that kept the limits to theta the longest of `PARTS` that holds, else what was tried."""
        for best in self._kept()[:1]:
            for share in PARTS:
                part = best + share * (theta - best)
                if self._holds(part):
                    return part
        return self._tried()

    def _kept_again(self) -> NDArray[np.float64]:
        """The best theta that kept every limit as measured: a twin that was wrong says nothing of another one."""
        what = (
            f"the twin did not foresee the last trial (off by {self.ensemble.standardised_error:.0f} times what it allows for)"
            if self.ensemble.mistaken
            else "the twin is off by more than it can allow for"
        )
        known = self._kept()
        if not known:
            raise NoSafeThetaError(f"{what}, and no trial kept every limit; nothing was proposed")
        warnings.warn(f"{what}: the best theta that kept every limit is proposed again", RuntimeWarning, stacklevel=2)
        return known[0]

    def _safe(self, candidate: Candidate) -> bool:
        return candidate[1].probability() >= self.safety.probability

    def _as_sure(self, candidate: Candidate, deviations: float) -> Callable[[Candidate], bool]:
        """Whether others are safe and no less sure than this one, a limit of which less than its tolerance is used apart.

        How many of few draws keep a limit is coarse; how far the upper side of all is from it is not.
        """
        least = np.fmax(candidate[1].upper_windows(deviations), 0.0)
        return lambda other: self._safe(other) and not np.any(other[1].upper_windows(deviations) > least)

    def _rounds(self, candidate: Candidate, deviations: float) -> list[Candidate]:
        """From a candidate on, thetas that are safe enough, by the objective expected of them."""
        theta = candidate[0]
        passed: list[tuple[float, Candidate]] = []
        unchanged = UNCHANGED if self.ensemble.proved else UNCHANGED_UNPROVED
        for k in range(ROUNDS):
            candidate, expected = self.candidate(theta) if k else candidate, self.ensemble.central(theta)
            score = None if expected is None else self.loop.score(expected)
            if score is None:
                break
            safe = self._safe(candidate)
            if safe:
                passed.append((score.objective, candidate))
                if len(passed) > 1 and abs(passed[-1][0] - passed[-2][0]) < unchanged * abs(passed[-1][0]):
                    break
            following = self.covered(candidate, deviations)
            if following is None:
                break
            if not safe and k > 1:
                deviations *= WIDER
            # A margin is smaller at the smaller current that it leads to: two thetas would answer each other for ever.
            theta, before = following if k < 1 else (theta + following) / 2, theta
            if passed and self.moved(before, theta) < SETTLED:
                break
        return [one for _, one in sorted(passed, key=lambda one: -one[0])]

    def _searched(self, start: Candidate, deviations: float) -> list[Candidate]:
        """From a safe theta on the safe thetas that searches lead to, the last one first: each with the margins of the one before.

        Another one follows where a part of the way was gone, because all of it is not safe, and the rest of it is worth one.
        """
        found = [start]
        for _ in range(SEARCHES):
            aim = self.polished(found[0], deviations)
            ahead = self._furthest(found[0][0], aim, self._as_sure(found[0], deviations))
            if ahead is None or self.as_good(found[0][0], ahead[0], WON):
                break
            found.insert(0, ahead)
            if self.as_good(ahead[0], aim[0]):
                break
        return found

    def _deviations(self, candidate: Candidate) -> float:
        """Standard deviations that keep each of n windows so surely that all are kept as stated: the quantile of p^(1/n) (Sidak).

        n: how many the candidate may break; that of the best theta on the expected plant, which is at all that it may come to.
        """
        near = int(np.sum(candidate[1].upper_windows(NEAR) > 0))
        together = float(norm.ppf(self.safety.probability ** (1 / max(near, 1))))
        predicted_before = self.ensemble.predicted_before
        return together + (BEYOND / predicted_before if predicted_before else BEYOND + UNPROVED)

    def _expected_best(self) -> NDArray[np.float64]:
        """What the plant would allow if the ensemble were true: from there on caution only takes back."""
        theta = np.array(self.trials[-1].theta)
        for _ in range(self.steps):
            episode = self.ensemble.central(theta)
            if episode is None:
                break
            theta, before = covering(self.loop.controller, episode, theta, self.loop.measured_rows(episode)), theta
            if self.moved(before, theta) < SETTLED:
                break
        return theta

    def _nearer(self, candidate: Candidate, deviations: float) -> NDArray[np.float64]:
        """Of the safe thetas that promise as much as this one the nearest to the best trial's, or one on the way to it."""
        theta, predicted = candidate
        search = Search(self.loop, self.ensemble.expected, self.space)
        score, known = search.score(self.space.to_unit(theta)), self._kept()
        if score is None or not known:
            return theta
        margin = np.maximum(np.nan_to_num(predicted.upper_windows(deviations) - windows_of(score)), 0.0)
        kept_back = np.nan_to_num(windows_of(score, AIMED) - windows_of(score))
        # Where this one keeps less than margin and aim another may too, and nowhere else.
        allowed = np.fmax(windows_of(score), -margin - kept_back)
        near, there, as_sure = theta, candidate, self._as_sure(candidate, deviations)
        for _ in range(NEARINGS):
            near, before = nearest(search, self.space, known[0], near, score.objective, allowed), near
            if near is before:
                break
            there, expected = self.candidate(near), search.score(self.space.to_unit(near))
            if as_sure(there):
                return near
            if expected is not None:
                # It is less sure there, of some limits: those keep the margins of there.
                allowed = np.minimum(allowed, -np.nan_to_num(there[1].upper_windows(deviations) - windows_of(expected)) - kept_back)
        part = self._furthest(theta, there, as_sure)
        return theta if part is None or not as_sure(part) else part[0]

    def _furthest(self, theta: NDArray[np.float64], aim: Candidate, sure: Callable[[Candidate], bool]) -> Candidate | None:
        """The aim where it is sure, else of the `PARTS` of the way there the longest that is, else the longest that is safe, else None."""
        safe = None
        for share in (1.0, *PARTS):
            part = aim if share == 1.0 else self.candidate(theta + share * (aim[0] - theta))
            if sure(part):
                return part
            safe = part if safe is None and self._safe(part) else safe
        return safe

    def _kept(self) -> list[NDArray[np.float64]]:
        """The thetas that kept every limit as measured, the best first."""
        known = [(t.score.objective, np.array(t.theta)) for t in self.trials if t.score is not None and t.score.feasible]
        return [theta for _, theta in sorted(known, key=lambda one: -one[0])]

    def _tried(self) -> NDArray[np.float64]:
        """The best theta that was tried, kept the limits, and is still predicted to."""
        for theta in self._kept():
            if self._holds(theta):
                warnings.warn("no safe improvement is known: a theta that was tried is proposed again", RuntimeWarning, stacklevel=2)
                return theta
        what = f"no theta keeps every limit with probability {self.safety.probability:g}"
        raise NoSafeThetaError(f"{what} as far as the {len(self.trials)} trials show; nothing was proposed")

    def _check_budget(self) -> None:
        if self.safety.budget is None:
            return
        spent = sum(self.loop.violation(e) for e in episodes_of(self.trials))
        if spent > self.safety.budget:
            raise NoSafeThetaError(f"the budget of violation is spent: {spent:.4g} of {self.safety.budget:g}; nothing was proposed")

    def _start(self) -> NDArray[np.float64]:
        """The declared start, or the corner that is the likeliest to keep every limit on plants of the prior, which has to be safe there.

        Of few parameters all corners are tried. Of more than `CORNERS_OF` one parameter after the other is put to the side that is
        surer, from all lower bounds on: one ensemble each instead of twice as many for each. Where a side of a parameter is the surer one
        wherever the others are, as with backoffs and resistances, it is the same corner.
        """
        space, safety = self.space, self.safety
        if safety.start is not None:
            return space.validate(np.array(safety.start))
        sizes = [p.size for p in space.parameters]
        known: dict[tuple[float, ...], tuple[float, float]] = {}

        def surer(sides: tuple[float, ...]) -> tuple[float, float]:
            """The probability, and among equal ones how far it is from breaking a limit."""
            if sides not in known:
                predicted = self.predicted(space.from_unit(np.repeat(sides, sizes)))
                worst = np.nanquantile(np.nanmax(predicted.excess, axis=1), safety.probability) if predicted.scores else np.inf
                known[sides] = predicted.probability(), -float(worst)
            return known[sides]

        if len(sizes) <= CORNERS_OF:
            sides = max(product((0.0, 1.0), repeat=len(sizes)), key=surer)
        else:
            sides = (0.0,) * len(sizes)
            for i in range(len(sizes)):
                sides = max(sides, (*sides[:i], 1.0, *sides[i + 1 :]), key=surer)
        theta, chance = space.from_unit(np.repeat(sides, sizes)), known[sides][0]
        if chance < safety.probability or not self._holds(theta):
            raise NoSafeThetaError(
                f"no corner of theta keeps every limit with probability {safety.probability:g} on plants of the prior "
                f"(the most cautious one: {chance:.2f}); declare a start that does"
            )
        return theta
