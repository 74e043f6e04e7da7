"""The posterior of a twin's unknowns: predicted with, and drawn from."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from chargetune.learning.twin.rollout import slopes
from chargetune.learning.twin.twin import Twin

__all__ = ["Posterior"]


@dataclass(frozen=True)
class Posterior:
    """m ~ N(mode, root root') for the unknowns of ``twin``, and the standard deviation of what the model cannot represent, per output.

    ``spread`` is the standard deviation of a sample in the likelihood. ``components``, where there are some, say more of the shape:
    Gaussians, each with its share of the draws (`nested_laplace`). ``scored``: mode and root of the scores e where m is
    no linear function of them (`ScoredPrior`); then e is Gaussian, and mode and root of m are those to first order.
    """

    twin: Twin
    mode: NDArray[np.float64]
    root: NDArray[np.float64]
    discrepancy_sd: NDArray[np.float64]
    spread: NDArray[np.float64]
    components: tuple[tuple[float, Posterior], ...] = ()
    scored: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None

    @classmethod
    def of(
        cls,
        twin: Twin,
        mode: NDArray[np.float64],
        root: NDArray[np.float64],
        discrepancy_sd: NDArray[np.float64],
        spread: NDArray[np.float64],
        components: tuple[tuple[float, Posterior], ...] = (),
    ) -> Posterior:
        """The posterior of scores e ~ N(mode, root root')."""
        steep = twin.score_slopes(mode)
        scored = None if twin.prior is None else (mode, root)
        return cls(twin, twin.unknowns_at(mode), steep @ root, discrepancy_sd, spread, components, scored)

    @property
    def scores(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Mode and root of the scores e."""
        if self.scored is not None:
            return self.scored
        factor = self.twin.prior_factor
        return np.asarray(np.linalg.solve(factor, self.mode)), np.asarray(np.linalg.solve(factor, self.root))

    @property
    def covariance(self) -> NDArray[np.float64]:
        return self.root @ self.root.T

    def draw(self, count: int, seed: int) -> NDArray[np.float64]:
        """Unknowns of ``count`` plants that the data allow, shape (count, d); of every component as many as its share."""
        if self.scored is not None:
            return self.twin.unknowns_at(self.draw_scores(count, seed))
        normal = np.random.default_rng(seed).standard_normal(
            (count, max(p.root.shape[1] for p in (self, *(p for _, p in self.components))))
        )
        if not self.components:
            return np.asarray(self.mode + normal @ self.root.T, dtype=np.float64)
        at = (np.random.default_rng([seed, 1]).permutation(count) + 0.5) / count
        bounds = np.cumsum([share for share, _ in self.components])
        parts = [self.components[k][1] for k in np.searchsorted(bounds[:-1], at)]
        return np.array([part.mode + part.root @ row[: part.root.shape[1]] for part, row in zip(parts, normal, strict=True)])

    def draw_scores(self, count: int, seed: int) -> NDArray[np.float64]:
        """The scores e of the same plants, shape (count, score_count)."""
        if self.scored is None:
            return np.asarray(np.linalg.solve(self.twin.prior_factor, self.draw(count, seed).T).T)
        parts = tuple((share, replace(part, mode=part.scores[0], root=part.scores[1])) for share, part in self.components)
        return replace(self, mode=self.scored[0], root=self.scored[1], components=parts, scored=None).draw(count, seed)

    def predicted_sd(self, inputs: NDArray[np.float64], twin: Twin | None = None) -> NDArray[np.float64]:
        """Standard deviation of a new noisy sample of each measured output under ``inputs``, shape (K, 2, outputs): by linearisation.

        ``twin``: that in another condition.
        """
        noise = np.array(list(self.twin.noise_sd.values()))
        variance = np.sum((slopes(twin or self.twin, self.mode, inputs) @ self.root) ** 2, axis=-1) + self.discrepancy_sd**2 + noise**2
        return np.asarray(np.sqrt(variance), dtype=np.float64)
