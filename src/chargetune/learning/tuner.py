"""What a tuner is: a pure function of the trials."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc

from chargetune.episode.score import Score
from chargetune.model.parameters import ParameterSpace

__all__ = ["TrialLike", "Tuner", "check_count", "initial_design", "sobol_points"]


class TrialLike(Protocol):
    """The part of a trial that a tuner reads. A trial without score is running when its status says so, else it failed."""

    @property
    def number(self) -> int: ...

    @property
    def theta(self) -> Sequence[float]: ...

    @property
    def status(self) -> str: ...

    @property
    def score(self) -> Score | None: ...


class Tuner(Protocol):
    """Proposes theta. A frozen dataclass with a seed: the same arguments give the same thetas, bit for bit."""

    def ask(self, space: ParameterSpace, trials: Sequence[TrialLike], n: int = 1) -> NDArray[np.float64]:
        """``n`` thetas in their own units and inside the bounds, shape (n, d)."""
        ...


def check_count(n: int) -> None:
    """ValueError unless n is a whole number of at least 1."""
    if isinstance(n, bool) or not isinstance(n, int) or n < 1:
        raise ValueError(f"n = {n!r}, allowed is an integer >= 1")


def sobol_points(dimension: int, seed: int, first: int, n: int) -> NDArray[np.float64]:
    """Points ``first`` .. ``first + n - 1`` of the scrambled Sobol sequence in the unit cube, shape (n, d)."""
    sequence = qmc.Sobol(dimension, scramble=True, rng=np.random.default_rng(seed))
    # Drawn up to the next power of two, which is how a Sobol sequence is balanced, and cut.
    points: NDArray[np.float64] = sequence.random_base2((first + n - 1).bit_length())
    return points[first : first + n]


def initial_design(space: ParameterSpace, n_initial: int, seed: int, told: int, n: int) -> NDArray[np.float64]:
    """The entries ``told`` .. of D_0 that are left, at most n: theta_0, then ``n_initial`` Sobol points; shape (<= n, d)."""
    count = max(0, min(n, 1 + n_initial - told))
    if count == 0:
        return np.empty((0, space.dimension))
    points = [space.default] if told == 0 else []
    first = max(told - 1, 0)
    if count > len(points):
        points.extend(space.from_unit(sobol_points(space.dimension, seed, first, count - len(points))))
    return np.array(points)
