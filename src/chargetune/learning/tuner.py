"""The interface of a tuner: a pure function from the trials so far to the next theta."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from chargetune.episode.score import Score
from chargetune.model.parameter_space import ParameterSpace

__all__ = ["TrialLike", "Tuner", "check_count"]


class TrialLike(Protocol):
    """The part of a trial that a tuner reads. A trial without score is running if its status is "running"; else it failed."""

    @property
    def number(self) -> int: ...

    @property
    def theta(self) -> Sequence[float]: ...

    @property
    def status(self) -> str: ...

    @property
    def score(self) -> Score | None: ...


class Tuner(Protocol):
    """Proposes the next theta. A frozen dataclass with a seed: the same arguments give the same thetas, bit for bit."""

    def ask(self, space: ParameterSpace, trials: Sequence[TrialLike], n: int = 1) -> NDArray[np.float64]:
        """The next ``n`` thetas, in their own units and inside their bounds, shape (n, d)."""
        ...


def check_count(n: int) -> None:
    """ValueError unless n is a whole number of at least 1."""
    if isinstance(n, bool) or not isinstance(n, int) or n < 1:
        raise ValueError(f"n = {n!r}, allowed is an integer >= 1")
