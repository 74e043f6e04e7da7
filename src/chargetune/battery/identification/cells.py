"""From cells to numbers: decimal marks, clocks and dates."""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import UTC, datetime

import numpy as np
from numpy.typing import NDArray

__all__ = ["DateTimes", "clock_seconds", "dates", "decimal_mark", "number"]

# 12:34:56.7 with days before it: "0d 00:00:05.1", "1-02:03:04", "1.02:03:04", "1 day, 02:03:04".
CLOCK = re.compile(r"([-+])?(?:(\d+)\s*(?:d|days?)?\s*[-.,\s]\s*)?(\d+):(\d\d?):(\d\d?(?:[.,]\d+)?)", re.IGNORECASE)
SHORT_CLOCK = re.compile(r"(\d+):(\d\d?(?:[.,]\d+)?)")
THOUSANDS = {mark: re.compile(rf"[-+]?\d{{1,3}}(?:\{mark}\d{{3}})+") for mark in ",."}
DATE = re.compile(
    r"(\d{1,4})([-/.])(\d{1,2})\2(\d{1,4})(?:[T\s,]+(\d{1,2}):(\d\d)(?::(\d\d)(?:[.,:](\d{1,9}))?)?\s*([AaPp])?\.?[Mm]?\.?)?\s*(?:Z|[-+]\d\d:?\d\d)?"
)
# Readings of a date by its three numbers: (year, month, day).
ORDERS = {"ymd": (0, 1, 2), "mdy": (2, 0, 1), "dmy": (2, 1, 0)}


def decimal_mark(columns: dict[str, Sequence[str]]) -> str:
    """The one decimal mark of all numbers of the file. Raises ValueError that names column, row (from 0) and cell."""
    last, alone = "", dict[str, tuple[str, int, str]]()
    for heading, cells in columns.items():
        for row, cell in enumerate(cells):
            if ":" in cell:
                continue
            marks = {mark for mark in ",." if mark in cell}
            if len(marks) == 2 or any(cell.count(mark) > 1 for mark in marks):
                # 1,234.5 and 1,234,567: the mark of thousands comes first and may stand twice.
                ends = max(cell.rfind(mark) for mark in marks)
                mark = cell[ends] if len(marks) == 2 else ",."[cell[ends] == ","]
                if last and last != mark:
                    raise ValueError(f"{heading}|{row}|{cell}")
                last = mark
            elif marks:
                alone.setdefault(marks.pop(), (heading, row, cell))
    if last:
        return last
    if len(alone) == 2:
        heading, row, cell = max(list(alone.values())[::-1], key=lambda where: where[1])
        raise ValueError(f"{heading}|{row}|{cell}")
    return next(iter(alone), ".")


def number(cell: str, mark: str) -> float:
    """The number in a cell. Raises ValueError with what is allowed."""
    other = ",."[mark == ","]
    if other in cell:
        whole, _, rest = cell.partition(mark)
        if not THOUSANDS[other].fullmatch(whole):
            raise ValueError(f"a number with the decimal mark {mark!r} of the others")
        cell = f"{whole.replace(other, '')}{mark}{rest}" if rest else whole.replace(other, "")
    try:
        value = float(cell.replace(mark, "."))
    except ValueError:
        raise ValueError("a number") from None
    if not np.isfinite(value):
        raise ValueError("a finite number")
    return value


def clock_seconds(cell: str, unit: str) -> float | None:
    """Seconds of a clock with hours, minutes and seconds; None for no clock. Two parts only where the unit says what they are.

    Raises ValueError for two parts of unknown meaning.
    """
    if match := CLOCK.fullmatch(cell.strip()):
        sign, days, hours, minutes, seconds = match.groups()
        value = 86400.0 * int(days or 0) + 3600.0 * int(hours) + 60.0 * int(minutes) + float(seconds.replace(",", "."))
        return -value if sign == "-" else value
    if match := SHORT_CLOCK.fullmatch(cell.strip()):
        first, second = float(match[1]), float(match[2].replace(",", "."))
        if unit.startswith("m"):
            return 60.0 * first + second
        if unit.startswith("h"):
            return 3600.0 * first + 60.0 * second
        raise ValueError("h:mm:ss; two parts can be hh:mm or mm:ss (--time-unit hh:mm or --time-unit mm:ss decides)")
    return None


class DateTimes:
    """Moments of a column of dates, in s from the first, by every order of day and month that all of them can have."""

    def __init__(self, cells: Sequence[str]) -> None:
        matches = [DATE.fullmatch(cell.strip()) for cell in cells]
        if not cells or not all(matches):
            k = next((i for i, match in enumerate(matches) if not match), 0)
            raise ValueError(f"{k}|{cells[k] if cells else ''}")
        self.by_order: dict[str, NDArray[np.float64]] = {}
        for order, places in ORDERS.items():
            try:
                moments = np.array([_moment(match.groups(), places) for match in matches if match])
            except ValueError:
                continue
            self.by_order[order] = moments - moments[0]

    def best(self) -> tuple[str, NDArray[np.float64]]:
        """The order of day and month that lets time run without a jump of days. Raises ValueError where two do, or none."""
        running = {o: t for o, t in self.by_order.items() if np.all(np.diff(t) >= 0)} or self.by_order
        if not running:
            raise ValueError("a date, as 2024-05-06 08:00:00")
        gaps = {order: float(np.max(np.diff(t), initial=0.0)) for order, t in running.items()}
        order = min(gaps, key=lambda name: gaps[name])
        for other, seconds in running.items():
            if not np.array_equal(seconds, running[order]) and gaps[other] < 2 * gaps[order] + 60:
                raise ValueError("dates of one order of day and month; write them as 2024-05-06 08:00:00")
        return order, running[order]


def dates(cells: Sequence[str]) -> DateTimes | None:
    """The column as dates, or None where it is none."""
    try:
        return DateTimes(cells)
    except ValueError:
        return None


def _moment(groups: Sequence[str | None], places: tuple[int, int, int]) -> float:
    first, _, second, third, hour, minute, seconds, fraction, half = groups
    numbers = [str(first), str(second), str(third)]
    year, month, day = (numbers[place] for place in places)
    if len(year) not in {2, 4} or len(month) > 2 or len(day) > 2 or (places[0] == 0 and len(year) != 4):
        raise ValueError("no date of this order")
    hours = int(hour or 0) % 12 + 12 * (half in {"p", "P"}) if half else int(hour or 0)
    moment = datetime(int(year) % 100 + 2000 if len(year) == 2 else int(year), int(month), int(day), hours, int(minute or 0), tzinfo=UTC)
    return moment.timestamp() + float(seconds or 0) + float(f"0.{fraction or 0}")
