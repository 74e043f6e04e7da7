"""Tuning by a twin: learn the plant from whole traces, then tune the controller on what was learnt."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from chargetune.learning.black_box.constrained_ei import ConstrainedLogEI
from chargetune.learning.candidates import Proposal
from chargetune.learning.closed_loop.search import Search
from chargetune.learning.initial_design import initial_design
from chargetune.learning.safe_mode import safe_thetas
from chargetune.learning.safety import Safety
from chargetune.learning.tuner import TrialLike, check_count
from chargetune.learning.twin.ensemble import Prediction, condition
from chargetune.learning.twin.settings import TwinSettings
from chargetune.learning.twin.twin_loop import TwinLoop
from chargetune.model.parameter_space import ParameterSpace

__all__ = ["TwinTuner"]

# Without a promise a theta has to keep the limits as likely as not.
LIKELY = 0.5
# Probability of keeping every limit of a trial that is the result: a half, less two standard errors of an ensemble of 64.
NOT_BROKEN = 0.375


@dataclass(frozen=True)
class TwinTuner:
    """First theta_0; then the theta that is best on the plant as the traces so far show it.

    The theta is the solution of

        max objective  s.t.  excess <= tolerance - margin

    on the simulated closed loop with the twin at its posterior mode plus the mean discrepancy, with margins from an ensemble of plants
    that the traces allow (`Proposal`), such that every limit is kept on at least half of them. Further thetas of a batch, and those
    proposed beside running trials, are best on posterior draws. Deterministic: the same trials give the same thetas.
    Without a single trace the design is Sobol's. Where the twin is no model of the plant the black box `ConstrainedLogEI` proposes,
    with a warning.

    With ``safety`` the share is the stated probability, fresh plants judge, and the first theta is the declared start, or the most
    cautious corner (`safe_thetas`). Where no theta is safe enough `NoSafeThetaError` is raised, and nothing reaches the plant. Further
    thetas of a batch are the other candidates that passed; where there are too few they are repeated. Trials of earlier studies are
    refused (ValueError): what another cell allowed is not known to be safe for this one.
    """

    loop: TwinLoop
    seed: int = 0
    safety: Safety | None = None
    settings: TwinSettings = field(default_factory=TwinSettings)

    def ask(self, space: ParameterSpace, trials: Sequence[TrialLike], n: int = 1) -> NDArray[np.float64]:
        """``n`` thetas, shape (n, d). Raises ValueError when n is no count or a safe study has earlier trials, `NoSafeThetaError`."""
        check_count(n)
        # Its matrices are small: a second thread mostly waits, and on a busy machine it waits ten times as long as one works.
        with threadpool_limits(1):
            return self._ask(space, trials, n)

    def _ask(self, space: ParameterSpace, trials: Sequence[TrialLike], n: int) -> NDArray[np.float64]:
        if self.safety:
            if any(t.number < 0 for t in trials):
                raise ValueError(
                    "safety: there are trials of earlier studies; what another cell allowed is not known to be safe for this one, "
                    "allowed are this study's own trials"
                )
            # A trial that is running has shown nothing yet, and what it tries need not be tried twice.
            running = [np.array(t.theta) for t in trials if t.status == "running"]
            done = [t for t in trials if t.status != "running"]
            ensemble = condition(self.loop, done, self.settings)
            # While nothing is known a start is judged by the same plants each time: other ones could pass by chance what these refused.
            seed = self.seed if ensemble.discrepancy is None else self._seed(done)
            proposal = Proposal(space, ensemble, done, self.safety.probability, seed)
            safe = safe_thetas(proposal, self.safety, n + len(running))
            fresh = [theta for theta in safe if not any(np.array_equal(theta, other) for other in running)] or safe
            return np.array([fresh[i % len(fresh)] for i in range(n)])
        ensemble = condition(self.loop, trials, self.settings)
        if ensemble.discrepancy is None:
            return initial_design(space, max(n, len(trials) + n), self.seed, len(trials), n)[:n]
        proposal = Proposal(space, ensemble, trials, LIKELY, self._seed(trials))
        if ensemble.rejected:
            warnings.warn(
                f"the twin is no model of this plant: {ensemble.rejected}; this proposal is the black box's", RuntimeWarning, stacklevel=2
            )
            # Without further Sobol points: the trials so far are its initial data.
            return ConstrainedLogEI(self.seed, n_initial=0).ask(space, trials, n)
        # What is best on the expected plant is on its way already when a trial is running.
        pending = any(t.status == "running" for t in trials)
        thetas = [] if pending else [self._likely(proposal)]
        # From one that runs a search may not move at all: what is good enough for one plant is for its neighbour.
        start = space.to_unit(np.array(next(t.theta for t in reversed(trials) if t.status != "running")))
        for k in range(n - len(thetas)):
            search = Search(self.loop, ensemble.plant(self._seed(trials) + k), space)
            u = search.refine(start, 2 * self.settings.iterations, self.settings.gain, proximal=self.settings.proximal)
            thetas.append(space.from_unit(u))
        return np.array(thetas)

    def _likely(self, proposal: Proposal) -> NDArray[np.float64]:
        accepted, last = proposal.search()
        return (accepted[0] if accepted else last)[0]

    def best(self, space: ParameterSpace, trials: Sequence[TrialLike]) -> int | None:
        """Index of the trial that is believed best; None without traces.

        Of those that are not likely to have broken a limit (`NOT_BROKEN`) the one of the best objective; where each is likely to, the
        likeliest to have kept all. No single measurement decides whether a trial kept them: all traces do, by what they say of the
        plant under the inputs of that trial.
        """
        with threadpool_limits(1):
            ensemble, seed = condition(self.loop, trials, self.settings), self._seed(trials)
            if ensemble.discrepancy is None:
                return None

            def predicted(trial: TrialLike) -> Prediction:
                reader = getattr(trial, "episode", None)
                episode = None if reader is None else reader()
                return ensemble.predict(np.array(trial.theta), seed) if episode is None else ensemble.replayed(episode, seed)

            known = {k: predicted(t) for k, t in enumerate(trials) if t.score is not None}
            return max(known, key=lambda k: (min(known[k].probability(), NOT_BROKEN), known[k].objective()), default=None)

    def _seed(self, trials: Sequence[TrialLike]) -> int:
        return self.seed + 7919 * len(trials)
