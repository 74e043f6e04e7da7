"""The posterior of a twin's unknowns: predicted with, and drawn from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from chargetune.learning.twin.rollout import slopes
from chargetune.learning.twin.twin import Twin

__all__ = ["Posterior"]

# Where a factor would fall below this share of what it is at the mode, its logarithm goes on as a straight line.
STRAIGHT = 0.5


@dataclass(frozen=True)
class Posterior:
    """m ~ N(mode, root root') for the unknowns of ``twin``, and the standard deviation of what the model cannot represent, per output.

    ``spread`` is the standard deviation of a sample in the likelihood. ``components``, where there are some, say more of the shape:
    Gaussians, each with its share of the draws (`nested_laplace`).
    """

    twin: Twin
    mode: NDArray[np.float64]
    root: NDArray[np.float64]
    discrepancy_sd: NDArray[np.float64]
    spread: NDArray[np.float64]
    components: tuple[tuple[float, Posterior], ...] = ()

    @property
    def covariance(self) -> NDArray[np.float64]:
        return self.root @ self.root.T

    def draw(self, count: int, seed: int) -> NDArray[np.float64]:
        """Unknowns of ``count`` plants that the data allow, shape (count, d); of every component as many as its share.

        A factor is drawn as exp(mode) (1 + x), x the Gaussian draw, because predictions are more nearly linear in a factor than in its
        logarithm: two resistances in series whose sum is known then keep their sum.
        """
        width = max(part.root.shape[1] for part in (self, *(part for _, part in self.components)))
        normal = np.random.default_rng(seed).standard_normal((count, width))
        parts = [self] * count
        if self.components:
            at = (np.random.default_rng([seed, 1]).permutation(count) + 0.5) / count
            bounds = np.cumsum([share for share, _ in self.components])
            parts = [self.components[k][1] for k in np.searchsorted(bounds[:-1], at)]
        return np.array([part._moved(part.root @ row[: part.root.shape[1]]) for part, row in zip(parts, normal, strict=True)])  # noqa: SLF001

    def _moved(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """The unknowns whose factors are 1 + x times those of the mode, and the others x more than there."""
        # Below STRAIGHT the tangent: a factor has no logarithm at 0, and draws of what is hardly known go there.
        at = np.maximum(x, STRAIGHT - 1.0)
        return self.mode + np.where(self.twin.factors, np.log1p(at) + (x - at) / (1.0 + at), x)

    def predicted_sd(self, inputs: NDArray[np.float64]) -> NDArray[np.float64]:
        """Standard deviation of a new noisy sample of each measured output under ``inputs``, shape (K, 2, outputs): by linearisation."""
        noise = np.array(list(self.twin.noise_sd.values()))
        variance = np.sum((slopes(self.twin, self.mode, inputs) @ self.root) ** 2, axis=-1) + self.discrepancy_sd**2 + noise**2
        return np.asarray(np.sqrt(variance), dtype=np.float64)
