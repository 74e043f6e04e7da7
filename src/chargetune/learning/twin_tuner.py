"""Tuning by a twin: learn the plant from whole traces, then tune the controller on what was learnt."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from chargetune.learning.black_box.constrained_ei import ConstrainedLogEI
from chargetune.learning.candidate_choice import Candidate
from chargetune.learning.candidates import Proposal
from chargetune.learning.closed_loop.search import Search
from chargetune.learning.initial_design import initial_design, sobol_points
from chargetune.learning.safe_mode import SURE, SURE_UNPROVED, SafeProposal
from chargetune.learning.safety import Safety
from chargetune.learning.tuner import TrialLike, check_count
from chargetune.learning.twin.ensemble import condition
from chargetune.learning.twin.twin_loop import TwinLoop
from chargetune.model.parameter_space import ParameterSpace

__all__ = ["TwinTuner", "cautious"]

# Standard deviations that are taken back where nothing is promised; the acquisition chooses, none among them.
CAUTION = (2.0, 3.0)
# Of a trial that is the result, the probability of keeping every limit: a half, less two standard errors of an ensemble of 32.
LIKELY = 0.32
# Of the objective, what no standard deviation is worth: so much worse a theta is kept, and of no use.
USELESS = 0.1
# IterativeLearning steps that take them back.
STEPS_BACK = 2
# Two starts that are closer than this share of the range in every entry lead to one end.
APART = 0.1


@dataclass(frozen=True)
class TwinTuner:
    """First theta_0; then the theta that is best on the plant as the traces so far show it.

    Algorithm 1 with the twin's prediction of the score as the prior mean m(theta). Candidates begin where max objective s.t.
    excess <= tolerance, in every window where the score has a profile, is solved on the simulated closed loop with the twin at its
    posterior mode plus the mean discrepancy (`Search`), from theta_0, ``pool`` Sobol points and the thetas tried so far. They are
    what a search from there finds with several sd of an ensemble held back (`CAUTION`), and envelope steps by these. Constrained log
    expected improvement, on m corrected by the Gaussian process of what the trials left of it, picks one (`choose_candidate`).
    Further thetas of a batch, and those proposed beside running trials, are best on posterior draws. Deterministic: the same
    trials give the same thetas. Without a single trace the design is Sobol's.

    Where the newest trial differs from what those before it predicted_before by `MISTAKEN` times what was expected or more, the twin
    is no twin, and the black box `ConstrainedLogEI` proposes, with a warning. With ``safety`` it is the best trial that kept the
    limits again.

    With ``safety`` the theta is one whose controller predicts the upper side of the ensemble: envelope steps (`covering`) on mean
    plus some sd of an ensemble of plants. Candidates are those that keep every limit on a share of the ensemble of at least the
    stated probability, and the same acquisition picks; the first theta is the declared start, or the most cautious corner. What is
    proposed has to keep them as surely on an ensemble that nothing was chosen by. Where
    no such theta is found the best one tried that is still predicted to be safe is proposed again, with a warning; where there is
    none, or the budget of violation is spent, `NoSafeThetaError` is raised and nothing reaches the plant. Further thetas of a batch,
    and those proposed beside running trials, are the other candidates that passed; where there are too few they are repeated.
    Trials of earlier studies are refused (ValueError): what another cell allowed is not known to be safe for this one.
    """

    loop: TwinLoop
    seed: int = 0
    safety: Safety | None = None
    pool: int = 32
    steps: int = 5
    iterations: int = 10

    def ask(self, space: ParameterSpace, trials: Sequence[TrialLike], n: int = 1) -> NDArray[np.float64]:
        """``n`` thetas, shape (n, d). Raises ValueError when n is no count or a safe study has earlier trials, `NoSafeThetaError`."""
        check_count(n)
        # Its matrices are small: a second thread mostly waits, and on a busy machine it waits ten times as long as one works.
        with threadpool_limits(1):
            return self._ask(space, trials, n)

    def _ask(self, space: ParameterSpace, trials: Sequence[TrialLike], n: int) -> NDArray[np.float64]:
        if self.safety:
            # A trial that is running has shown nothing yet, and what it tries need not be tried twice.
            if any(t.number < 0 for t in trials):
                raise ValueError(
                    "safety: there are trials of earlier studies; what another cell allowed is not known to be safe for this one, "
                    "allowed are this study's own trials"
                )
            running = [np.array(t.theta) for t in trials if t.status == "running"]
            done = [t for t in trials if t.status != "running"]
            safe = self._safe_ask(space, done, self.safety).thetas(n + len(running))
            fresh = [theta for theta in safe if not any(np.array_equal(theta, other) for other in running)] or safe
            return np.array([fresh[i % len(fresh)] for i in range(n)])
        ensemble = condition(self.loop, trials) if trials else None
        if ensemble is None or ensemble.discrepancy is None:
            out = initial_design(space, max(n, len(trials) + n), self.seed, len(trials), n)
            return out[:n]
        if ensemble.mistaken:
            warnings.warn(
                f"the twin did not foresee the last trial (off by {ensemble.standardised_error:.0f} times what it allows for): "
                "this proposal is the black box's",
                RuntimeWarning,
                stacklevel=2,
            )
            return ConstrainedLogEI(self.seed).ask(space, trials, n)
        first = self._points(space, trials)
        # What is best on the expected plant is on its way already when a trial is running.
        pending = any(t.status == "running" for t in trials)
        drawn = [ensemble.plant(self._seed(trials) + k) for k in range(n if pending else n - 1)]
        plants = drawn if pending else [ensemble.expected, *drawn]
        searches = [self._searched(Search(self.loop, plant, space), first) for plant in plants]
        thetas = [space.from_unit(search.best()) for search in searches]
        if pending:
            return np.array(thetas)
        ask = Proposal(self.loop, space, ensemble, trials, self._seed(trials))
        best, _ = ask.choose_candidate(cautious(ask, thetas[0]))
        return np.array([best, *thetas[1:]])

    def best(self, space: ParameterSpace, trials: Sequence[TrialLike]) -> int | None:
        """Index of the trial that is believed best; None without traces.

        Of those that are not likely to have broken a limit (`LIKELY`) the one of the best objective; where each is likely to, the
        likeliest to have kept all. No single measurement decides whether a trial kept them: all traces do, by what they say of the
        plant under the inputs of that trial.
        """
        with threadpool_limits(1):
            ensemble = condition(self.loop, trials)
            if ensemble.discrepancy is None:
                return None
            ask = Proposal(self.loop, space, ensemble, trials, self._seed(trials))
            known = {k: ask.tried(t) for k, t in enumerate(trials) if t.score is not None}
            return max(known, key=lambda k: _rank(known[k], LIKELY), default=None)

    def _safe_ask(self, space: ParameterSpace, trials: Sequence[TrialLike], safety: Safety) -> SafeProposal:
        ensemble = condition(self.loop, trials, SURE, SURE_UNPROVED)
        # While nothing is known a start is judged by the same plants each time: other ones could pass by chance what these refused.
        seed = self.seed if ensemble.discrepancy is None else self._seed(trials)
        return SafeProposal(self.loop, space, ensemble, trials, seed, safety, self.steps)

    def _seed(self, trials: Sequence[TrialLike]) -> int:
        return self.seed + 7919 * len(trials)

    def _points(self, space: ParameterSpace, trials: Sequence[TrialLike]) -> list[NDArray[np.float64]]:
        """Where a search may begin: theta_0, Sobol's points, the thetas tried so far, the last one last."""
        known = [space.to_unit(np.array(t.theta)) for t in trials]
        return [space.to_unit(space.default), *sobol_points(space.dimension, self.seed, 0, self.pool), *known]

    def _searched(self, search: Search, first: list[NDArray[np.float64]]) -> Search:
        for start in (first[0], first[-1]):
            search.envelope(start, self.steps)
        search.refine(search.best(), self.iterations)
        # The best of the pool, in case a step by what is covered is not the way to it, and it has not led there.
        other = min(first, key=search.merit)
        if np.max(np.abs(other - search.best())) > APART:
            search.refine(other, self.iterations)
        return search


def cautious(ask: Proposal, theta: NDArray[np.float64]) -> list[Candidate]:
    """From the best theta on the expected plant a search and steps that take back some sd; it too where none is likely to do."""
    start, out = ask.candidate(theta), []
    for deviations in CAUTION:
        at = start
        for _ in range(STEPS_BACK):
            following = ask.covered(at, deviations)
            if following is None:
                break
            at = ask.candidate(following)
            out.append(at)
    steps = [*out[STEPS_BACK - 1 :], *out[: STEPS_BACK - 1]]
    # An envelope step knows nothing of the objective, and may lead where the best theta, a little changed, does not: to a slow one.
    ahead = [ask.polished(start, CAUTION[0])]
    if not (_likely(ahead) and ask.as_good(ahead[0][0], start[0])):
        ahead += [ask.polished(one, CAUTION[0]) for one in _likely(steps)[:1]]
    likely = _useful(_likely([*sorted(ahead, key=lambda one: _rank(one, 0.5), reverse=True), *steps]))
    # From a search that failed the steps lead to where the ensemble itself says that a limit breaks, and some limits they cannot
    # keep: then nothing is taken back, where that is likelier to keep them.
    return likely or sorted([*ahead, *steps, start], key=lambda one: -one[1].probability())


def _likely(candidates: Sequence[Candidate]) -> list[Candidate]:
    """Those that keep every limit at least as likely as not."""
    return [one for one in candidates if one[1].probability() >= 0.5]


def _useful(candidates: Sequence[Candidate]) -> list[Candidate]:
    """Those whose expected objective is at most the share `USELESS` worse than the best of them."""
    objectives = [_rank(one, 0.0)[1] for one in candidates]
    least = max(objectives, default=0.0)
    return [one for one, objective in zip(candidates, objectives, strict=True) if objective >= least - USELESS * abs(least)]


def _rank(candidate: Candidate, likely: float) -> tuple[float, float]:
    """First how likely it is to keep the limits, as far as that, then the objective expected of it."""
    scores = candidate[1].scores
    return min(candidate[1].probability(), likely), float(np.mean([s.objective for s in scores])) if scores else -np.inf
