"""What a twin cannot represent, as a Gaussian process over what the plant went through."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import torch
from botorch.models import SingleTaskGP
from gpytorch.kernels import MaternKernel, ScaleKernel
from gpytorch.means import ZeroMean
from gpytorch.priors import LogNormalPrior
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_factor, cho_solve, cholesky

from chargetune.episode.episode import Episode
from chargetune.episode.lookup_table import LookupTable
from chargetune.learning.black_box.gaussian_process import fitted
from chargetune.learning.black_box.optimize_acquisition import reproducible
from chargetune.learning.twin.calibration import SCALES, PredictionCheck
from chargetune.learning.twin.posterior import Posterior
from chargetune.learning.twin.residuals import CORRELATED_BINS, binned_residuals
from chargetune.runtime.threads import parallel_map

__all__ = ["Discrepancy", "DiscrepancySample"]

# Prior medians of the length scales, as shares of each feature's range, and the common spread of their logarithm.
LENGTH, LENGTH_SD = (0.15, 0.5, 0.5), 0.5
JITTER = 1e-8
# Attempts of the search for hyperparameters, the first from the medians of their priors.
ATTEMPTS = 5


@dataclass(frozen=True)
class Discrepancy:
    """b_i(s) ~ GP(0, a_i^2 k(s, s')), k Matern 3/2: y_i = h_i(x, u, p) + b_i(s) + noise for each measured output i.

    s are ``features`` of an episode, signals with the range by which they are scaled: for a charge the SOC, the current and,
    where it is measured, the temperature. The data are residuals, averaged over `BINS` stretches of each episode, because
    neighbouring residuals have the same cause. The error of an output that is a state does not depend on the inputs among the features:
    it has the inertia of the state. For a draw of the twin's unknowns the process is conditioned on that draw's own
    residuals, so that every sampled plant passes through what was measured, and they part where nothing was.
    k is known at the nodes of a table and linear in between, k(s, s') = w(s)' K w(s') with the shares w of the nodes around s, so
    that a sample drawn at the nodes is one of this process (Wilson and Nickisch, ICML 2015).
    Hyperparameters: maximum a posteriori of the residuals at the mode (BoTorch), log-normal priors.
    Source: Kennedy and O'Hagan, J. R. Stat. Soc. B 63 (2001) 425.
    """

    posterior: Posterior
    episodes: tuple[Episode, ...]
    features: Mapping[str, tuple[float, float]]
    scale: float = 1.0
    like: Discrepancy | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        if not 1 <= len(self.features) <= len(LENGTH):
            raise ValueError(f"discrepancy: features = {sorted(self.features)}, allowed are 1 to {len(LENGTH)}")

    def scaled(self, scale: float) -> Discrepancy:
        """The same with another factor on the floor ``Twin.discrepancy_sd_floor``, not on what the residuals ask for, nor on the hyperparameters."""
        return replace(self, scale=scale, like=self)

    def error(self, unknowns: NDArray[np.float64], seed: int | None = None) -> DiscrepancySample:
        """The discrepancy that goes with a plant at ``unknowns``: its mean, or with a seed a sample."""
        return self._error(self._residuals(unknowns), seed)

    def _error(self, left: NDArray[np.float64], seed: int | None) -> DiscrepancySample:
        stream = None if seed is None else np.random.default_rng(seed)
        tables = []
        for i, part in enumerate(self._parts):
            table = part.gain @ left[:, i]
            if stream is not None:
                table = table + part.root @ stream.standard_normal(len(table))
            tables.append(table)
        return DiscrepancySample(self, np.stack(tables))

    def errors(self, unknowns: NDArray[np.float64], seeds: Sequence[int]) -> list[DiscrepancySample]:
        """A sample of `error` for each of several plants, unknowns of shape (plants, d)."""
        parallel_map(lambda part: part.root, self._parts)
        return parallel_map(self._error, self._residuals(unknowns), seeds)

    def predicted_before(self, episode: Episode) -> PredictionCheck:
        """How well an episode that was not learnt from was predicted, at its recorded inputs.

        Each stretch of the episode differs by r ~ N(0, d_s^2 + v) from its prediction: d_s the standard deviation of the discrepancy with
        the scale s (`scaled`), v from noise and unknowns. Neighbouring stretches err together, so `CORRELATED_BINS` of them count as one; and
        each counts by the share of its prior variance that d_1^2 still is: what was measured before comes out as it was, however wrong
        the process is elsewhere.
        """
        off = self._off(episode)
        known = off.known
        if not known.any():
            return PredictionCheck(np.zeros_like(SCALES), 0.0)
        variance = off.unmodelled[:, known] + off.rest[known]
        chance = -0.5 * np.sum(off.novel[known] * (np.log(variance) + off.square[known] / variance), axis=1) / CORRELATED_BINS
        stated = np.array([self.posterior.twin.discrepancy_sd_floor.get(name, 0.0) for name in self.posterior.twin.noise_sd])
        return PredictionCheck(chance, float(np.sqrt(np.mean((off.square / (off.rest + stated**2))[known]))))

    def _off(self, episode: Episode) -> _Off:
        posterior, twin = self.posterior, self.posterior.twin
        predicted = twin.predict(posterior.mode, episode.input)
        columns = [episode.output_names.index(name) for name in twin.noise_sd]
        filled = replace(episode, output_start=episode.output_start.copy(), output_end=episode.output_end.copy())
        filled.output_start[:, columns], filled.output_end[:, columns] = predicted[:, 0], predicted[:, 1]
        filled = self.error(posterior.mode)(filled)
        left, counts = binned_residuals(twin.measured(episode) - twin.measured(filled))
        noise = np.array(list(twin.noise_sd.values()))
        own = binned_residuals(posterior.predicted_sd(episode.input) ** 2)[0] - posterior.discrepancy_sd**2 - noise**2
        weights = self.lookup_table.weights(self._at(episode))
        left_over = np.stack([part.variance(weights) for part in self._parts], axis=1)
        before = np.stack([part.variance_before(weights) for part in self._parts], axis=1)
        rest = np.maximum(own, 0.0) + noise**2 / np.maximum(counts, 1.0)
        novel = np.divide(left_over, before, out=np.zeros_like(before), where=before > 0)
        return _Off(left**2, self._variances(weights), novel, rest, (counts > 0) & np.isfinite(left))

    def _variances(self, weights: NDArray[np.float64]) -> NDArray[np.float64]:
        """Variance of the process with each of `SCALES` (`scaled`), at ``weights`` of the nodes (K, nodes); shape (scales, K, outputs)."""
        data, seen = self.data, len(self.data.weights)
        every = np.vstack([data.weights, weights])
        out = np.empty((len(SCALES), len(weights), len(self.fitted)))
        for i, (one, floor) in enumerate(zip(self.fitted, self._floors, strict=True)):
            asked, stated = one.variance * one.kernel, np.outer(floor, floor) * one.kernel
            # From all nodes to the stretches, which are fewer, once for all scales.
            fixed, growing = every @ asked @ every.T, every @ stated @ every.T
            for k, square in enumerate(SCALES**2):
                both = fixed + square * growing
                noise = data.variance[:, i] + JITTER * (asked[0, 0] + square * stated[0, 0])
                cross = both[:seen, seen:]
                taken = np.sum(cross * cho_solve(cho_factor(both[:seen, :seen] + np.diag(noise), lower=True), cross), axis=0)
                out[k, :, i] = np.maximum(np.diag(both)[seen:] - taken, 0.0)
        return out

    @cached_property
    def lookup_table(self) -> LookupTable:
        """The nodes at which a sample is drawn together."""
        return LookupTable.over(self.features, list(self.posterior.twin.noise_sd))

    def _at(self, episode: Episode) -> NDArray[np.float64]:
        """Mean features of every stretch, shape (stretches, features)."""
        return binned_residuals(self.signals(episode))[0]

    def signals(self, episode: Episode) -> NDArray[np.float64]:
        """Features at both ends of every interval, shape (intervals, 2, features).

        Where one was not measured it is what the twin predicts, and where the twin does not, what lies between its neighbours.
        """
        out = np.stack([np.stack(_feature(episode, name), axis=1) for name in self.features], axis=2)
        if np.all(np.isfinite(out)):
            return out
        twin = self.posterior.twin
        predicted = dict(zip(twin.noise_sd, np.moveaxis(twin.predict(self.posterior.mode, episode.input), -1, 0), strict=True))
        for i, name in enumerate(self.features):
            seen = np.isfinite(out[..., i])
            if not seen.any() and name not in predicted:
                raise ValueError(f"discrepancy: {name} was never measured in an episode of {len(episode)} intervals")
            time = np.arange(seen.size).reshape(seen.shape)
            out[..., i] = np.where(
                seen, out[..., i], predicted[name] if name in predicted else np.interp(time, time[seen], out[..., i][seen])
            )
        return out

    def _residuals(self, unknowns: NDArray[np.float64]) -> NDArray[np.float64]:
        """Mean residual of every stretch, shape (n, outputs), after the first axes of ``unknowns``; 0 where nothing was measured."""
        twin, several = self.posterior.twin, unknowns.shape[:-1]
        predicted = twin.predict_each(unknowns, [e.input for e in self.episodes])
        out = []
        for episode, values in zip(self.episodes, predicted, strict=True):
            measured = twin.measured(episode)
            means = [binned_residuals(measured - own)[0] for own in values.reshape(-1, *measured.shape)]
            out.append(np.stack(means).reshape(*several, *means[0].shape))
        return np.nan_to_num(np.concatenate(out, axis=len(several)), nan=0.0)

    @cached_property
    def data(self) -> _Data:
        if self.like:
            return self.like.data
        twin = self.posterior.twin
        counts = np.concatenate([binned_residuals(twin.measured(e))[1] for e in self.episodes])
        at = np.concatenate([self._at(episode) for episode in self.episodes])
        noise = np.array(list(twin.noise_sd.values()))
        return _Data(self.lookup_table.unit(at), self.lookup_table.weights(at), noise**2 / np.maximum(counts, 1e-9))

    @cached_property
    def _inputs(self) -> NDArray[np.bool_]:
        """Which features are inputs."""
        return np.array([name in self.posterior.twin.model.input_names for name in self.features])

    def _inert(self, name: str) -> bool:
        """A state does not jump with the input, and neither does what the twin has wrong of it."""
        return name in self.posterior.twin.model.state_names and not self._inputs.all()

    @cached_property
    def fitted(self) -> tuple[_Fitted, ...]:
        if self.like:
            return self.like.fitted
        left, data = self._residuals(self.posterior.mode), self.data
        on = np.array([np.where(self._inputs & self._inert(name), 0.0, 1.0) for name in self.posterior.twin.noise_sd])[:, None]
        return _fit(data.at * on, left.T, data.variance.T, self.lookup_table.nodes * on)

    @cached_property
    def _floors(self) -> tuple[NDArray[np.float64], ...]:
        """By output, how far off it may be at each node however well the model fits elsewhere; without the scale."""
        twin, nodes, inputs = self.posterior.twin, self.lookup_table.nodes, self._inputs
        low, high = np.array(list(self.features.values())).T
        sizes = np.abs(self.lookup_table.value(nodes)) / np.maximum(np.abs(low), np.abs(high))
        flowing = np.maximum(sizes[:, inputs].max(axis=1), twin.floor_at_zero_input) ** 0.5 if inputs.any() else np.ones(len(nodes))
        return tuple(
            twin.discrepancy_sd_floor.get(name, 0.0) * (np.ones(len(nodes)) if self._inert(name) else flowing) for name in twin.noise_sd
        )

    @cached_property
    def _parts(self) -> tuple[_Part, ...]:
        parts = []
        for i, (one, floor) in enumerate(zip(self.fitted, self._floors, strict=True)):
            # One trajectory that the model fits says little of others.
            prior = one.kernel * (one.variance + self.scale**2 * np.outer(floor, floor))
            parts.append(_part(prior, self.data.variance[:, i], self.data.weights))
        return tuple(parts)


@dataclass(frozen=True)
class DiscrepancySample:
    """What the twin cannot represent of one plant: ``table`` has the shape (outputs, nodes), on ``discrepancy.lookup_table``."""

    discrepancy: Discrepancy
    table: NDArray[np.float64]

    def __call__(self, episode: Episode) -> Episode:
        """A predicted episode -> the same with this added to its outputs."""
        lookup_table = self.discrepancy.lookup_table
        columns = [episode.output_names.index(name) for name in lookup_table.outputs]
        at = self.discrepancy.signals(episode)
        changed = []
        for k, outputs in enumerate((episode.output_start, episode.output_end)):
            out = outputs.copy()
            nodes, shares = lookup_table.around(at[:, k])
            out[:, columns] += np.sum(self.table[:, nodes] * shares, axis=-1).T
            changed.append(out)
        return replace(episode, output_start=changed[0], output_end=changed[1])


class _Off(NamedTuple):
    """A prediction beside what was measured, by stretch and output, shape (stretches, outputs)."""

    square: NDArray[np.float64]
    """Squared error."""
    unmodelled: NDArray[np.float64]
    """Its variance by the discrepancy with each of `SCALES`, which are a first axis."""
    novel: NDArray[np.float64]
    """With the scale 1, the share that this is of what it was before any trial."""
    rest: NDArray[np.float64]
    """Variance by unknowns and noise."""
    known: NDArray[np.bool_]
    """Whether it was measured."""


class _Data(NamedTuple):
    """The stretches that are learnt from."""

    at: NDArray[np.float64]
    """Features as shares of their ranges, shape (stretches, features)."""
    weights: NDArray[np.float64]
    """Values at the nodes -> values there, shape (stretches, nodes)."""
    variance: NDArray[np.float64]
    """Of the mean residual by noise, shape (stretches, outputs)."""


class _Fitted(NamedTuple):
    """What the residuals of one output ask for."""

    kernel: NDArray[np.float64]
    """Correlation of the nodes, shape (nodes, nodes)."""
    variance: float


@dataclass(frozen=True)
class _Part:
    """One output: residuals -> mean at the nodes, prior covariance at the nodes, and what of it the data take away."""

    gain: NDArray[np.float64]
    prior: NDArray[np.float64]
    cross: NDArray[np.float64]

    def variance(self, weights: NDArray[np.float64]) -> NDArray[np.float64]:
        """With ``weights`` of the nodes (K, nodes), shape (K,)."""
        taken = np.sum((weights @ self.gain) * (weights @ self.cross.T), axis=1)
        return np.asarray(np.maximum(self.variance_before(weights) - taken, 0.0))

    def variance_before(self, weights: NDArray[np.float64]) -> NDArray[np.float64]:
        """The same before anything was measured."""
        return np.asarray(np.sum((weights @ self.prior) * weights, axis=1))

    @cached_property
    def root(self) -> NDArray[np.float64]:
        """A factor of the covariance, which neighbouring nodes leave singular to rounding."""
        rest = self.prior - self.gain @ self.cross
        rest = (rest + rest.T) / 2
        try:
            return np.asarray(cholesky(rest + JITTER * np.max(np.diag(self.prior)) * np.eye(len(rest)), lower=True))
        except LinAlgError:
            # Where the data are far surer than the prior rounding is larger; this takes ten times as long.
            values, vectors = np.linalg.eigh(rest)
            return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def _fit(
    x: NDArray[np.float64], left: NDArray[np.float64], variance: NDArray[np.float64], nodes: NDArray[np.float64]
) -> tuple[_Fitted, ...]:
    """One process an output, all at once: x (outputs, n, d), residuals and their variance by noise (outputs, n), nodes (outputs, K, d).

    Where no hyperparameters can be found they are the medians of their priors, and a `SurrogateWarning` says so. A second attempt begins
    at a draw of them: of its own seed, so that the same residuals give the same process.
    """
    sizes = np.sqrt(np.mean(left**2, axis=1))
    sizes = np.where(sizes > 0, sizes, 1.0)[:, None]
    count, _, d = x.shape
    batch = torch.Size([count])
    medians = np.array(LENGTH[:d])

    def fresh() -> SingleTaskGP:
        # In units of their prior medians all length scales have the same prior.
        kernel = MaternKernel(nu=1.5, ard_num_dims=d, lengthscale_prior=LogNormalPrior(0.0, LENGTH_SD), batch_shape=batch)
        scaled = ScaleKernel(kernel, outputscale_prior=LogNormalPrior(0.0, 1.0), batch_shape=batch)
        kernel.lengthscale, scaled.outputscale = 1.0, 1.0
        return SingleTaskGP(
            torch.as_tensor(x / medians), torch.as_tensor(left / sizes)[..., None],
            torch.as_tensor(np.minimum(variance / sizes**2, 1e6))[..., None],
            covar_module=scaled, mean_module=ZeroMean(),
            outcome_transform=None, input_transform=None,
        )  # fmt: skip

    with reproducible(0):
        scaled: Any = fitted(fresh, f"the error of the twin in {x.shape[1]} stretches", attempts=ATTEMPTS).covar_module
        with torch.no_grad():
            kernels, scales = scaled.base_kernel(torch.as_tensor(nodes / medians)).to_dense().numpy(), scaled.outputscale.numpy()
    return tuple(_Fitted(k, float(size**2 * scale)) for k, size, scale in zip(kernels, sizes[:, 0], scales, strict=True))


def _part(prior: NDArray[np.float64], variance: NDArray[np.float64], weights: NDArray[np.float64]) -> _Part:
    cross = weights @ prior
    seen = cho_factor(cross @ weights.T + np.diag(variance + JITTER * prior[0, 0]), lower=True)
    return _Part(cho_solve(seen, cross).T, prior, cross)


def _feature(episode: Episode, name: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    if name in episode.input_names:
        held = episode.input[:, episode.input_names.index(name)]
        return held, held
    return episode.signal(name)
