"""Twin: what whole measured traces say of a plant's parameters, as a posterior that can be predicted with and drawn from.

Model: y = h(x, u, p) + bias + discrepancy, x+ = f(x, u, p), p = nominal * exp(m) for factors and nominal + m for offsets, with
prior m ~ N(0, S). Every measured output at both ends of every interval of every trial is a datum. The posterior is Laplace's: mode by
Gauss-Newton with exact sensitivities from CasADi, covariance (J'J)^-1 of the whitened residuals at the mode; where that is not its shape
along an unknown that is one number, a sum of such Gaussians (`sections`).
Source: MacKay, Neural Computation 4 (1992) 448; Bock, in Modelling of Chemical Reaction Systems (1981) for the least squares.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from chargetune.episode.episode import Episode
from chargetune.learning.twin.laplace import NegativeLogPosterior
from chargetune.learning.twin.nested_laplace import nested_laplace
from chargetune.learning.twin.posterior import Posterior
from chargetune.learning.twin.residuals import CORRELATED_BINS, binned_residuals
from chargetune.learning.twin.rollout import (
    AT_ONCE,
    _evaluated,
    _Key,
    _mapping,
    _numbers,
    _padded,
    _slot,
)
from chargetune.model.model import Model
from chargetune.runtime.threads import parallel_map

if TYPE_CHECKING:
    from chargetune.learning.twin.calibration import PredictionCheck
    from chargetune.learning.twin.discrepancy import Discrepancy

__all__ = ["Twin", "Uncertain"]

# Refits with a discrepancy taken from the residuals; it changes by less than a tenth after the second.
REFITS = 2
# A step that changes the misfit, or the unknowns, by less than this is the last one.
FTOL, XTOL = 1e-6, 1e-5
# The same of the misfit where the search begins at the end of an earlier one. With noise alone a plant of another kind has a long valley,
# which 30 evaluations did not come to the end of; what is wanted there is the size of the residuals, and that is known to a percent.
FTOL_KNOWN = 1e-4


@dataclass(frozen=True)
class Uncertain:
    """A parameter block, a state at the start, or the constant error of a measured output, that is not known.

    sd
        Standard deviation of ln(p / nominal) for a factor, of p - nominal for an offset, of what is added to the output for a bias.
    smooth
        Correlation of neighbouring entries of a block: entries i and j have correlation smooth^|i - j|.
    """

    name: str
    sd: float
    kind: Literal["factor", "offset", "start", "bias"] = "factor"
    smooth: float = 0.0

    def __post_init__(self) -> None:
        if self.kind not in ("factor", "offset", "start", "bias"):
            raise ValueError(f"twin: kind of {self.name} = {self.kind!r}, allowed is 'factor', 'offset', 'start' or 'bias'")
        for name, low, high in (("sd", 0.0, math.inf), ("smooth", 0.0, 1.0)):
            value = getattr(self, name)
            number = isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
            if not number or value < low or value >= high or (name == "sd" and value == 0):
                raise ValueError(f"twin: {name} of {self.name} = {value!r}, allowed is {'> 0' if name == 'sd' else '[0, 1)'}")


@dataclass(frozen=True)
class Twin:
    """A `Model` of the plant, what of it is unknown, and which outputs are measured with what noise.

    ``noise_sd`` maps the measured outputs to the standard deviation of one sample, ``start`` the states at the start of every
    trial to their nominal value (others are 0). ``discrepancy_sd_floor`` is by how much at least an output may be off at the largest input
    where nothing was measured, however well the model fits elsewhere; its variance is proportional to the input, down to the
    share ``floor_at_zero_input`` of it: wrong resistances do no harm where nothing flows, a wrong output at rest does.
    Raises ValueError for what the model does not have.
    """

    model: Model
    unknowns: tuple[Uncertain, ...]
    noise_sd: Mapping[str, float]
    start: Mapping[str, float] = field(default_factory=dict)
    discrepancy_sd_floor: Mapping[str, float] = field(default_factory=dict)
    floor_at_zero_input: float = 0.0

    def __post_init__(self) -> None:
        model = self.model
        blocks = set(model.parameter_blocks)
        known = {"start": set(model.state_names), "factor": blocks, "offset": blocks, "bias": set(self.noise_sd)}
        for one in self.unknowns:
            if one.name not in known[one.kind]:
                raise ValueError(f"twin: unknown {one.kind} {one.name!r}, allowed are {', '.join(sorted(known[one.kind]))}")
        names = [_slot(one) for one in self.unknowns]
        if not names or len(set(names)) < len(names):
            raise ValueError(f"twin: unknowns = {[n for n, _ in names]}, allowed is each once, at least one")
        outputs = tuple(self.noise_sd)
        named = (
            ("noise_sd", outputs, model.output_names),
            ("start", self.start, model.state_names),
            ("discrepancy_sd_floor", self.discrepancy_sd_floor, outputs),
        )
        for label, given, allowed in named:
            unknown = sorted(set(given) - set(allowed))
            if unknown:
                raise ValueError(f"twin: {label} names {unknown}, allowed are {', '.join(allowed)}")
        if not self.noise_sd or not all(math.isfinite(v) and v > 0 for v in self.noise_sd.values()):
            raise ValueError(f"twin: noise_sd = {dict(self.noise_sd)}, allowed are finite numbers > 0 for at least one output")

    @cached_property
    def sizes(self) -> tuple[int, ...]:
        """Entries of each unknown."""
        return tuple(1 if one.kind in ("start", "bias") else self.model.parameter_blocks[one.name] for one in self.unknowns)

    @cached_property
    def predicted_before(self) -> dict[bytes, PredictionCheck]:
        """How well episodes were predicted_before, as far as it is known (`ensemble.condition`)."""
        return {}

    @cached_property
    def ways(self) -> dict[bytes, tuple[NDArray[np.float64], ...]]:
        """`Posterior.way` after some episodes: the next fit goes along it."""
        return {}

    @cached_property
    def newest(self) -> dict[bytes, Discrepancy]:
        """What was learnt last, posterior included. It is large, and no other is kept."""
        return {}

    @property
    def scalars(self) -> list[int]:
        """Entries of the unknowns that are one number: the prior knows each apart from all others."""
        return [int(at) for at, size in zip(np.cumsum([0, *self.sizes[:-1]]), self.sizes, strict=True) if size == 1]

    @cached_property
    def factors(self) -> NDArray[np.bool_]:
        """Which of the unknowns m are logarithms of factors, shape (d,)."""
        return np.repeat([one.kind == "factor" for one in self.unknowns], self.sizes)

    @cached_property
    def prior_factor(self) -> NDArray[np.float64]:
        """Lower Cholesky factor of the prior covariance S, shape (d, d)."""
        out = np.zeros((sum(self.sizes), sum(self.sizes)))
        start = 0
        for one, size in zip(self.unknowns, self.sizes, strict=True):
            steps = np.abs(np.subtract.outer(np.arange(size), np.arange(size)))
            part = slice(start, start + size)
            correlation = np.where(steps == 0, 1.0, one.smooth**steps)
            out[part, part] = one.sd * np.linalg.cholesky(correlation)
            start += size
        return out

    def parameters(self, m: NDArray[np.float64]) -> NDArray[np.float64]:
        """The model's parameter vector p for unknowns m, shape (np,)."""
        return np.array(_mapping(_Key(self))[0](m, *_numbers(self))).ravel()

    def start_state(self, m: NDArray[np.float64]) -> NDArray[np.float64]:
        """The state at the start of a trial for unknowns m, shape (nx,)."""
        return np.array(_mapping(_Key(self))[1](m, *_numbers(self))).ravel()

    def biases(self, m: NDArray[np.float64]) -> dict[str, float]:
        """What is added to measured outputs for unknowns m, by output."""
        pieces = np.split(np.asarray(m), np.cumsum(self.sizes)[:-1])
        return {one.name: float(piece[0]) for one, piece in zip(self.unknowns, pieces, strict=True) if one.kind == "bias"}

    def predict(self, m: NDArray[np.float64], inputs: NDArray[np.float64]) -> NDArray[np.float64]:
        """Measured outputs at both ends of every interval under ``inputs`` (K, nu), shape (K, 2, number of measured outputs)."""
        return self.predict_each(m, [inputs])[0]

    def predict_each(self, m: NDArray[np.float64], inputs: Sequence[NDArray[np.float64]]) -> list[NDArray[np.float64]]:
        """`predict` under the inputs of each of several episodes, at once; of m (n, d) each is of shape (n, K, 2, outputs)."""
        return self._roll(0, m, inputs, (2, len(self.noise_sd)))

    def slopes(self, m: NDArray[np.float64], inputs: NDArray[np.float64]) -> NDArray[np.float64]:
        """Exact slopes of `predict` with respect to m, shape (K, 2, number of measured outputs, d)."""
        return self.slopes_each(m, [inputs])[0]

    def slopes_each(self, m: NDArray[np.float64], inputs: Sequence[NDArray[np.float64]]) -> list[NDArray[np.float64]]:
        """`slopes` under the inputs of each of several episodes, at once."""
        return self._roll(1, m, inputs, (2, len(self.noise_sd), sum(self.sizes)))

    def _roll(
        self, which: int, m: NDArray[np.float64], inputs: Sequence[NDArray[np.float64]], shape: tuple[int, ...]
    ) -> list[NDArray[np.float64]]:
        """What the function of that number says of each interval, in this shape, after the first axes of m."""
        padded = np.zeros((len(inputs), _padded(max(len(u) for u in inputs)), len(self.model.inputs)))
        for row, u in zip(padded, inputs, strict=True):
            row[: len(u)] = u
        function = partial(_evaluated, _Key(self), which, padded)
        several, d = m.shape[:-1], m.shape[-1]
        rows = m.reshape(-1, d)
        parts = parallel_map(function, [rows[i : i + AT_ONCE] for i in range(0, len(rows), AT_ONCE)]) if len(rows) > 1 else [function(rows)]
        out = np.concatenate(parts).reshape(len(rows), *padded.shape[:2], *shape)
        return [out[:, k, : len(u)].reshape(*several, len(u), *shape) for k, u in enumerate(inputs)]

    def measured(self, episode: Episode) -> NDArray[np.float64]:
        """The measured outputs at both ends of every interval, shape (K, 2, number of measured outputs)."""
        return np.stack([np.stack(episode.signal(name), axis=1) for name in self.noise_sd], axis=2)

    def fit(self, episodes: Sequence[Episode], *, discrepancy: bool = True, way: Sequence[NDArray[np.float64]] = ()) -> Posterior:
        """The posterior from the measured outputs of these episodes; samples that are not finite are left out.

        With ``discrepancy`` the residuals at the mode say how much the model cannot represent, and the fit is repeated with
        the variance it adds. Where the means of whole stretches are not zero, neighbouring residuals have one cause, and all
        samples of `CORRELATED_BINS` stretches count as one. ``way`` are the modes that a fit of most of these episodes went through: each of
        its searches begins where that one's ended. Without episodes it is the prior.
        """
        names, factor = list(self.noise_sd), self.prior_factor
        data = [(e.input, self.measured(e)) for e in episodes if len(e)]
        noise = np.array([self.noise_sd[name] for name in names])
        e, spread, cost_jacobian, unmodelled = np.zeros(len(factor)), noise, np.eye(len(factor)), np.zeros(len(names))
        modes: list[NDArray[np.float64]] = []
        for k in range(1 + REFITS):
            known = bool(data) and k < len(way)
            begin, ftol = (np.linalg.solve(factor, way[k]), FTOL_KNOWN) if known else (e, FTOL)
            misfit = NegativeLogPosterior(self, data, spread)
            found = least_squares(misfit.values, begin, jac=misfit.slopes, method="trf", x_scale=1.0, max_nfev=30, ftol=ftol, xtol=XTOL)
            e, cost_jacobian = found.x, found.jac
            modes.append(factor @ e)
            if not (data and discrepancy):
                break
            predicted = self.predict_each(factor @ e, [u for u, _ in data])
            unmodelled, following = _unmodelled([y - own for (_, y), own in zip(data, predicted, strict=True)], noise)
            # Mode, curvature, sections and draws belong to the spread of the last fit: after it there is no new one.
            if k == REFITS or np.allclose(following, spread, rtol=0.02):
                break
            spread = following
        # Eigenvalues of J'J, which is small, instead of singular values of J, which is long.
        curvature, directions = np.linalg.eigh(cost_jacobian.T @ cost_jacobian)
        root = factor @ (directions / np.sqrt(curvature))
        seen = tuple((u, np.isfinite(y)) for u, y in data)
        parts = nested_laplace(misfit, np.asarray(e, np.float64), np.asarray(directions / np.sqrt(curvature)), self.scalars) if data else []
        apart = tuple((one.share, Posterior(self, factor @ one.mode, factor @ one.root, unmodelled, spread, seen)) for one in parts)
        return Posterior(self, factor @ e, root, unmodelled, spread, seen, apart, tuple(modes))


def _unmodelled(left: list[NDArray[np.float64]], noise: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """From residuals: (standard deviation of what the model cannot represent, that of a sample as the likelihood takes it)."""
    means, counts = (np.concatenate(parts) for parts in zip(*(binned_residuals(r) for r in left), strict=True))
    known = counts > 0
    size = np.maximum(known.sum(axis=0), 1)
    block = np.where(known, means, 0.0) ** 2 - np.where(known, noise**2 / np.maximum(counts, 1.0), 0.0)
    slow = np.maximum(block.sum(axis=0) / size, 0.0)
    square = np.concatenate([r.reshape(-1, len(noise)) for r in left]) ** 2
    whole = np.maximum(np.nanmean(np.where(np.isfinite(square).any(axis=0), square, 0.0), axis=0) - noise**2, slow)
    together = counts.sum(axis=0) / size
    return np.sqrt(whole), np.sqrt(noise**2 + CORRELATED_BINS * together * slow + (whole - slow))
