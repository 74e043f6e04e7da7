"""The posterior of a twin's unknowns by Laplace's approximation.

Model: y = h(x, u, p) + bias + discrepancy, x+ = f(x, u, p), p = nominal * exp(m) for factors and nominal + m for offsets, with
prior m ~ N(0, S). Every measured output at both ends of every interval of every trial is a datum. The mode is found by Gauss-Newton
with exact sensitivities, the covariance is (J'J)^-1 of the whitened residuals there. Where that is not the posterior's shape along an
unknown that is one number, it is a sum of such Gaussians (`nested_laplace`).
Source: MacKay, Neural Computation 4 (1992) 448; Bock, in Modelling of Chemical Reaction Systems (1981) for the least squares.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from chargetune.episode.episode import Episode
from chargetune.learning.twin.nested_laplace import nested_laplace
from chargetune.learning.twin.posterior import Posterior
from chargetune.learning.twin.residuals import binned_residuals, measured
from chargetune.learning.twin.rollout import predict, slopes
from chargetune.learning.twin.settings import TwinSettings
from chargetune.learning.twin.twin import Twin
from chargetune.runtime.threads import parallel_map

__all__ = ["NegativeLogPosterior", "fit"]

# Tolerances of the least squares: a change of the loss, or of the unknowns, by less is not worth another evaluation.
FTOL, XTOL, EVALUATIONS = 1e-6, 1e-5, 30
# The same of the first of two fits, of which only the size of the residuals is used: with noise alone a plant of another kind has a
# long valley, and the size is known to a percent long before its end.
FTOL_FIRST = 1e-4
# Relative change of the sd of a sample after which no other fit is worth it.
SAME = 0.02


def fit(
    twin: Twin,
    episodes: Sequence[Episode],
    settings: TwinSettings | None = None,
    *,
    discrepancy: bool = True,
    start: Posterior | None = None,
) -> Posterior:
    """The posterior from the measured outputs of these episodes; samples that are not finite are left out.

    With ``discrepancy`` the residuals at the mode say how much the model cannot represent, and a second fit has the variance that
    this adds. Where the means of whole bins are not zero, neighbouring residuals have one cause, and all samples of as many bins as
    are correlated count as one. ``start`` is the posterior of most of these episodes, at whose mode the search begins. Without episodes
    the result is the prior.
    """
    settings = settings or TwinSettings()
    data = [(twin.under(e), e.input, measured(twin, e)) for e in episodes if len(e)]
    noise = np.array(list(twin.noise_sd.values()))
    e = np.zeros(twin.score_count) if start is None else start.scores[0]
    # The sd of a sample begins at the noise each time: taken over from fit to fit, mode and sd would follow each other.
    spread, unmodelled = noise, np.zeros(len(noise))
    for second in (False, True):
        loss = NegativeLogPosterior(twin, data, spread)
        ftol = FTOL if second or not (data and discrepancy) else FTOL_FIRST
        found = least_squares(loss.values, e, jac=loss.slopes, method="trf", x_scale=1.0, max_nfev=EVALUATIONS, ftol=ftol, xtol=XTOL)
        e = np.asarray(found.x, dtype=np.float64)
        if not (data and discrepancy):
            break
        residuals = [y - predict(own, twin.unknowns_at(e), u) for own, u, y in data]
        unmodelled, following = _unmodelled(residuals, noise, settings)
        # Mode, covariance and the sd of a sample belong to one fit.
        if second or np.allclose(following, spread, rtol=SAME):
            break
        spread = following
    # Eigenvalues of J'J, which is small, instead of singular values of J, which is long.
    curvature, directions = np.linalg.eigh(found.jac.T @ found.jac)
    root = np.asarray(directions / np.sqrt(curvature), dtype=np.float64)
    parts = nested_laplace(loss, e, root, twin.scalars) if data else []
    components = tuple((one.share, Posterior.of(twin, one.mode, one.root, unmodelled, spread)) for one in parts)
    return Posterior.of(twin, e, root, unmodelled, spread, components)


def _unmodelled(
    left: list[NDArray[np.float64]], noise: NDArray[np.float64], settings: TwinSettings
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """From residuals: (standard deviation of what the model cannot represent, that of a sample as the likelihood takes it)."""
    means, counts = (np.concatenate(parts) for parts in zip(*(binned_residuals(r, settings.bins) for r in left), strict=True))
    known = counts > 0
    size = np.maximum(known.sum(axis=0), 1)
    block = np.where(known, means, 0.0) ** 2 - np.where(known, noise**2 / np.maximum(counts, 1.0), 0.0)
    slow = np.maximum(block.sum(axis=0) / size, 0.0)
    square = np.concatenate([r.reshape(-1, len(noise)) for r in left]) ** 2
    whole = np.maximum(np.nanmean(np.where(np.isfinite(square).any(axis=0), square, 0.0), axis=0) - noise**2, slow)
    samples = counts.sum(axis=0) / size
    return np.sqrt(whole), np.sqrt(noise**2 + settings.correlated_bins * samples * slow + (whole - slow))


class NegativeLogPosterior:
    """|e|^2 + sum |(y - h(m(e))) / spread|^2 as the square of d + 1 numbers instead of as many as there are samples.

    With r the residuals and J their slopes, the triangle R of [J r] = Q R has the same J'J, J'r and r'r, which is all that a
    least-squares step sees. From the Cholesky factor of [J r]'[J r]: the prior keeps it far from singular.
    """

    def __init__(
        self, twin: Twin, data: Sequence[tuple[Twin, NDArray[np.float64], NDArray[np.float64]]], spread: NDArray[np.float64]
    ) -> None:
        # Of each episode: the twin in its condition, and its inputs.
        self._twin, self._under, self._inputs = twin, [own for own, _, _ in data], [u for _, u, _ in data]
        # Weight of each sample, 0 where none was measured, and the weighted measurement.
        self._weights = [np.where(np.isfinite(y), 1.0 / spread, 0.0).ravel() for _, _, y in data]
        self._wanted = [weight * np.nan_to_num(y.ravel()) for (_, _, y), weight in zip(data, self._weights, strict=True)]
        self._at, self._triangle = np.zeros(0), np.zeros((0, 0))

    def values(self, e: NDArray[np.float64]) -> NDArray[np.float64]:
        """Shape (d + 1,)."""
        return np.asarray(self._known(e)[:, -1])

    def slopes(self, e: NDArray[np.float64]) -> NDArray[np.float64]:
        """With respect to e, shape (d + 1, d)."""
        return np.asarray(self._known(e)[:, :-1])

    def _known(self, e: NDArray[np.float64]) -> NDArray[np.float64]:
        if not np.array_equal(e, self._at):
            own = np.hstack([np.eye(len(e)), e[:, None]])
            m, steep = self._twin.unknowns_at(e), self._twin.score_slopes(e)
            whitened = np.zeros((len(m) + 1, len(e) + 1))
            whitened[:-1, :-1], whitened[-1, -1] = steep, 1.0
            parts = parallel_map(partial(_square, m), self._under, self._inputs, self._weights, self._wanted)
            squares = [whitened.T @ part @ whitened for part in parts]
            total = sum(squares, start=own.T @ own)
            # Where the data fit to the last digit nothing is left of the last pivot but rounding.
            total[-1, -1] += np.finfo(float).eps * (1.0 + np.trace(total))
            self._at, self._triangle = e.copy(), np.linalg.cholesky(total).T
        return self._triangle


def _square(
    m: NDArray[np.float64], twin: Twin, inputs: NDArray[np.float64], weight: NDArray[np.float64], wanted: NDArray[np.float64]
) -> NDArray[np.float64]:
    """[J r]'[J r] of one episode, with the slopes J of its weighted predictions with respect to m, shape (d + 1, d + 1)."""
    d = len(m)
    both = np.empty((len(weight), d + 1))
    both[:, :d], both[:, d] = slopes(twin, m, inputs).reshape(-1, d), predict(twin, m, inputs).ravel()
    # What was not measured may be predicted to be no number.
    both[weight == 0.0] = 0.0
    both *= weight[:, None]
    both[:, d] -= wanted
    return np.asarray(both.T @ both)
