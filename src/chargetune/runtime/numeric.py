"""What counts as a number where a person types one: Python's and NumPy's alike, and no boolean."""

from __future__ import annotations

import math
from numbers import Integral, Real

__all__ = ["is_finite", "is_integer"]


def is_finite(value: object) -> bool:
    """Whether it is a finite real number (int, float, NumPy's integers and floats of any width)."""
    return not isinstance(value, bool) and isinstance(value, Real) and math.isfinite(value)


def is_integer(value: object) -> bool:
    """Whether it is an integer (int or NumPy's)."""
    return not isinstance(value, bool) and isinstance(value, Integral)
