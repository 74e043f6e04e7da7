"""Refusals that name the field, the value and what is allowed."""

from __future__ import annotations

import math
from collections.abc import Sequence

__all__ = ["check_count", "check_interval", "check_number"]


def check_number(name: str, value: float | None, low: float, high: float, unit: str = "", *, open_low: bool = False) -> float:
    """The value, when it is a finite number in [low, high] (``open_low``: above low). Raises ValueError."""
    ok = isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
    if not ok or value is None or not (low < value if open_low else low <= value) or value > high:
        bracket = "(" if open_low else "["
        raise ValueError(f"{name} = {value!r}, allowed is {bracket}{low:g}, {high:g}] {unit}".rstrip())
    return float(value)


def check_count(name: str, value: int, low: int, high: int) -> int:
    """The value, when it is an integer in [low, high]. Raises ValueError."""
    if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
        raise ValueError(f"{name} = {value!r}, allowed is an integer in [{low}, {high}]")
    return value


def check_interval(name: str, pair: Sequence[float], low: float, high: float, unit: str = "", *, wide: bool = False) -> None:
    """ValueError unless this is [lowest, highest] within [low, high]; ``wide``: the lowest has to be below the highest."""
    allowed = "[lowest, highest] with lowest < highest" if wide else "[lowest, highest]"
    if len(pair) != 2:
        raise ValueError(f"{name} = {list(pair)}, allowed is [lowest, highest]")
    first, last = (check_number(f"{name}[{k}]", value, low, high, unit) for k, value in enumerate(pair))
    if first > last or (wide and first == last):
        raise ValueError(f"{name} = {list(pair)}, allowed is {allowed}")
