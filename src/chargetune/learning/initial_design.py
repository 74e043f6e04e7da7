"""The initial design, theta_0 and Sobol points, and the baseline tuner that proposes nothing else."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from chargetune.learning.tuner import TrialLike, check_count
from chargetune.model.parameter_space import ParameterSpace

__all__ = ["Sobol", "initial_design", "sobol_points"]


@dataclass(frozen=True)
class Sobol:
    """theta_0 first, then a scrambled Sobol sequence."""

    seed: int = 0

    def ask(self, space: ParameterSpace, trials: Sequence[TrialLike], n: int = 1) -> NDArray[np.float64]:
        """The next ``n`` points, shape (n, d), whatever the scores are."""
        check_count(n)
        return initial_design(space, len(trials) + n, self.seed, len(trials), n)


def sobol_points(dimension: int, seed: int, first: int, n: int) -> NDArray[np.float64]:
    """Points ``first`` .. ``first + n - 1`` of the scrambled Sobol sequence in the unit cube, shape (n, d)."""
    from scipy.stats import qmc

    sequence = qmc.Sobol(dimension, scramble=True, rng=np.random.default_rng(seed))
    # A Sobol sequence is balanced for powers of two only: it is drawn up to the next one, and cut.
    points: NDArray[np.float64] = sequence.random_base2((first + n - 1).bit_length())
    return points[first : first + n]


def initial_design(space: ParameterSpace, n_initial: int, seed: int, told: int, n: int) -> NDArray[np.float64]:
    """The next points of the initial design after ``told`` trials, at most n: theta_0, then ``n_initial`` Sobol points; shape (<= n, d)."""
    count = max(0, min(n, 1 + n_initial - told))
    if count == 0:
        return np.empty((0, space.dimension))
    points = [space.default] if told == 0 else []
    first = max(told - 1, 0)
    if count > len(points):
        points.extend(space.from_unit(sobol_points(space.dimension, seed, first, count - len(points))))
    return np.array(points)
