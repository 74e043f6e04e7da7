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
# A step that wins less of it was the last one.
LITTLE = 0.05
# The slopes at a draw serve the next step too when the last one left less than this share of the loss.
KEPT = 0.2


@dataclass(frozen=True)
class Posterior:
    """m ~ N(mode, root root') for the unknowns of ``twin``, and the standard deviation of what the model cannot represent, per output.

    ``spread`` is the standard deviation of a sample in the likelihood, ``seen`` the inputs of each episode and which of its
    samples were measured. ``sections``, where there are some, say more of its shape: Gaussians, each with its share of the draws.
    ``way``: the modes that its fit went through, the last one its own.
    """

    twin: Twin
    mode: NDArray[np.float64]
    root: NDArray[np.float64]
    discrepancy_sd: NDArray[np.float64]
    spread: NDArray[np.float64]
    seen: tuple[tuple[NDArray[np.float64], NDArray[np.bool_]], ...] = ()
    sections: tuple[tuple[float, Posterior], ...] = ()
    way: tuple[NDArray[np.float64], ...] = ()

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
        parts, out = self._parts(count, seed), np.empty((count, self.mode.size))
        for part in {id(part): part for part in parts}.values():
            own = [i for i, other in enumerate(parts) if other is part]
            out[own] = part.moved(normal[own] @ part.root.T)
        return out

    def _parts(self, count: int, seed: int) -> list[Posterior]:
        """Of which Gaussian each of so many draws is: of every section as many as its share is of all."""
        if not self.sections:
            return [self] * count
        at = (np.random.default_rng([seed, 1]).permutation(count) + 0.5) / count
        bounds = np.cumsum([share for share, _ in self.sections])
        return [self.sections[k][1] for k in np.searchsorted(bounds[:-1], at)]

    def moved(self, draws: NDArray[np.float64]) -> NDArray[np.float64]:
        """The mode and Gaussian draws of the difference from it -> unknowns that predict what they should (`draw`), both (count, d)."""
        m, misfit = self._along(draws)
        there = misfit < MISFIT
        # What led nowhere is shorter from the start.
        left = np.where(np.isfinite(misfit)[:, None], 1.0, 0.5) * draws
        m[~there] = np.array(each(self._led, left[~there])).reshape(-1, self.mode.size)
        return m

    def _along(self, draws: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Where steps with the mode's slopes lead, and the misfit there, shapes (count, d) and (count,); all draws at once."""
        m, wanted = self.mode + draws, self._wanted(draws)
        misfit, pull = self._misfit(m, draws, wanted)
        going, inverse = np.flatnonzero(np.isfinite(misfit)), self.covariance
        for _ in range(CHORDS):
            if not going.size:
                break
            ahead = m[going] - pull[going] @ inverse
            other, following = self._misfit(ahead, draws[going], wanted[going])
            gain = misfit[going] - other
            better = gain > 0.0
            at = going[better]
            m[at], misfit[at], pull[at] = ahead[better], other[better], following[better]
            going = at[(gain[better] >= LITTLE) & (other[better] >= THERE)]
        return m, misfit

    def _led(self, draw: NDArray[np.float64]) -> NDArray[np.float64]:
        """Where steps with their own slopes lead a single draw that those of the mode do not; halved where these do not either."""
        for _ in range(2):
            m, wanted = (self.mode + draw)[None], self._wanted(draw[None])
            misfit, pull = self._misfit(m, draw, wanted)
            curvature, fallen = None, 1.0
            for _ in range(CHORDS if np.isfinite(misfit[0]) else 0):
                if curvature is None or fallen > KEPT:
                    slopes = self._curvature(m[0])
                    if not np.all(np.isfinite(slopes)):
                        break
                    curvature = lu_factor(slopes)
                step = lu_solve(curvature, pull[0])
                for share in (1.0, 0.5, 0.25):
                    ahead = m - share * step
                    other, following = self._misfit(ahead, draw, wanted)
                    if other[0] < misfit[0]:
                        break
                else:
                    break
                gain, fallen = misfit[0] - other[0], other[0] / misfit[0]
                m, misfit, pull = ahead, other, following
                if gain < LITTLE or misfit[0] < THERE:
                    break
            if misfit[0] < MISFIT:
                return np.asarray(m[0])
            draw = draw * 0.5
        return self.mode + draw

    @cached_property
    def _weight(self) -> NDArray[np.float64]:
        """Of every sample of every episode, 1 / sd; 0 where it was not seen. Shape (n,)."""
        return np.concatenate([np.where(seen, 1.0 / self.spread, 0.0).ravel() for _, seen in self.seen])

    @cached_property
    def _at_mode(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """All samples predicted at the mode and their slopes there, in sd, shapes (n,) and (n, d)."""
        return self._predicted(self.mode[None])[0], self._slopes(self.mode)

    def _predicted(self, m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Of each of several unknowns (count, d), in sd; 0 where nothing was measured: what is predicted there may be no number."""
        values = self.twin.predict_each(m, [u for u, _ in self.seen])
        flat = np.concatenate(values, axis=1).reshape(len(m), -1)
        flat[:, self._weight == 0.0] = 0.0
        return np.asarray(self._weight * flat)

    def _slopes(self, m: NDArray[np.float64]) -> NDArray[np.float64]:
        values = self.twin.slopes_each(m, [u for u, _ in self.seen])
        slopes = np.concatenate(values).reshape(-1, m.size)
        slopes[self._weight == 0.0] = 0.0
        return np.asarray(self._weight[:, None] * slopes)

    def _wanted(self, draws: NDArray[np.float64]) -> NDArray[np.float64]:
        """What draws of the difference from the mode should predict, in sd, shape (count, n)."""
        values, slopes = self._at_mode
        return np.asarray(values + draws @ slopes.T)

    @cached_property
    def _precision(self) -> NDArray[np.float64]:
        return np.asarray(np.linalg.inv(self.twin.prior_factor @ self.twin.prior_factor.T))

    def _misfit(
        self, m: NDArray[np.float64], draw: NDArray[np.float64], wanted: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """What `draw` minimises at each m, and half its gradient with the slopes of the mode, shapes (count,) and (count, d)."""
        away = m - self.mode - draw
        pull = away @ self._precision
        # A long step may lead where outputs are not finite: their misfit is nan, which is smaller than none, and it is not taken.
        with np.errstate(invalid="ignore", over="ignore"):
            left = self._predicted(m) - wanted
            return np.sum(away * pull, axis=1) + np.sum(left**2, axis=1), pull + left @ self._at_mode[1]

    def _curvature(self, m: NDArray[np.float64]) -> NDArray[np.float64]:
        """J'J of the whitened residuals at m, in the metric of the slopes that `_misfit` pulls with."""
        with np.errstate(invalid="ignore", over="ignore"):
            return np.asarray(self._precision + self._at_mode[1].T @ self._slopes(m))

    def predicted_sd(self, inputs: NDArray[np.float64]) -> NDArray[np.float64]:
        """Standard deviation of a new noisy sample of each measured output under ``inputs``, shape (K, 2, outputs): by linearisation."""
        twin = self.twin
        slopes = twin.slopes(self.mode, inputs)
        noise = np.array(list(twin.noise_sd.values()))
        variance = np.sum((slopes @ self.root) ** 2, axis=-1) + self.discrepancy_sd**2 + noise**2
        return np.asarray(np.sqrt(variance), dtype=np.float64)
