"""What a twin cannot represent, as a Gaussian process over what the plant went through."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import torch
from botorch.models import SingleTaskGP
from botorch.models.kernels import CategoricalKernel
from gpytorch.kernels import MaternKernel, ScaleKernel
from gpytorch.means import ZeroMean
from gpytorch.priors import LogNormalPrior
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_factor, cho_solve, cholesky

from chargetune.episode.episode import Episode
from chargetune.episode.lookup_table import LookupTable
from chargetune.learning.black_box.gaussian_process import fitted
from chargetune.learning.black_box.optimize_acquisition import reproducible
from chargetune.learning.twin.posterior import Posterior
from chargetune.learning.twin.residuals import binned_residuals, measured
from chargetune.learning.twin.rollout import predict, predict_each
from chargetune.learning.twin.settings import TwinSettings
from chargetune.runtime.counted import counted
from chargetune.runtime.threads import parallel_map

__all__ = ["Discrepancy", "DiscrepancySample", "NoDiscrepancy"]

# Relative to the prior variance: what keeps a covariance of neighbouring nodes from being singular to rounding.
JITTER = 1e-8
# Attempts of the search for hyperparameters, the first from the medians of their priors.
ATTEMPTS = 5


@dataclass(frozen=True)
class Discrepancy:
    """b_i(s) ~ GP(0, a_i^2 k(s, s')), k Matern 3/2: y_i = h_i(x, u, p) + b_i(s) + noise for each measured output i.

    s are ``features`` of an episode, signals with the range by which they are scaled: for a charge the SOC, the current and,
    where it is measured, the temperature. The data are residuals, averaged over bins of each episode, because
    neighbouring residuals have the same cause. The error of an output that is a state does not depend on the inputs among the features:
    it has the inertia of the state. For a draw of the twin's unknowns the process is conditioned on that draw's own
    residuals, so that every sampled plant passes through what was measured, and they part where nothing was.
    k is known at the nodes of a table and linear in between, k(s, s') = w(s)' K w(s') with the shares w of the nodes around s, so
    that a sample drawn at the nodes is one of this process (Wilson and Nickisch, ICML 2015).
    With ``TwinSettings.of_episode`` each episode has a part of its own, b_i(s) + c_ie(s), c_ie ~ GP(0, r a_i^2 k) for each episode e: what
    depends on where the episode began, or on what came before it. It is learnt how large that part is, never what it is: a sample has a
    new one.
    ``scale`` multiplies the standard deviation of the whole process: how far what is stated can be trusted (`calibration`).
    Hyperparameters: maximum a posteriori of the residuals at the mode (BoTorch), log-normal priors; with ``fitted_by`` those of that one,
    of the same features and outputs.
    Source: Kennedy and O'Hagan, J. R. Stat. Soc. B 63 (2001) 425.
    """

    posterior: Posterior
    episodes: tuple[Episode, ...]
    features: Mapping[str, tuple[float, float]]
    settings: TwinSettings = field(default_factory=TwinSettings)
    fitted_by: Discrepancy | None = None

    def __post_init__(self) -> None:
        most = len(self.settings.length_scales)
        if not 1 <= len(self.features) <= most:
            raise ValueError(f"discrepancy: features = {sorted(self.features)}, allowed are 1 to {most}")

    def mean(self, unknowns: NDArray[np.float64]) -> DiscrepancySample:
        """What is expected of the discrepancy of a plant at ``unknowns`` (d,)."""
        left = self._residuals(unknowns)
        return DiscrepancySample(self, np.stack([part.gain @ left[:, i] for i, part in enumerate(self.stated)]), drawn=False)

    def samples(self, unknowns: NDArray[np.float64], scale: float, seeds: Sequence[int]) -> list[DiscrepancySample]:
        """A sample for each of several plants, unknowns of shape (plants, d), each with its seed."""
        # They are large, and not kept.
        parts = self._scaled(scale)
        parallel_map(lambda part: part.root, parts)

        def sample(left: NDArray[np.float64], seed: int) -> DiscrepancySample:
            stream = np.random.default_rng(seed)
            tables = [part.gain @ left[:, i] + part.root @ stream.standard_normal(len(part.gain)) for i, part in enumerate(parts)]
            return DiscrepancySample(self, np.stack(tables))

        return parallel_map(sample, self._residuals(unknowns), seeds)

    @cached_property
    def stated(self) -> tuple[_Part, ...]:
        """The process of each output with the scale 1, conditioned on where the data are."""
        return self._scaled(1.0)

    def _scaled(self, scale: float) -> tuple[_Part, ...]:
        data = self.data
        together = (data.episode[:, None] == data.episode).astype(float)
        return tuple(
            _part(scale**2 * prior, one.ratio, data.variance[:, i], data.weights, together)
            for i, (prior, one) in enumerate(zip(self.priors, (self.fitted_by or self).fitted, strict=True))
        )

    @cached_property
    def lookup_table(self) -> LookupTable:
        """The nodes at which a sample is drawn together."""
        return LookupTable.over(self.features, list(self.posterior.twin.noise_sd))

    def at(self, episode: Episode) -> NDArray[np.float64]:
        """Mean features of every bin of a measured episode, shape (bins, features)."""
        return binned_residuals(self.signals(episode), self.settings.bins)[0]

    def signals(self, episode: Episode) -> NDArray[np.float64]:
        """Features of a measured episode at both ends of every interval, shape (intervals, 2, features).

        An output that the twin predicts is told as its mode has it under the recorded inputs, also where it was measured: a sample is
        looked up at what a plant of the ensemble predicts before its own error is added. What was not measured of the others lies
        between its neighbours.
        """
        twin, predicted = self.posterior.twin.under(episode), {}
        if set(self.features) & set(twin.noise_sd):
            values = np.moveaxis(predict(twin, self.posterior.mode, episode.input), -1, 0)
            predicted = dict(zip(twin.noise_sd, values, strict=True))
        return _features(episode, self.features, predicted)

    def _residuals(self, unknowns: NDArray[np.float64]) -> NDArray[np.float64]:
        """Mean residual of every bin, shape (n, outputs), after the first axes of ``unknowns``; 0 where nothing was measured."""
        twin, several = self.posterior.twin, unknowns.shape[:-1]
        out = []
        for episode in self.episodes:
            (values,), seen = predict_each(twin.under(episode), unknowns, [episode.input]), measured(twin, episode)
            means = [binned_residuals(seen - own, self.settings.bins)[0] for own in values.reshape(-1, *seen.shape)]
            out.append(np.stack(means).reshape(*several, *means[0].shape))
        return np.nan_to_num(np.concatenate(out, axis=len(several)), nan=0.0)

    @cached_property
    def data(self) -> _Data:
        twin = self.posterior.twin
        counts = np.concatenate([binned_residuals(measured(twin, e), self.settings.bins)[1] for e in self.episodes])
        each = [self.at(episode) for episode in self.episodes]
        at, episode = np.concatenate(each), np.repeat(np.arange(len(each)), [len(one) for one in each])
        noise = np.array(list(twin.noise_sd.values()))
        return _Data(self.lookup_table.unit(at), self.lookup_table.weights(at), noise**2 / np.maximum(counts, 1e-9), episode)

    @cached_property
    def _inputs(self) -> NDArray[np.bool_]:
        """Which features are inputs."""
        return np.array([name in self.posterior.twin.model.input_names for name in self.features])

    def _inert(self, name: str) -> bool:
        """A state does not jump with the input, and neither does what the twin has wrong of it."""
        return name in self.posterior.twin.model.state_names and not self._inputs.all()

    @cached_property
    def fitted(self) -> tuple[_Fitted, ...]:
        left, data = self._residuals(self.posterior.mode), self.data
        on = np.array([np.where(self._inputs & self._inert(name), 0.0, 1.0) for name in self.posterior.twin.noise_sd])[:, None]
        return _fit(data.at * on, data.episode, left.T, data.variance.T, self.lookup_table.nodes * on, self.settings)

    @cached_property
    def priors(self) -> tuple[NDArray[np.float64], ...]:
        """Covariance of each output at the nodes with the scale 1."""
        if self.fitted_by is not None:
            return self.fitted_by.priors
        twin, nodes, inputs = self.posterior.twin, self.lookup_table.nodes, self._inputs
        low, high = np.array(list(self.features.values())).T
        sizes = np.abs(self.lookup_table.value(nodes)) / np.maximum(np.abs(low), np.abs(high))
        flowing = np.maximum(sizes[:, inputs].max(axis=1), twin.floor_at_zero_input) ** 0.5 if inputs.any() else np.ones(len(nodes))
        out = []
        for name, one in zip(twin.noise_sd, self.fitted, strict=True):
            # One trajectory that the model fits says little of others.
            floor = twin.discrepancy_sd_floor.get(name, 0.0) * (np.ones(len(nodes)) if self._inert(name) else flowing)
            out.append(one.kernel * (one.variance + np.outer(floor, floor)))
        return tuple(out)


@dataclass(frozen=True)
class DiscrepancySample:
    """What the twin cannot represent of one plant: ``table`` has the shape (outputs, nodes), on ``discrepancy.lookup_table``.

    ``drawn``: it is a draw; else the mean, which is that of no plant.
    """

    discrepancy: Discrepancy
    table: NDArray[np.float64]
    drawn: bool = True

    def __call__(self, episode: Episode) -> Episode:
        """A predicted episode -> the same with this added to its outputs."""
        lookup_table = self.discrepancy.lookup_table
        columns = [episode.output_names.index(name) for name in lookup_table.outputs]
        at = _features(episode, self.discrepancy.features)
        changed = []
        for k, outputs in enumerate((episode.output_start, episode.output_end)):
            out = outputs.copy()
            nodes, shares = lookup_table.around(at[:, k])
            out[:, columns] += np.sum(self.table[:, nodes] * shares, axis=-1).T
            changed.append(out)
        return replace(episode, output_start=changed[0], output_end=changed[1])


@dataclass(frozen=True)
class NoDiscrepancy:
    """Of a plant that is drawn before the first trace: the model is right but for the unknowns."""

    table: float = 0.0
    drawn: bool = True

    def __call__(self, episode: Episode) -> Episode:
        return episode


class _Data(NamedTuple):
    """The bins that are learnt from."""

    at: NDArray[np.float64]
    """Features as shares of their ranges, shape (bins, features)."""
    weights: NDArray[np.float64]
    """Values at the nodes -> values there, shape (bins, nodes)."""
    variance: NDArray[np.float64]
    """Variance of the mean residual by noise, shape (bins, outputs)."""
    episode: NDArray[np.int_]
    """Of which episode each is, shape (bins,)."""


class _Fitted(NamedTuple):
    """What the residuals of one output ask for."""

    kernel: NDArray[np.float64]
    """Correlation of the nodes, shape (nodes, nodes)."""
    variance: float
    ratio: float
    """Variance of an episode's own part, to that of the common one."""


@dataclass(frozen=True)
class _Part:
    """One output: residuals -> mean at the nodes, prior covariance at the nodes of one episode, and what of it the data take away."""

    gain: NDArray[np.float64]
    prior: NDArray[np.float64]
    cross: NDArray[np.float64]
    noise: NDArray[np.float64]
    seen: NDArray[np.float64]
    """Covariance of the data without noise."""

    def prior_variance(self, weights: NDArray[np.float64]) -> NDArray[np.float64]:
        """Before anything was measured, with ``weights`` of the nodes (K, nodes), shape (K,)."""
        return np.asarray(np.sum((weights @ self.prior) * weights, axis=1))

    def variances(self, weights: NDArray[np.float64], scales: NDArray[np.float64]) -> NDArray[np.float64]:
        """Variance of the process that is so many times as large, given the data, with ``weights`` (K, nodes); shape (scales, K).

        With W the noise of the data and W^-1/2 K W^-1/2 = U diag(a) U' it is s^2 k - s^4 |diag(s^2 a + 1)^-1/2 U' W^-1/2 c|^2.
        """
        white = 1.0 / np.sqrt(self.noise)
        values, vectors = np.linalg.eigh(white[:, None] * self.seen * white)
        across = (vectors.T @ (white[:, None] * (self.cross @ weights.T))) ** 2
        square = scales[:, None] ** 2
        taken = square**2 * (1.0 / (square * np.maximum(values, 0.0) + 1.0)) @ across
        return np.asarray(np.maximum(square * self.prior_variance(weights) - taken, 0.0))

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
    x: NDArray[np.float64],
    episode: NDArray[np.int_],
    left: NDArray[np.float64],
    variance: NDArray[np.float64],
    nodes: NDArray[np.float64],
    settings: TwinSettings,
) -> tuple[_Fitted, ...]:
    """One process an output, all at once.

    Shapes: x (outputs, n, d), the episode of each (n,), residuals and their variance by noise (outputs, n), nodes (outputs, K, d).
    Where no hyperparameters can be found they are the medians of their priors, and a `SurrogateWarning` says so. A second attempt begins
    at a draw of them: of its own seed, so that the same residuals give the same process.
    """
    sizes = np.sqrt(np.mean(left**2, axis=1))
    sizes = np.where(sizes > 0, sizes, 1.0)[:, None]
    count, _, d = x.shape
    batch = torch.Size([count])
    medians = np.array(settings.length_scales[:d])
    inputs = torch.as_tensor(x / medians)
    if settings.of_episode:
        inputs = torch.cat([inputs, torch.as_tensor(episode, dtype=inputs.dtype).expand(count, -1)[..., None]], dim=-1)

    def fresh() -> SingleTaskGP:
        # In units of their prior medians all length scales have the same prior.
        prior = LogNormalPrior(0.0, settings.length_scale_sd)
        kernel = MaternKernel(nu=1.5, ard_num_dims=d, active_dims=tuple(range(d)), lengthscale_prior=prior, batch_shape=batch)
        kernel.lengthscale = 1.0
        whole = kernel + _own(kernel, settings.of_episode) if settings.of_episode else kernel
        scaled = ScaleKernel(whole, outputscale_prior=LogNormalPrior(0.0, 1.0), batch_shape=batch)
        scaled.outputscale = 1.0
        return SingleTaskGP(
            inputs, torch.as_tensor(left / sizes)[..., None],
            torch.as_tensor(np.minimum(variance / sizes**2, 1e6))[..., None],
            covar_module=scaled, mean_module=ZeroMean(),
            outcome_transform=None, input_transform=None,
        )  # fmt: skip

    with reproducible(0):
        scaled: Any = fitted(fresh, f"the discrepancy of the twin in {x.shape[1]} bins", attempts=ATTEMPTS).covar_module
        with torch.no_grad():
            common, own = scaled.base_kernel.kernels if settings.of_episode else (scaled.base_kernel, None)
            kernels, scales = common(torch.as_tensor(nodes / medians)).to_dense().numpy(), scaled.outputscale.numpy()
            ratios = np.zeros(count) if own is None else own.outputscale.numpy()
    found = zip(kernels, sizes[:, 0], scales, ratios, strict=True)
    return tuple(_Fitted(kernel, float(size**2 * scale), float(ratio)) for kernel, size, scale, ratio in found)


def _own(common: MaternKernel, median: float) -> ScaleKernel:
    """r k(s, s') [e = e'], with e the column behind those of ``common``; its length scales are those of that one."""
    same = CategoricalKernel(active_dims=(common.ard_num_dims,), batch_shape=common.batch_shape)
    # exp(-1 / 0.01): another episode has nothing of it.
    same.lengthscale = 0.01
    same.raw_lengthscale.requires_grad_(requires_grad=False)
    own = ScaleKernel(common * same, outputscale_prior=LogNormalPrior(math.log(median), 1.0), batch_shape=common.batch_shape)
    own.outputscale = median
    return own


def _part(
    prior: NDArray[np.float64], ratio: float, variance: NDArray[np.float64], weights: NDArray[np.float64], together: NDArray[np.float64]
) -> _Part:
    """``together``: 1 for two bins of one episode, else 0."""
    cross, noise = weights @ prior, variance + JITTER * prior[0, 0]
    seen = cross @ weights.T * (1.0 + ratio * together)
    factor = cho_factor(seen + np.diag(noise), lower=True)
    return _Part(cho_solve(factor, cross).T, (1.0 + ratio) * prior, cross, noise, seen)


def _features(episode: Episode, names: Iterable[str], predicted: Mapping[str, NDArray[np.float64]] | None = None) -> NDArray[np.float64]:
    """Signals at both ends of every interval, shape (intervals, 2, names): as predicted, else as the episode has them, bridged."""

    def one(name: str) -> NDArray[np.float64]:
        if predicted and name in predicted:
            return predicted[name]
        if name in episode.input_names:
            out = np.repeat(episode.input[:, [episode.input_names.index(name)]], 2, axis=1)
        else:
            out = np.stack(episode.signal(name), axis=1)
        seen = np.isfinite(out)
        if seen.all():
            return out
        if not seen.any():
            raise ValueError(f"discrepancy: {name} was never measured in an episode of {counted(len(episode), 'interval')}")
        time = np.arange(seen.size).reshape(seen.shape)
        return np.asarray(np.where(seen, out, np.interp(time, time[seen], out[seen])))

    return np.stack([one(name) for name in names], axis=2)
