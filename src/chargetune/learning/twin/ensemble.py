"""The ensemble: plants that the trials so far allow, and what they do with a theta."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from chargetune.episode.episode import Episode
from chargetune.episode.score import Score
from chargetune.learning.closed_loop.loop import Simulate, windows_of
from chargetune.learning.tuner import TrialLike
from chargetune.learning.twin.calibration import SCALES, PredictionCheck, check_prediction, scale_quantile
from chargetune.learning.twin.discrepancy import Discrepancy, DiscrepancySample, NoDiscrepancy
from chargetune.learning.twin.laplace import fit
from chargetune.learning.twin.posterior import Posterior
from chargetune.learning.twin.rollout import predict_each
from chargetune.learning.twin.settings import TwinSettings
from chargetune.learning.twin.twin import Twin
from chargetune.learning.twin.twin_loop import ModelledLoop, TwinLoop
from chargetune.runtime.cache import Built

__all__ = ["Ensemble", "Learnt", "Prediction", "condition", "episodes_of", "learn"]

# Posteriors, discrepancies and checks that are kept: what was learnt from a trace is used again after the next one. Several studies may
# share a process.
_FITTED: Built = Built(256, casadi=False)
_LEARNT: Built = Built(8, casadi=False)
_CHECKED: Built = Built(256, casadi=False)


@dataclass(frozen=True)
class Learnt:
    """What traces say of a plant: the posterior of its unknowns and what the model cannot represent; None: there is no trace yet.

    ``checks`` say how well each trace but the first was predicted by those before it.
    """

    twin: Twin
    settings: TwinSettings
    discrepancy: Discrepancy | None
    checks: tuple[PredictionCheck, ...] = ()

    @cached_property
    def posterior(self) -> Posterior:
        """Of the unknowns; without a trace the prior."""
        return fit(self.twin, (), self.settings) if self.discrepancy is None else self.discrepancy.posterior

    @property
    def scale(self) -> float:
        """The discrepancy's scale of an ensemble."""
        return scale_quantile(self.checks, self.settings.scale_sd, self.settings.scale_share)

    @property
    def rejected(self) -> str:
        """Why the twin is rejected as a model of this plant; empty while it may be one."""
        # A single prediction rests on one trace, which may be far from where the next one went.
        error = self.checks[-1].standardised_error if len(self.checks) > 1 else 0.0
        if error >= self.settings.standardised_error_max:
            return f"the newest trial was {error:.1f} stated standard deviations from its prediction"
        median = scale_quantile(self.checks, self.settings.scale_sd, 0.5)
        return f"its errors are more than {SCALES[-2]:.1f} times as large as stated" if median >= SCALES[-2] else ""


@dataclass(frozen=True)
class Ensemble:
    """Plants of ``loop`` that its traces allow: draws of the posterior, and the discrepancy that goes with each of them."""

    loop: TwinLoop
    learnt: Learnt

    @property
    def settings(self) -> TwinSettings:
        return self.learnt.settings

    @property
    def discrepancy(self) -> Discrepancy | None:
        """None: no trace yet."""
        return self.learnt.discrepancy

    @property
    def rejected(self) -> str:
        """Why the twin is rejected as a model of this plant; empty while it may be one."""
        return self.learnt.rejected

    def central(self, theta: NDArray[np.float64]) -> Episode | None:
        """The episode expected of theta: posterior mode and mean discrepancy."""
        return self.expected([theta])[0]

    def expected(self, thetas: Sequence[NDArray[np.float64]]) -> list[Episode | None]:
        """`central` of several thetas."""
        return self.loop.simulate([(theta, *self._centre) for theta in thetas])

    def plant(self, seed: int) -> Simulate:
        """One plant drawn from the ensemble: thetas -> episodes."""
        ((m, error),) = self._members(1, seed)
        return lambda thetas: self.loop.simulate([(theta, m, error) for theta in thetas])

    def predict(self, theta: NDArray[np.float64], seed: int, count: int | None = None) -> Prediction:
        """What ``count`` members do with theta, as many as the settings say; the same plants for the same count and seed."""
        members = self._members(count or self.settings.plants, seed)
        return Prediction(self.loop, tuple(self.loop.simulate([(theta, *plant) for plant in members])), self.settings.near)

    def replayed(self, episode: Episode, seed: int) -> Prediction:
        """What the members do under the recorded inputs of an episode, without noise.

        Of an episode that was learnt from it is what truly happened there, closer than `predict` has it: no controller acts differently
        on each plant. With noise added it is what the next episode with these inputs should measure: a posterior predictive check.
        """
        twin, out = self.loop.twin, []
        columns = [episode.output_names.index(name) for name in twin.noise_sd]
        members = self._members(self.settings.plants, seed)
        (predicted,) = predict_each(twin.under(episode), np.array([m for m, _ in members]), [episode.input])
        for values, (_, error) in zip(predicted, members, strict=True):
            own = replace(episode, output_start=episode.output_start.copy(), output_end=episode.output_end.copy())
            own.output_start[:, columns], own.output_end[:, columns] = values[:, 0], values[:, 1]
            out.append(error(own))
        return Prediction(self.loop, tuple(out), self.settings.near)

    @cached_property
    def _centre(self) -> tuple[NDArray[np.float64], DiscrepancySample | None]:
        mode = self.learnt.posterior.mode
        return mode, None if self.discrepancy is None else self.discrepancy.mean(mode)

    def _members(self, count: int, seed: int) -> list[tuple[NDArray[np.float64], DiscrepancySample | NoDiscrepancy]]:
        """Unknowns and discrepancy of so many plants."""
        if (count, seed) not in self._drawn:
            draws = self.learnt.posterior.draw(count, seed)
            errors: Sequence[DiscrepancySample | NoDiscrepancy] = [NoDiscrepancy()] * count
            if self.discrepancy:
                seeds = [int(s) for s in np.random.SeedSequence(seed).generate_state(count)]
                errors = self.discrepancy.samples(draws, self.learnt.scale, seeds)
            self._drawn[count, seed] = list(zip(draws, errors, strict=True))
        return self._drawn[count, seed]

    @cached_property
    def _drawn(self) -> dict[tuple[int, int], list[tuple[NDArray[np.float64], DiscrepancySample | NoDiscrepancy]]]:
        return {}


@dataclass(frozen=True)
class Prediction:
    """Episodes with one theta over the members of an ensemble; None where one failed."""

    loop: TwinLoop
    episodes: tuple[Episode | None, ...]
    near: float

    @cached_property
    def scores(self) -> list[Score]:
        """Verdicts on those episodes that have one."""
        scores = (self.loop.score(e) for e in self.episodes if e is not None)
        return [score for score in scores if score is not None]

    @cached_property
    def excess(self) -> NDArray[np.float64]:
        """Excess less tolerance by plant and window, in tolerances, shape (plants, windows); nan where none was visited."""
        return np.array([windows_of(score) for score in self.scores]) if self.scores else np.empty((0, 0))

    def probability(self) -> float:
        """Share of the plants that keep every limit within its tolerance."""
        kept = np.all(~(self.excess > 0), axis=1)
        return float(np.sum(kept) / len(self.episodes))

    def objective(self) -> float:
        """Mean over the plants; -inf where none has a score."""
        return float(np.mean([s.objective for s in self.scores])) if self.scores else -np.inf

    def upper_windows(self, probability: float) -> NDArray[np.float64]:
        """Upper bounds of the excess by window that hold together on this share of the plants; nan where hardly one of them was.

            e_w <= mean_w + k sd_w for every window w,  k the quantile over plants j of max_w (e_jw - mean_w) / sd_w

        over the windows that are at most ``near`` sd below their limit.
        """
        known = np.isfinite(self.excess)
        count = known.sum(axis=0)
        values = np.where(known, self.excess, 0.0)
        mean = values.sum(axis=0) / np.maximum(count, 1)
        off = np.where(known, values - mean, 0.0)
        sd = np.sqrt((off**2).sum(axis=0) / np.maximum(count, 1))
        counts = (mean + self.near * sd > 0) & (2 * count > len(self.excess))
        standardised = np.divide(off, sd, out=np.zeros_like(off), where=(sd > 0) & counts)
        largest = standardised.max(axis=1, initial=0.0)
        k = float(np.quantile(largest, probability)) if largest.size else 0.0
        return np.where(2 * count > len(self.excess), mean + k * sd, np.nan)


def episodes_of(trials: Sequence[TrialLike]) -> list[Episode]:
    """The measured episodes of those trials that have one."""
    readers = [reader for t in trials if (reader := getattr(t, "episode", None)) is not None]
    return [e for reader in readers if (e := reader()) is not None and len(e)]


def condition(loop: TwinLoop, trials: Sequence[TrialLike], settings: TwinSettings | None = None) -> Ensemble:
    """What the traces of these trials leave of the plants; the prior where there is none."""
    return Ensemble(loop, learn(loop, trials, settings))


def learn(loop: ModelledLoop, trials: Sequence[TrialLike], settings: TwinSettings | None = None) -> Learnt:
    """What the traces of these trials say of the twin of ``loop``."""
    settings, every = settings or TwinSettings(), episodes_of(trials)
    if not every:
        return Learnt(loop.twin, settings, None)
    keys = _keys(loop, settings, every)
    newest = _learnt(loop, settings, every, keys)

    def check(k: int) -> PredictionCheck:
        if not settings.of_episode:
            return _CHECKED.get(keys[k], lambda: check_prediction(_learnt(loop, settings, every[:k], keys), every[k]))
        # By the process as it is stated now: old errors have enlarged it already, and would do so a second time. Without parts of the
        # episodes that second time stands for them: 1 of 120 trials over the limit, not 4 (structural plant, safe mode).
        return check_prediction(_discrepancy(loop, settings, every[:k], keys, newest), every[k])

    return Learnt(loop.twin, settings, newest, tuple(check(k) for k in range(1, len(every))))


def _learnt(loop: ModelledLoop, settings: TwinSettings, episodes: Sequence[Episode], keys: Sequence[str]) -> Discrepancy:
    return _LEARNT.get(keys[len(episodes) - 1], lambda: _discrepancy(loop, settings, episodes, keys))


def _discrepancy(
    loop: ModelledLoop, settings: TwinSettings, episodes: Sequence[Episode], keys: Sequence[str], by: Discrepancy | None = None
) -> Discrepancy:
    """What the newest of these episodes give; its process is fitted to them, or is that of ``by``."""
    return Discrepancy(_fitted(loop, settings, episodes, keys), tuple(episodes[-settings.traces :]), loop.features, settings, by)


def _fitted(loop: ModelledLoop, settings: TwinSettings, episodes: Sequence[Episode], keys: Sequence[str]) -> Posterior:
    """The posterior that the newest of these episodes give; the fit begins where that of all but the last one ended."""

    def build() -> Posterior:
        before = _fitted(loop, settings, episodes[:-1], keys) if len(episodes) > 1 else None
        return fit(loop.twin, tuple(episodes[-settings.traces :]), settings, start=before)

    return _FITTED.get(keys[len(episodes) - 1], build)


def _keys(loop: ModelledLoop, settings: TwinSettings, episodes: Sequence[Episode]) -> list[str]:
    """A key for each of these episodes: the content of it, of all before it, of the twin and of the settings."""
    digest = hashlib.blake2b(repr((loop.twin.content, dict(loop.features), settings)).encode(), digest_size=16)
    out = []
    for one in episodes:
        for part in (one.input, one.output_start, one.output_end):
            digest.update(part.tobytes())
        out.append(digest.hexdigest())
    return out
