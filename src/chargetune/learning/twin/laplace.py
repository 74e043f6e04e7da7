"""How far a twin is from what was measured, for a least-squares search of its unknowns."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from chargetune.runtime.threads import parallel_map

if TYPE_CHECKING:
    from chargetune.learning.twin.twin import Twin

__all__ = ["NegativeLogPosterior"]


class NegativeLogPosterior:
    """|e|^2 + sum |(y - h(factor e)) / spread|^2 as the square of d + 1 numbers instead of as many as there are samples.

    With r the residuals and J their slopes, the triangle R of [J r] = Q R has the same J'J, J'r and r'r, which is all that a
    least-squares step sees. From the Cholesky factor of [J r]'[J r]: the prior keeps it far from singular.
    """

    def __init__(self, twin: Twin, data: Sequence[tuple[NDArray[np.float64], NDArray[np.float64]]], spread: NDArray[np.float64]) -> None:
        self._twin, self._inputs = twin, [u for u, _ in data]
        # Of every sample its weight, 0 where none was measured, and what was measured times that.
        self._weights = [np.where(np.isfinite(y), 1.0 / spread, 0.0).ravel() for _, y in data]
        self._wanted = [weight * np.nan_to_num(y.ravel()) for (_, y), weight in zip(data, self._weights, strict=True)]
        d = len(twin.prior_factor)
        self._whitened = np.eye(d + 1)
        self._whitened[:d, :d] = twin.prior_factor
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
            squares = parallel_map(self._square, [e] * len(self._inputs), self._inputs, self._weights, self._wanted)
            total = sum(squares, start=own.T @ own)
            # Where the data fit to the last digit nothing is left of the last pivot but rounding.
            total[-1, -1] += np.finfo(float).eps * (1.0 + np.trace(total))
            self._at, self._triangle = e.copy(), np.linalg.cholesky(total).T
        return self._triangle

    def _square(
        self, e: NDArray[np.float64], inputs: NDArray[np.float64], weight: NDArray[np.float64], wanted: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        twin, d = self._twin, len(e)
        m = twin.prior_factor @ e
        both = np.empty((len(weight), d + 1))
        both[:, :d], both[:, d] = twin.slopes(m, inputs).reshape(-1, d), twin.predict(m, inputs).ravel()
        # What was not measured may be predicted to be no number.
        both[weight == 0.0] = 0.0
        both *= weight[:, None]
        both[:, d] -= wanted
        return np.asarray(self._whitened.T @ (both.T @ both) @ self._whitened)
