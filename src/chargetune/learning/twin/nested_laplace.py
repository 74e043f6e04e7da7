"""A posterior in sections along the unknown of which Laplace's Gaussian says least."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

__all__ = ["Section", "nested_laplace"]

# Sections are one of Laplace's standard deviations apart. Each is half as wide: their sum is flat between two that are as likely.
WIDTH = 0.5
# Beyond a section that is less likely than the likeliest by this, in the logarithm, none is sought, nor more than so many to a side.
NEGLIGIBLE, MOST = 6.0, 8
# Where so many standard deviations away the loss differs from Laplace's by this factor, the posterior is another than his.
ASIDE, UNLIKE = 3, 1.3
# A density that falls by more than this, in the logarithm, from the mode to the next section is too fine for sections; a Gaussian: 0.5.
STEEP = 1.5
# A section is found as well as a draw can tell.
FTOL, XTOL, EVALUATIONS = 1e-4, 1e-3, 30


class Loss(Protocol):
    """|r(e)|^2, which is minus twice the log posterior but for a constant."""

    def values(self, e: NDArray[np.float64]) -> NDArray[np.float64]:
        """r, shape (n,)."""
        ...

    def slopes(self, e: NDArray[np.float64]) -> NDArray[np.float64]:
        """dr/de, shape (n, d)."""
        ...


class Section(NamedTuple):
    """One of the Gaussians whose sum the posterior is: its share, mean, and a root of its covariance."""

    share: float
    mode: NDArray[np.float64]
    root: NDArray[np.float64]


def nested_laplace(loss: Loss, mode: NDArray[np.float64], root: NDArray[np.float64], entries: Sequence[int]) -> list[Section]:
    """p(e) as a sum of Gaussians along one of the ``entries`` of e; none where Laplace's, of this mode and root, says as much.

    Nor where the density changes too fast for them.
    With L(c) the least loss where e_j = c, and H(c) the Gauss-Newton curvature of the other entries there,

        p(e_j = c) ~ |H(c)|^(-1/2) exp(-L(c) / 2),

    and given c the others are Gaussian around what attains L(c), covariance H(c)^-1. Of the entries the one is taken along which the loss
    rises least, compared to Laplace's. A wrong capacity is made up for by resistances at every SOC: the loss along both is no
    parabola, and the truth was at four standard deviations of one.
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
    """What is likeliest with entry j so many standard deviations from the mode."""

    def __init__(self, loss: Loss, mode: NDArray[np.float64], root: NDArray[np.float64], j: int) -> None:
        self._loss, self._mode, self._root, self._j = loss, mode, root, j
        self._sd = float(np.linalg.norm(root[j]))
        self._least = float(np.sum(loss.values(mode) ** 2))
        self._known: dict[int, _At] = {}

    def rise(self, k: int) -> float:
        """By how much the loss grows over k steps, relative to Laplace's parabola."""
        return (self._at(k).loss - self._least) / k**2

    @property
    def steepness(self) -> float:
        """The largest change of the logarithm of the density from the mode to the next section."""
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
                # One unknown: nothing is left to be found, and nothing to be uncertain of.
                at = whole(np.zeros(0))
                loss = float(np.sum(self._loss.values(at) ** 2))
                self._known[k] = _At(-0.5 * loss, at, np.zeros((1, 0)), loss)
                return self._known[k]
            # From the neighbour, or where Laplace's Gaussian has the others.
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
