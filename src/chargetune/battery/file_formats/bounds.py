"""What a number may be, asked of the code that reads the file: it refuses an impossible value and says what is allowed."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, get_args, get_origin

from chargetune.battery.file_formats.keys import Key, Table

__all__ = ["Bounds", "Refusal", "bounds_of"]

# (table, key, value) -> what the reader of the file says of it, "" where it says nothing.
Refusal = Callable[[Table, Key, Any], str]

# Beyond what any key may be, and how often two checks that narrow each other are asked.
FAR, CHECKS_MAX = 1e12, 3
NODES, STEP = 4, 1e-3
NUMBER = r"([-+\d.e]+|inf)"
INTERVAL = re.compile(rf"allowed is (?:an integer in )?([\[(]){NUMBER}, {NUMBER}([\])])")
# (pattern, whether it is the lower bound, whether the bound itself is left out)
ONE_SIDED = (
    (re.compile(rf"allowed is an integer >= {NUMBER}"), True, False),
    (re.compile(rf"allowed is more than {NUMBER}\b"), True, True),
    (re.compile(rf"allowed is at least {NUMBER}\b"), True, False),
    (re.compile(rf"and at most {NUMBER}"), False, False),
    (re.compile(rf"allowed is {NUMBER}\.\."), True, False),
    (re.compile(rf"allowed is [\d.]+?\.\.{NUMBER}"), False, False),
    (re.compile(rf"greater than or equal to {NUMBER}"), True, False),
    (re.compile(rf"greater than {NUMBER}"), True, True),
    (re.compile(rf"less than or equal to {NUMBER}"), False, False),
    (re.compile(rf"less than {NUMBER}"), False, True),
)


@dataclass(frozen=True)
class Bounds:
    """An interval; None: no bound. An open end leaves out the bound itself. A name stands for a bound that is no fixed number."""

    low: float | str | None = None
    high: float | str | None = None
    low_open: bool = False
    high_open: bool = False

    def __str__(self) -> str:
        low, high = (end if end is None or isinstance(end, str) else f"{end:g}" for end in (self.low, self.high))
        if low is None and high is None:
            return ""
        if low == high:
            return f"within {low}"
        if high is None:
            return f"{'more than' if self.low_open else 'at least'} {low}"
        if low is None:
            return f"{'less than' if self.high_open else 'at most'} {high}"
        return f"{'(' if self.low_open else '['}{low}, {high}{')' if self.high_open else ']'}"


def bounds_of(table: Table, key: Key, refusals: Sequence[Refusal]) -> Bounds:
    """The bounds that the reader of the file states when this key has a value far below and far above anything sensible.

    ``refusals`` are those beside different cells: a bound in which they differ is "the cell's".
    """
    if not key.is_number:
        return Bounds()
    first, *others = [_asked(table, key, refusal) for refusal in refusals]

    def side(*, lower: bool) -> tuple[float | str | None, bool]:
        bound, is_open = first.get(lower, (None, False))
        same = all(other.get(lower) == first.get(lower) for other in others)
        return (bound if same else "the cell's"), is_open

    (low, low_open), (high, high_open) = side(lower=True), side(lower=False)
    above = next((other.name for other in table.keys if f"more than {other.name}" in key.sentence), None)
    if above is not None:
        low, low_open = above, True
    return Bounds(low, None if high == float("inf") else high, low_open, high_open)


def _asked(table: Table, key: Key, refusal: Refusal) -> dict[bool, tuple[float, bool]]:
    """{lower: (bound, open)}. At a bound that was stated it is asked again: a second check may be narrower than the first."""
    sides: dict[bool, tuple[float, bool]] = {}
    for lowest, extreme in ((True, -FAR), (False, FAR)):
        value = extreme
        for turn in range(CHECKS_MAX):
            message = refusal(table, key, _shaped(key, value))
            # A bound may be refused for the sake of another key; that is no bound of this one.
            if turn and not re.search(rf"\b{key.name}(\[\d+\])? = {re.escape(f'{value:g}')}(\.0)?\b", message):
                break
            found = _stated(message)
            for lower, bound in found.items():
                # What a refusal says of the side that it is not about may hold for this value alone.
                if lower is lowest or lower not in sides:
                    sides[lower] = bound
            if lowest not in found or abs(found[lowest][0]) == float("inf") or found[lowest][0] == value:
                break
            value = found[lowest][0]
    return sides


def _shaped(key: Key, value: float) -> Any:
    """The value as this key's type has it."""
    kinds = get_args(key.type)
    if get_origin(key.type) is tuple and Ellipsis not in kinds:
        return [value] * len(kinds)
    if get_origin(key.type) in (tuple, list):
        # Tables over the SOC increase.
        return [value + k * STEP for k in range(NODES)]
    return int(value) if key.type is int else float(value)


def _stated(message: str) -> dict[bool, tuple[float, bool]]:
    """{lower: (bound, open)} of a refusal."""
    both = INTERVAL.search(message)
    if both:
        return {True: (float(both[2]), both[1] == "("), False: (float(both[3]), both[4] == ")")}
    found: dict[bool, tuple[float, bool]] = {}
    for pattern, lower, is_open in ONE_SIDED:
        match = pattern.search(message)
        if match and lower not in found:
            found[lower] = float(match[1].rstrip(".")), is_open
    return found
