"""Nested Laplace approximation: a posterior on a grid of one unknown, Gaussian in the others at each grid point."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

__all__ = ["Section", "nested_laplace"]

# Standard deviation of each section along the grid, in grid steps (one step is one standard deviation of Laplace's Gaussian): half a step,
# because the sum of two equally likely neighbours is then flat between them.
WIDTH = 0.5
# The grid ends on each side where the log density is this much below its maximum, and after so many points at most.
NEGLIGIBLE, MOST = 6.0, 8
# The grid is used only if, so many standard deviations from the mode, the loss differs from Laplace's parabola by more than this factor.
ASIDE, UNLIKE = 3, 1.3
# Largest change of the log density from the mode to the next grid point for which the grid is fine enough; a Gaussian has 0.5.
STEEP = 1.5
# Tolerances of the least squares at a grid point, and evaluations at most: the result only has to be as exact as a draw shows.
FTOL, XTOL, EVALUATIONS = 1e-4, 1e-3, 30


class Loss(Protocol):
    """Residuals r(e) with |r(e)|^2 = -2 log posterior + constant."""

    def values(self, e: NDArray[np.float64]) -> NDArray[np.float64]:
        """r, shape (n,)."""
        ...

    def slopes(self, e: NDArray[np.float64]) -> NDArray[np.float64]:
        """dr/de, shape (n, d)."""
        ...


class Section(NamedTuple):
    """One Gaussian of the mixture, at one grid point: its share, its mean (d,), and a root of its covariance (d, d)."""

    share: float
    mode: NDArray[np.float64]
    root: NDArray[np.float64]


def nested_laplace(loss: Loss, mode: NDArray[np.float64], root: NDArray[np.float64], entries: Sequence[int]) -> list[Section]:
    """The posterior p(e) as a mixture of Gaussians on a grid of one of the ``entries`` of e.

    ``mode`` and ``root``: Laplace's Gaussian, N(mode, root root'). The result is empty where that Gaussian is good enough, and where the
    density changes too fast for the grid. With L(c) the least loss with e_j = c, and H(c) the Gauss-Newton curvature of the other entries
    there,

        p(e_j = c) ~ |H(c)|^(-1/2) exp(-L(c) / 2),

    and given c the other entries are Gaussian around the minimiser, with covariance H(c)^-1. The grid is along the entry whose loss rises
    least compared with Laplace's parabola. An example is the capacity: resistances at every SOC can compensate a wrong one, so that the
    loss along it is no parabola, and the true value was up to four of Laplace's standard deviations away.
    Source: Rue, Martino and Chopin, J. R. Stat. Soc. B 71 (2009) 319, section 3.
    """
    walks = [_Walk(loss, mode, root, j) for j in entries]
    if not walks:
        return []
    rises = [[walk.rise(-ASIDE), walk.rise(ASIDE)] for walk in walks]
    flattest = int(np.argmin([min(pair) for pair in rises]))
    gaussian = min(rises[flattest]) > 1 / UNLIKE and max(rises[flattest]) < UNLIKE
    return [] if gaussian or walks[flattest].steepness > STEEP else walks[flattest].sections()


class _At(NamedTuple):
    log_density: float
    mode: NDArray[np.float64]
    root: NDArray[np.float64]
    loss: float


class _Walk:
    """Conditional modes along entry j, at whole numbers of standard deviations from the mode; each is computed once."""

    def __init__(self, loss: Loss, mode: NDArray[np.float64], root: NDArray[np.float64], j: int) -> None:
        self._loss, self._mode, self._root, self._j = loss, mode, root, j
        self._sd = float(np.linalg.norm(root[j]))
        self._least = float(np.sum(loss.values(mode) ** 2))
        self._known: dict[int, _At] = {}

    def rise(self, k: int) -> float:
        """Growth of the loss from the mode to grid point k, relative to Laplace's parabola."""
        return (self._at(k).loss - self._least) / k**2

    @property
    def steepness(self) -> float:
        """Largest change of the log density from the mode to the next grid point."""
        return max(abs(self._at(k).log_density - self._at(0).log_density) for k in (-1, 1))

    def sections(self) -> list[Section]:
        known = {0: self._at(0)}
        for side in (-1, 1):
            for k in range(side, side * (MOST + 1), side):
                known[k] = self._at(k)
                if known[k].log_density < max(at.log_density for at in known.values()) - NEGLIGIBLE:
                    break
        found = [known[k] for k in sorted(known)]
        density = np.exp([at.log_density - max(one.log_density for one in found) for at in found])
        along = WIDTH * np.gradient([at.mode for at in found], axis=0)
        return [
            Section(float(share), at.mode, np.hstack([at.root, way[:, None]]))
            for share, at, way in zip(density / density.sum(), found, along, strict=True)
        ]

    def _at(self, k: int) -> _At:
        if k not in self._known:
            j, others = self._j, np.arange(len(self._mode)) != self._j
            value = self._mode[j] + k * self._sd

            def whole(rest: NDArray[np.float64]) -> NDArray[np.float64]:
                return np.insert(rest, j, value)

            if not others.any():
                # With one unknown no other entry is left to be optimised.
                at = whole(np.zeros(0))
                loss = float(np.sum(self._loss.values(at) ** 2))
                self._known[k] = _At(-0.5 * loss, at, np.zeros((1, 0)), loss)
                return self._known[k]
            # Start from the neighbouring grid point, or from the conditional mean of Laplace's Gaussian.
            neighbour = self._known.get(k - int(np.sign(k)))
            begin = neighbour.mode if neighbour else self._mode + k * (self._root @ self._root[j]) / self._sd
            found = least_squares(
                lambda rest: self._loss.values(whole(rest)),
                begin[others],
                jac=lambda rest: self._loss.slopes(whole(rest))[:, others],
                max_nfev=EVALUATIONS, ftol=FTOL, xtol=XTOL,
            )  # fmt: skip
            curvature, directions = np.linalg.eigh(found.jac.T @ found.jac)
            root = np.zeros((len(self._mode), len(self._mode) - 1))
            root[others] = directions / np.sqrt(curvature)
            self._known[k] = _At(-found.cost - 0.5 * float(np.sum(np.log(curvature))), whole(found.x), root, 2.0 * found.cost)
        return self._known[k]
