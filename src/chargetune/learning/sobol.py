"""The baseline without learning."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from chargetune.learning.tuner import TrialLike, check_count, initial_design
from chargetune.model.parameters import ParameterSpace

__all__ = ["Sobol"]


@dataclass(frozen=True)
class Sobol:
    """theta_0 first, then a scrambled Sobol sequence."""

    seed: int = 0

    def ask(self, space: ParameterSpace, trials: Sequence[TrialLike], n: int = 1) -> NDArray[np.float64]:
        """The next ``n`` points, shape (n, d); scores play no part."""
        check_count(n)
        return initial_design(space, len(trials) + n, self.seed, len(trials), n)
