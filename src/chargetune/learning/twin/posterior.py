"""The posterior of a twin's unknowns: predicted with, and drawn from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from chargetune.learning.twin.rollout import slopes
from chargetune.learning.twin.twin import Twin

__all__ = ["Posterior"]


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
        """Unknowns of ``count`` plants that the data allow, shape (count, d); of every component as many as its share."""
        normal = np.random.default_rng(seed).standard_normal(
            (count, max(p.root.shape[1] for p in (self, *(p for _, p in self.components))))
        )
        if not self.components:
            return np.asarray(self.mode + normal @ self.root.T, dtype=np.float64)
        at = (np.random.default_rng([seed, 1]).permutation(count) + 0.5) / count
        bounds = np.cumsum([share for share, _ in self.components])
        parts = [self.components[k][1] for k in np.searchsorted(bounds[:-1], at)]
        return np.array([part.mode + part.root @ row[: part.root.shape[1]] for part, row in zip(parts, normal, strict=True)])

    def predicted_sd(self, inputs: NDArray[np.float64]) -> NDArray[np.float64]:
        """Standard deviation of a new noisy sample of each measured output under ``inputs``, shape (K, 2, outputs): by linearisation."""
        noise = np.array(list(self.twin.noise_sd.values()))
        variance = np.sum((slopes(self.twin, self.mode, inputs) @ self.root) ** 2, axis=-1) + self.discrepancy_sd**2 + noise**2
        return np.asarray(np.sqrt(variance), dtype=np.float64)
