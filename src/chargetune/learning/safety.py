"""What safe mode has to keep: the demanded probability, the first theta and the budget of violation."""

from __future__ import annotations

import math
from dataclasses import dataclass

__all__ = ["NoSafeThetaError", "Safety"]


class NoSafeThetaError(RuntimeError):
    """Nothing is proposed: no theta is predicted to keep the limits with the stated probability, or the budget of violation is spent."""


@dataclass(frozen=True)
class Safety:
    """Demands of safe mode.

    probability
        Least predicted probability of keeping every limit that a theta needs to be tried, in [0.5, 1).
    start
        The first theta, declared safe by the user and not judged; None: the most cautious corner of the space, which plants of the prior
        judge.
    budget
        Largest sum of the loop's ``violation`` over all trials, for a charge in mV s beyond the voltage limit; None: no budget.

    Raises ValueError for a probability or a budget outside these ranges.
    """

    probability: float = 0.95
    start: tuple[float, ...] | None = None
    budget: float | None = None

    def __post_init__(self) -> None:
        p = self.probability
        if isinstance(p, bool) or not isinstance(p, (int, float)) or not 0.5 <= p < 1.0:
            raise ValueError(f"safety: probability = {p!r}, allowed is [0.5, 1)")
        b = self.budget
        if b is not None and (isinstance(b, bool) or not isinstance(b, (int, float)) or not math.isfinite(b) or b < 0):
            raise ValueError(f"safety: budget = {b!r}, allowed is a finite number >= 0")
