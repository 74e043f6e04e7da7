"""What the trials so far say of the plant, as plants that it could be."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from chargetune.episode.episode import Episode
from chargetune.episode.score import Score
from chargetune.learning.closed_loop.loop import Simulate, windows_of
from chargetune.learning.tuner import TrialLike
from chargetune.learning.twin.calibration import SCALES, calibrate_scale
from chargetune.learning.twin.discrepancy import Discrepancy, DiscrepancySample
from chargetune.learning.twin.posterior import Posterior
from chargetune.learning.twin.twin_loop import TwinLoop
from chargetune.runtime.threads import submit

__all__ = ["Ensemble", "Prediction", "condition", "episodes_of"]

# Traces beyond the newest ones add time and hardly information: each holds some hundred samples.
TRACES_MAX = 4
# Times more wrong than allowed for, at which a twin is none.
MISTAKEN = 3.5


@dataclass(frozen=True)
class Ensemble:
    """The posterior of the twin's unknowns and the discrepancy that goes with each draw of them; None: no trace yet.

    ``standardised_error``: how wrong those before it were about the newest trial (`Discrepancy.predicted_before`); 0 before two are known.
    """

    loop: TwinLoop
    posterior: Posterior
    discrepancy: Discrepancy | None
    standardised_error: float = 0.0

    @property
    def predicted_before(self) -> int:
        """How many of the traces learnt from were predicted_before by those before them."""
        return len(self.discrepancy.episodes) - 1 if self.discrepancy else 0

    @property
    def proved(self) -> bool:
        """Whether there is a trial that those before it predicted_before."""
        return self.predicted_before > 0

    @property
    def mistaken(self) -> bool:
        """Whether the newest trial was so far from what two or more before it predicted_before that the twin is none."""
        return self.predicted_before > 1 and self.standardised_error >= MISTAKEN

    @property
    def beyond_scale(self) -> bool:
        """Whether its errors may be larger than any scale that is told apart."""
        return self.discrepancy is not None and self.discrepancy.scale >= SCALES[-1]

    def central(self, theta: NDArray[np.float64]) -> Episode | None:
        """The episode expected of theta: posterior mode and mean discrepancy."""
        if theta.tobytes() not in self._expected:
            (self._expected[theta.tobytes()],) = self.expected([theta])
        return self._expected[theta.tobytes()]

    def expected(self, thetas: Sequence[NDArray[np.float64]]) -> list[Episode | None]:
        """`central` of several thetas."""
        return self.loop.simulate([(theta, *self._centre) for theta in thetas])

    def scores(self, thetas: Sequence[NDArray[np.float64]]) -> list[Score | None]:
        """Verdicts on the episodes expected of several thetas; None where there is no episode or it has none."""
        fresh = [theta for theta in thetas if theta.tobytes() not in self._scored]
        for theta, episode in zip(fresh, self.expected(fresh) if fresh else [], strict=True):
            self._scored[theta.tobytes()] = None if episode is None else self.loop.score(episode)
        return [self._scored[theta.tobytes()] for theta in thetas]

    def plant(self, seed: int) -> Simulate:
        """One plant drawn from the ensemble: thetas -> episodes."""
        ((m, error),) = self._plants(1, seed)
        return lambda thetas: self.loop.simulate([(theta, m, error) for theta in thetas])

    def predict(self, theta: NDArray[np.float64], count: int, seed: int) -> Prediction:
        """What ``count`` plants drawn from the ensemble do; the same plants for the same seed."""
        return Prediction(self.loop, tuple(self.loop.simulate([(theta, *plant) for plant in self._plants(count, seed)])))

    def replayed(self, episode: Episode, count: int, seed: int) -> Prediction:
        """What ``count`` drawn plants do under the recorded inputs of an episode, without noise.

        Of an episode that was learnt from it is what truly happened there, closer than `predict` has it: no controller acts differently
        on each plant. With noise added it is what the next episode with these inputs should measure: a posterior predictive check.
        """
        twin, out = self.loop.twin, []
        columns = [episode.output_names.index(name) for name in twin.noise_sd]
        plants = self._plants(count, seed)
        (predicted,) = twin.predict_each(np.array([m for m, _ in plants]), [episode.input])
        for values, (_, error) in zip(predicted, plants, strict=True):
            own = replace(episode, output_start=episode.output_start.copy(), output_end=episode.output_end.copy())
            own.output_start[:, columns], own.output_end[:, columns] = values[:, 0], values[:, 1]
            out.append(error(own) if error else own)
        return Prediction(self.loop, tuple(out))

    @cached_property
    def _centre(self) -> tuple[NDArray[np.float64], DiscrepancySample | None]:
        mode = self.posterior.mode
        return mode, self.discrepancy.error(mode) if self.discrepancy else None

    def draw(self, count: int, seed: int) -> None:
        """Begins to draw the plants of `predict` with this count and seed, while something else goes on."""
        if (count, seed) not in self._drawn:
            self._begun[count, seed] = submit(self.posterior.draw, count, seed)

    def _plants(self, count: int, seed: int) -> list[tuple[NDArray[np.float64], DiscrepancySample | None]]:
        if (count, seed) not in self._drawn:
            begun = self._begun.pop((count, seed), None)
            draws = begun.result() if begun else self.posterior.draw(count, seed)
            seeds = [int(s) for s in np.random.SeedSequence(seed).generate_state(count)]
            errors = self.discrepancy.errors(draws, seeds) if self.discrepancy else [None] * count
            self._drawn[count, seed] = list(zip(draws, errors, strict=True))
        return self._drawn[count, seed]

    @cached_property
    def _expected(self) -> dict[bytes, Episode | None]:
        return {}

    @cached_property
    def _scored(self) -> dict[bytes, Score | None]:
        return {}

    @cached_property
    def _begun(self) -> dict[tuple[int, int], Future[NDArray[np.float64]]]:
        return {}

    @cached_property
    def _drawn(self) -> dict[tuple[int, int], list[tuple[NDArray[np.float64], DiscrepancySample | None]]]:
        return {}


@dataclass(frozen=True)
class Prediction:
    """Episodes with one theta over an ensemble of plants; None where one failed."""

    loop: TwinLoop
    episodes: tuple[Episode | None, ...]

    @cached_property
    def scores(self) -> list[Score]:
        """Verdicts on those episodes that have one."""
        scores = (self.loop.score(e) for e in self.episodes if e is not None)
        return [score for score in scores if score is not None]

    @cached_property
    def excess(self) -> NDArray[np.float64]:
        """Excess less tolerance by plant and window, in tolerances, shape (plants, windows); nan where none was visited."""
        rows = [windows_of(score) for score in self.scores]
        return np.array(rows) if rows else np.empty((0, 0))

    def probability(self) -> float:
        """Share of the plants that keep every limit within its tolerance."""
        kept = np.all(~(self.excess > 0), axis=1)
        return float(np.sum(kept) / len(self.episodes))

    def upper_rows(self, deviations: float) -> NDArray[np.float64] | None:
        """mean + ``deviations`` sd of the measured rows (`ClosedLoop`) at each sample, shape (K, 2, rows); None where all failed."""
        rows = [self.loop.measured_rows(e) for e in self.episodes if e is not None]
        if not rows:
            return None
        longest = max(len(r) for r in rows)
        whole = np.array([r for r in rows if len(r) == longest])
        return np.asarray(whole.mean(axis=0) + deviations * whole.std(axis=0))

    def upper_windows(self, deviations: float) -> NDArray[np.float64]:
        """mean + ``deviations`` sd of the excess by window; nan where hardly a plant was."""
        known = np.isfinite(self.excess)
        count = known.sum(axis=0)
        values = np.where(known, self.excess, 0.0)
        mean = values.sum(axis=0) / np.maximum(count, 1)
        sd = np.sqrt(np.where(known, (values - mean) ** 2, 0.0).sum(axis=0) / np.maximum(count, 1))
        return np.where(2 * count > len(self.excess), mean + deviations * sd, np.nan)


def episodes_of(trials: Sequence[TrialLike]) -> list[Episode]:
    """The measured episodes of those trials that have one."""
    readers = [reader for t in trials if (reader := getattr(t, "episode", None)) is not None]
    return [e for reader in readers if (e := reader()) is not None and len(e)]


def condition(loop: TwinLoop, trials: Sequence[TrialLike], sure: float = 0.5, unproved: float | None = None) -> Ensemble:
    """What the traces of these trials say; the prior when there is none.

    ``sure``: the probability that the twin's errors are at most as large as believed, as far as the trials tell: how well each was
    predicted_before by those before it is how far their successor can be trusted. ``unproved``: the same before one was predicted_before, else ``sure``.
    """
    twin, every = loop.twin, episodes_of(trials)
    if not every:
        return Ensemble(loop, twin.fit(()), None)
    keys = _keys(every)
    for k in range(1, len(every)):
        # What was once judged stays so.
        if keys[k] not in twin.predicted_before:
            twin.predicted_before[keys[k]] = _learnt(loop, every[:k], keys[:k]).predicted_before(every[k])
    predicted_before = [twin.predicted_before[key] for key in keys[1:]]
    learnt = _learnt(loop, every, keys).scaled(
        calibrate_scale(predicted_before, sure if predicted_before or unproved is None else unproved)
    )
    return Ensemble(loop, learnt.posterior, learnt, predicted_before[-1].standardised_error if predicted_before else 0.0)


def _learnt(loop: TwinLoop, episodes: Sequence[Episode], keys: Sequence[bytes]) -> Discrepancy:
    """Of the newest of these episodes, with the scale 1. What was learnt last is remembered: it is to foretell what comes next."""
    twin = loop.twin
    if keys[-1] not in twin.newest:
        newest = tuple(episodes[-TRACES_MAX:])
        posterior = twin.fit(newest, way=twin.ways[keys[-2]] if len(keys) > 1 else ())
        twin.ways[keys[-1]] = posterior.way
        twin.newest.clear()
        twin.newest[keys[-1]] = Discrepancy(posterior, newest, loop.features)
    return twin.newest[keys[-1]]


def _keys(episodes: Sequence[Episode]) -> list[bytes]:
    """Of each of these episodes what it and all before it contain."""
    digest, out = hashlib.blake2b(), []
    for one in episodes:
        for part in (one.input, one.output_start, one.output_end):
            digest.update(part.tobytes())
        out.append(digest.digest())
    return out
