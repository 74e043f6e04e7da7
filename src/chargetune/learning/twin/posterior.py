"""The posterior of a twin's unknowns: predicted with, and drawn from."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from chargetune.learning.twin.twin import Twin

__all__ = ["Posterior"]

# Steps by which a draw is brought to where it should be, and what of its equation, in squared standard deviations, may be left there:
# another step would not be seen in the data.
STEPS, THERE = 8, 0.05
# Twice the loss of log-posterior at which a draw may be there.
MISFIT = 9.0
# After a step that was not taken the next one is so much shorter.
SHORTER = 0.3
# Halvings of a draw that may not be where it was brought to.
HALVINGS = 2
# Where a factor would fall below this share of what it is at the mode, its logarithm goes on as a straight line.
STRAIGHT = 0.5


class _Led(NamedTuple):
    """Draws on their way (`Posterior._at`), each entry with the draws as its first axis."""

    misfit: NDArray[np.float64]
    """Twice the loss of log-posterior, (count,)."""
    pull: NDArray[np.float64]
    """What is left of the equation, (count, d)."""
    left: NDArray[np.float64]
    """Its square in the metric of the posterior, (count,): that of the distance to where it is solved, were the model linear."""
    slope: NDArray[np.float64]
    """dm/dx, (count, d)."""
    grown: NDArray[np.float64]
    """By which the slopes at the mode become those with respect to x, about, (count, d)."""


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
        logarithms. So each draw m' is moved to where

            J'W (y(m) - y(mode) - J (m' - mode)) + S^-1 (m - m') = 0,

        J the slopes at the mode, W and S the metrics of likelihood and prior: what it predicts is then, as far as the data tell, what it
        would predict if the model were linear (randomise, then optimise; Bardsley et al., SIAM J. Sci. Comput. 36 (2014) A1895).
        Predictions are more nearly linear in a factor than in its logarithm, so the steps are taken in factors: they begin where
        these, instead of their logarithms, have changed by m' - mode, and the slopes of the mode serve all of them. A draw whose misfit
        is not below `MISFIT` there is halved towards the mode.
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
        m, misfit = self._led(draws)
        for _ in range(HALVINGS):
            # A misfit that is no number is none to stay with either.
            far = ~(misfit < MISFIT)
            if not far.any():
                break
            draws = np.where(far[:, None], 0.5 * draws, draws)
            m[far], misfit[far] = self._led(draws[far])
        return np.where(misfit[:, None] < MISFIT, m, self.mode + draws)

    def _led(self, draws: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Where steps lead draws, all at once, and the misfit there, shapes (count, d) and (count,)."""
        x, wanted, length = draws.copy(), self._wanted(draws), np.ones(len(draws))
        now = self._at(x, draws, wanted)
        going = np.flatnonzero(np.isfinite(now.left) & (now.left >= THERE))
        for _ in range(STEPS):
            if not going.size:
                break
            slopes = self._seen_curvature * now.grown[going, None, :] + self._precision * now.slope[going, None, :]
            ahead = x[going] - length[going, None] * np.linalg.solve(slopes, now.pull[going, :, None])[..., 0]
            following = self._at(ahead, draws[going], wanted[going])
            # What is not finite is not nearer.
            nearer = following.left < now.left[going]
            at, stayed = going[nearer], going[~nearer]
            x[at] = ahead[nearer]
            for values, others in zip(now, following, strict=True):
                values[at] = others[nearer]
            length[at], length[stayed] = 1.0, SHORTER * length[stayed]
            going = np.concatenate([at[now.left[at] >= THERE], stayed])
        return self._moved_by(x)[0], now.misfit

    def _moved_by(self, x: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Unknowns whose factors are 1 + x times those of the mode, and the others x more than there; and dm/dx, both (count, d)."""
        # Below STRAIGHT the tangent: a factor has no logarithm at 0, and draws of what is hardly known go there.
        at = np.maximum(x, STRAIGHT - 1.0)
        slope = np.where(self.twin.factors, 1.0 / (1.0 + at), 1.0)
        return self.mode + np.where(self.twin.factors, np.log1p(at) + slope * (x - at), x), slope

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

    @cached_property
    def _seen_curvature(self) -> NDArray[np.float64]:
        """J'WJ of what was seen, at the mode, shape (d, d)."""
        return np.asarray(self._at_mode[1].T @ self._at_mode[1])

    @cached_property
    def _laplace(self) -> NDArray[np.float64]:
        """(J'WJ + S^-1)^-1 at the mode, shape (d, d)."""
        return np.asarray(np.linalg.inv(self._seen_curvature + self._precision))

    def _at(self, x: NDArray[np.float64], draws: NDArray[np.float64], wanted: NDArray[np.float64]) -> _Led:
        """Draws that should predict ``wanted`` at x (`_moved_by`), all of shape (count, d)."""
        m, slope = self._moved_by(x)
        away = m - self.mode - draws
        pull = away @ self._precision
        # A long step may lead where outputs are not finite.
        with np.errstate(invalid="ignore", over="ignore"):
            off = self._predicted(m) - wanted
            misfit = np.sum(away * pull, axis=1) + np.sum(off**2, axis=1)
            pull += off @ self._at_mode[1]
            grown = slope * np.where(self.twin.factors, np.exp(m - self.mode), 1.0)
            return _Led(misfit, pull, np.sum((pull @ self._laplace) * pull, axis=1), slope, grown)

    def predicted_sd(self, inputs: NDArray[np.float64]) -> NDArray[np.float64]:
        """Standard deviation of a new noisy sample of each measured output under ``inputs``, shape (K, 2, outputs): by linearisation."""
        twin = self.twin
        slopes = twin.slopes(self.mode, inputs)
        noise = np.array(list(twin.noise_sd.values()))
        variance = np.sum((slopes @ self.root) ** 2, axis=-1) + self.discrepancy_sd**2 + noise**2
        return np.asarray(np.sqrt(variance), dtype=np.float64)
