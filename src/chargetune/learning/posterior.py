"""The posterior of a twin's unknowns: predicted with, and drawn from."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lu_factor, lu_solve

from chargetune.episode.cores import each

if TYPE_CHECKING:
    from chargetune.learning.twin import Twin

__all__ = ["Posterior"]

# Steps by which a draw is brought to what it should predict; twice the loss of log-likelihood at which it may stay, and at which it is
# there: another step would not be seen in the data.
CHORDS, MISFIT, THERE = 6, 9.0, 0.3
# The slopes at a draw serve the next step too when the last one left less than this share of the loss.
KEPT = 0.2


@dataclass(frozen=True)
class Posterior:
    """m ~ N(mode, root root') for the unknowns of ``twin``, and the standard deviation of what the model cannot represent, per output.

    ``spread`` is the standard deviation of a sample in the likelihood, ``seen`` the inputs of each episode and which of its
    samples were measured. ``sections``, where there are some, say more of its shape: Gaussians, each with its share of the draws.
    """

    twin: Twin
    mode: NDArray[np.float64]
    root: NDArray[np.float64]
    discrepancy_sd: NDArray[np.float64]
    spread: NDArray[np.float64]
    seen: tuple[tuple[NDArray[np.float64], NDArray[np.bool_]], ...] = ()
    sections: tuple[tuple[float, Posterior], ...] = ()

    @property
    def covariance(self) -> NDArray[np.float64]:
        return self.root @ self.root.T

    def draw(self, count: int, seed: int) -> NDArray[np.float64]:
        """Unknowns of ``count`` plants that the data allow, shape (count, d).

        A Gaussian draw of two resistances in series whose sum alone is known misses the sum, because it is not linear in their
        logarithms. So each draw m' is moved to where what it predicts is what it would predict if the model were linear:

            min over m  |y(m) - y(mode) - J (m' - mode)|^2 + |m - m'|^2

        in the metrics of likelihood and prior, J the slopes at the mode (randomise, then optimise; Bardsley et al., SIAM J. Sci.
        Comput. 36 (2014) A1895): steps with the mode's slopes, with its own where these do not lead there. A draw that
        neither brings below `MISFIT` is halved towards the mode.
        """
        normal = np.random.default_rng(seed).standard_normal((count, self.root.shape[1]))
        if not self.seen:
            return np.asarray(self.mode + normal @ self.root.T, dtype=np.float64)
        parts = self._parts(count, seed)
        # What all draws of one part share is computed before they part.
        for part in {id(part): part for part in parts}.values():
            part.prepare()
        return np.array(each(Posterior.moved, parts, [part.root @ z for part, z in zip(parts, normal, strict=True)]))

    def _parts(self, count: int, seed: int) -> list[Posterior]:
        """Of which Gaussian each of so many draws is: of every section as many as its share is of all."""
        if not self.sections:
            return [self] * count
        at = (np.random.default_rng([seed, 1]).permutation(count) + 0.5) / count
        bounds = np.cumsum([share for share, _ in self.sections])
        return [self.sections[k][1] for k in np.searchsorted(bounds[:-1], at)]

    def prepare(self) -> None:
        """What every draw needs, once."""
        _ = self._at_mode, self._precision

    def moved(self, draw: NDArray[np.float64]) -> NDArray[np.float64]:
        """The mode and a Gaussian draw of the difference from it -> the unknowns that predict what they should (`draw`)."""
        for fresh in (False, True, True):
            m = self.mode + draw
            wanted = [values + slopes @ draw for values, slopes, _ in self._at_mode]
            misfit, pull = self._misfit(m, draw, wanted)
            if not np.isfinite(misfit):
                draw = draw * 0.5
                continue
            curvature, fallen = None, 1.0
            for _ in range(CHORDS):
                if fresh and (curvature is None or fallen > KEPT):
                    slopes = self._curvature(m)
                    if not np.all(np.isfinite(slopes)):
                        break
                    curvature = lu_factor(slopes)
                step = lu_solve(curvature, pull) if curvature is not None else self.root @ (self.root.T @ pull)
                shares = (1.0, 0.5, 0.25) if fresh else (1.0,)
                for share in shares:
                    ahead = m - share * step
                    other, following = self._misfit(ahead, draw, wanted)
                    if other < misfit:
                        break
                else:
                    break
                gain, fallen = misfit - other, other / misfit
                m, misfit, pull = ahead, other, following
                if gain < 0.05 or misfit < THERE:
                    break
            if misfit < MISFIT:
                return m
            draw = draw * (0.5 if fresh else 1.0)
        return self.mode + draw

    @cached_property
    def _at_mode(self) -> list[tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]]:
        """Of each episode the outputs at the mode and their slopes, shapes (n,) and (n, d), and the weights, in sd; 0 where not seen."""
        out = []
        for u, seen in self.seen:
            weight = np.where(seen, 1.0 / self.spread, 0.0).ravel()
            out.append((weight * self._predicted(self.mode, u, weight), weight[:, None] * self._slopes(self.mode, u, weight), weight))
        return out

    def _predicted(self, m: NDArray[np.float64], u: NDArray[np.float64], weight: NDArray[np.float64]) -> NDArray[np.float64]:
        """0 where nothing was measured: what is predicted there may be no number."""
        return np.where(weight > 0.0, self.twin.predict(m, u).ravel(), 0.0)

    def _slopes(self, m: NDArray[np.float64], u: NDArray[np.float64], weight: NDArray[np.float64]) -> NDArray[np.float64]:
        slopes = self.twin.slopes(m, u).reshape(-1, m.size)
        slopes[weight == 0.0] = 0.0
        return slopes

    @cached_property
    def _precision(self) -> NDArray[np.float64]:
        return np.asarray(np.linalg.inv(self.twin.prior_factor @ self.twin.prior_factor.T))

    def _misfit(
        self, m: NDArray[np.float64], draw: NDArray[np.float64], wanted: list[NDArray[np.float64]]
    ) -> tuple[float, NDArray[np.float64]]:
        """What `draw` minimises at m, and half its gradient with the slopes of the mode; ``wanted``: what it should predict, in sd."""
        away = m - self.mode - draw
        pull = self._precision @ away
        total = float(away @ pull)
        for (u, _), (_, slopes, weight), target in zip(self.seen, self._at_mode, wanted, strict=True):
            # A long step may lead where outputs are not finite: their misfit is nan, which is smaller than none, and it is not taken.
            with np.errstate(invalid="ignore", over="ignore"):
                left = weight * self._predicted(m, u, weight) - target
                total += float(left @ left)
                pull = pull + left @ slopes
        return total, pull

    def _curvature(self, m: NDArray[np.float64]) -> NDArray[np.float64]:
        """J'J of the whitened residuals at m, in the metric of the slopes that `_misfit` pulls with."""
        total = self._precision.copy()
        for (u, _), (_, slopes, weight) in zip(self.seen, self._at_mode, strict=True):
            own = self._slopes(m, u, weight)
            with np.errstate(invalid="ignore", over="ignore"):
                total += (weight[:, None] * slopes).T @ own
        return total

    def predicted_sd(self, inputs: NDArray[np.float64]) -> NDArray[np.float64]:
        """Standard deviation of a new noisy sample of each measured output under ``inputs``, shape (K, 2, outputs): by linearisation."""
        twin = self.twin
        slopes = twin.slopes(self.mode, inputs)
        noise = np.array(list(twin.noise_sd.values()))
        variance = np.sum((slopes @ self.root) ** 2, axis=-1) + self.discrepancy_sd**2 + noise**2
        return np.asarray(np.sqrt(variance), dtype=np.float64)
