"""Safe learning: only what is predicted to keep every limit goes to the plant."""

from __future__ import annotations

import math
from dataclasses import dataclass

__all__ = ["NoSafeThetaError", "Safety"]


class NoSafeThetaError(RuntimeError):
    """No theta is predicted to keep the limits with the stated probability, or the budget of violation is spent."""


@dataclass(frozen=True)
class Safety:
    """Only theta whose predicted probability of keeping every limit is at least ``probability`` goes to the plant.

    start
        The first theta, declared safe by the user; None: the most cautious corner of the space, which is checked.
    budget
        Largest sum over all trials of the loop's ``violation``, for a charge in mV s beyond the voltage limit; None: no budget.
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
