"""Finding: one thing that is wrong with a formulation, the figures that show it and what to do."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

__all__ = ["Evidence", "Finding", "Severity"]

Severity = Literal["error", "warning"]


@dataclass(frozen=True)
class Evidence:
    """Curves that show a finding: each line by its name as (x, y), each bound by its name as a y."""

    x_label: str
    y_label: str
    lines: Mapping[str, tuple[NDArray[np.float64], NDArray[np.float64]]]
    bounds: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Finding:
    """What a check found.

    code
        Which check: wrong-sign, unsafe-start, inexact-penalty, between-samples, limit-not-kept, short-horizon,
        no-influence, no-safe-theta, no-safe-start, unreachable-target, no-theta, limit-above-full, steps-not-solved, non-convex,
        observer-rings, observer-undetectable.
    severity
        "error": what tuning would give is meaningless or unsafe; "warning": it is worth less than it could be.
    numbers
        The figures behind the message, the unit in the name.
    """

    code: str
    severity: Severity
    message: str
    remedy: str
    numbers: Mapping[str, float]
    evidence: Evidence | None = None
