"""ReadStudy what battery cyclers write: a table of time, current, voltage and, where there is one, temperature.

Columns are found by name and unit (`layouts`): text with any separator, decimal mark and encoding, Excel, Parquet. A clock
(h:mm:ss), a date, a clock of each step are understood. Current is positive when it charges; a file with the other sign is
recognised by its states or by its voltage, which rises with a charging current. Where a file can be read in two ways it is
refused, with the option that decides, or what was assumed is among the remarks. The page docs/cycler-files.md has it all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from chargetune.battery.cell.cell import PACK, PACK_MAX
from chargetune.battery.identification.cells import clock_seconds, dates, decimal_mark, number
from chargetune.battery.identification.clocks import DAY_S, Clock, elapsed
from chargetune.battery.identification.current_sign import Sign, signed_by_state
from chargetune.battery.identification.headings import WAYS, Column, unit_of
from chargetune.battery.identification.layouts import CLOCKS, NEEDED, SHORT_UNITS, UNITS
from chargetune.battery.identification.plausibility import checked
from chargetune.battery.identification.record import Record
from chargetune.battery.identification.samples import Samples, read_samples
from chargetune.battery.validation import check_count
from chargetune.runtime.counted import counted

__all__ = ["Reading", "read_record"]

ZERO_CELSIUS_K = 273.15
# A temperature column beyond these, degree Celsius, is no cell's; one without a unit that stays within the others is in kelvin.
CELSIUS_RANGE, KELVIN_RANGE = (-80.0, 200.0), (223.0, 400.0)
# Without a unit a voltage beyond this is in mV, and a current beyond this may be in mA.
MILLIVOLTS_FROM, AMPERES_TO = 100.0, 100.0
# How a remark calls the order of a date.
ORDERS = {"ymd": "year, month, day", "mdy": "month, day, year", "dmy": "day, month, year"}
# Of two columns of current for either way the smaller is noise up to this share of the largest current.
BOTH_SHARE = 0.01
# Dates and clock of one file differ by less than this share.
DATES_SHARE, DATES_READ = 0.02, 200


@dataclass(frozen=True)
class Reading:
    """What a file leaves open: ``sign`` of its current, ``time_unit`` and ``current_unit`` (any name in `UNITS`, or one of `CLOCKS`).

    ``series`` and ``parallel``: it was measured on a pack of so many cells, and the record is that of one of them.
    """

    sign: Sign | None = None
    time_unit: str | None = None
    current_unit: str | None = None
    series: int = 1
    parallel: int = 1

    def __post_init__(self) -> None:
        if self.sign not in {None, "charge", "discharge", "unsigned"}:
            raise ValueError(f"sign = {self.sign!r}, allowed are charge, discharge and unsigned")
        for count in PACK:
            check_count(count, getattr(self, count), 1, PACK_MAX)
        for name, quantity in (("time_unit", "time"), ("current_unit", "current")):
            unit, clocks = getattr(self, name), list(CLOCKS if quantity == "time" else ())
            if unit is not None and unit_of(unit) not in {*UNITS[quantity], *clocks} - {""}:
                *others, last = [*SHORT_UNITS[quantity], *clocks]
                raise ValueError(f"{name} = {unit!r}, allowed are {', '.join(others)} and {last}")


def read_record(path: str | Path, reading: Reading | None = None) -> Record:
    """Read one file. Raises FileNotFoundError, and ValueError that names file, row or column, value and what is allowed."""
    options, name = reading or Reading(), Path(path).name
    samples = read_samples(Path(path))
    remarks, assumed = list(samples.remarks), list[str]()
    columns = _decided(samples.columns, options, remarks)
    source = next(q for q in ("time", "step_time", "date") if q in columns)
    numeric = [q for q in ("current", *WAYS, "voltage", "counter", "temperature") if q in columns]
    try:
        mark = decimal_mark({columns[q].heading: samples.cells[q] for q in (*((source,) if source != "date" else ()), *numeric)})
    except ValueError as found:
        heading, row, cell = str(found).split("|", 2)
        where = f"{name}, row {samples.numbers[int(row)]}"
        raise ValueError(f"{where}: {heading} = {cell!r}, but other numbers have the other decimal mark; allowed is one") from None
    arrays: dict[str, NDArray[np.float64]] = {}
    for quantity in numeric:
        column = columns[quantity]
        try:
            arrays[quantity] = column.factor * np.array(_numbers(samples, quantity, mark))
        except ValueError as error:
            if quantity in (*NEEDED, *WAYS):
                raise
            remarks.append(f"the temperature was left out ({str(error).removeprefix(name + ', ')})")
    both = "current" not in columns
    if both:
        columns["current"], arrays["current"] = _both_ways(samples, columns, arrays, remarks)
    if (options.series, options.parallel) != (1, 1):
        for quantity, count in (("voltage", options.series), ("counter", options.series), ("current", options.parallel)):
            if quantity in arrays:
                arrays[quantity] = arrays[quantity] / count
        remarks.append(f"of a pack: voltage was divided by {options.series} in series, current by {options.parallel} in parallel")
    _units(name, columns, arrays, assumed)
    raw, of_day = _time(samples, columns[source], mark, assumed, remarks)
    current = arrays["current"]
    if len(current) < 2:
        raise ValueError(f"{name} has {counted(len(current), 'row')} of numbers, allowed are at least 2")
    known = both
    if "state" in columns and options.sign is None and not both:
        signed = signed_by_state(name, current, samples.cells["state"], remarks)
        known, current = signed is not current, signed
    voltage = arrays["voltage"]
    if "counter" in arrays and columns["voltage"].heading.lower().startswith("ewe") and "-" not in columns["voltage"].heading:
        voltage = voltage - arrays["counter"]
        remarks.append(f"voltage is {columns['voltage'].heading} minus {columns['counter'].heading}, between the two electrodes")
    step = np.unique(samples.cells["step"], return_inverse=True)[1] if "step" in columns else None
    time, keep = elapsed(name, Clock(raw, current, step, of_steps=source == "step_time", of_day=of_day), remarks)
    _compared(name, samples, columns, source, time, keep, remarks)
    warm = _kelvin(columns, arrays, assumed, remarks)
    record = Record(name, time, current[keep], voltage[keep], None if warm is None else warm[keep], tuple(remarks))
    try:
        record = checked(record, sign=options.sign, known_sign=known)
    except ValueError as error:
        raise ValueError("; ".join([str(error), *assumed])) from None
    return replace(record, remarks=(*record.remarks, *assumed, *_not_used(samples, columns)))


def _decided(columns: dict[str, Column], options: Reading, remarks: list[str]) -> dict[str, Column]:
    """The columns with the units that the person gave."""
    decided = dict(columns)
    for unit, quantities in ((options.time_unit, ("time", "step_time")), (options.current_unit, ("current", *WAYS))):
        for quantity in quantities:
            if unit is not None and quantity in decided:
                decided[quantity] = replace(decided[quantity], unit=unit_of(unit))
                remarks.append(f"{decided[quantity].heading} is in {unit}, as the option says")
    return decided


def _plain(cells: list[str]) -> list[float] | None:
    """The numbers, where every cell is a plain finite one."""
    try:
        values = list(map(float, cells))
    except ValueError:
        return None
    return values if np.all(np.isfinite(values)) else None


def _numbers(samples: Samples, quantity: str, mark: str) -> list[float]:
    values, column = [], samples.columns[quantity]
    if mark == "." and (quick := _plain(samples.cells[quantity])) is not None:
        return quick
    for row, cell in zip(samples.numbers, samples.cells[quantity], strict=True):
        try:
            # Of two columns for either way a cycler may leave the other one empty.
            values.append(0.0 if quantity in WAYS and not cell else number(cell, mark))
        except ValueError as error:
            raise ValueError(f"{samples.name}, row {row}: {column.heading} = {cell!r}, allowed is {error}") from None
    return values


def _both_ways(
    samples: Samples, columns: dict[str, Column], arrays: dict[str, NDArray[np.float64]], remarks: list[str]
) -> tuple[Column, NDArray[np.float64]]:
    """(column, A) of one current, positive when it charges, from a column for either way."""
    charge, discharge = (columns[way] for way in WAYS)
    into, out = (np.abs(arrays[way]) for way in WAYS)
    largest = max(float(np.max(into, initial=0.0)), float(np.max(out, initial=0.0)))
    twice = np.flatnonzero(np.minimum(into, out) > BOTH_SHARE * largest)
    if twice.size:
        k = int(twice[0])
        raise ValueError(
            f"{samples.name}, row {samples.numbers[k]}: {charge.heading} = {into[k]:g} A and {discharge.heading} = {out[k]:g} A, "
            "allowed is a current in one of them at a time"
        )
    remarks.append(f"current is {charge.heading} minus {discharge.heading}")
    return replace(charge, quantity="current"), into - out


def _time(samples: Samples, column: Column, mark: str, assumed: list[str], remarks: list[str]) -> tuple[NDArray[np.float64], bool]:
    """(time as logged in s, whether it is a clock of hours that may stop at 24)."""
    cells = samples.cells[column.quantity]
    # A date has its day before the hour, with signs that no clock has.
    moments = dates(cells) if cells and (column.quantity == "date" or any(sign in cells[0] for sign in "-/.")) else None
    if moments is not None and (column.quantity == "date" or not _is_clock(cells[0], column.unit)):
        try:
            order, seconds = moments.best()
        except ValueError as error:
            raise ValueError(f"{samples.name}: {column.heading} = {cells[0]!r} to {cells[-1]!r}, allowed are {error}") from None
        remarks.append(f"time is from the dates in {column.heading}" + (f" ({ORDERS[order]})" if order else ""))
        return seconds, False
    if mark == "." and (quick := _plain(cells)) is not None:
        values, clocks, left = [column.factor * value for value in quick], 0, []
    else:
        values, clocks, left = [], 0, list(zip(samples.numbers, cells, strict=True))
    for row, cell in left:
        try:
            clock = clock_seconds(cell, column.unit) if ":" in cell else None
            clocks += clock is not None
            values.append(column.factor * number(cell, mark) if clock is None else clock)
        except ValueError as error:
            raise ValueError(f"{samples.name}, row {row}: {column.heading} = {cell!r}, allowed is {error}") from None
    if not column.unit and clocks < len(values):
        assumed.append(f"{column.heading} has no unit: s was assumed, up to {max(values):.4g} s (--time-unit decides)")
    return np.array(values), clocks == len(values)


def _is_clock(cell: str, unit: str) -> bool:
    try:
        return clock_seconds(cell, unit) is not None
    except ValueError:
        return True


def _units(name: str, columns: dict[str, Column], arrays: dict[str, NDArray[np.float64]], assumed: list[str]) -> None:
    """Settle units that the headings leave open by what a single cell can have, and tell it."""
    if not columns["voltage"].unit and len(arrays["voltage"]):
        heading = columns["voltage"].heading
        if np.median(np.abs(arrays["voltage"])) > MILLIVOLTS_FROM:
            arrays["voltage"] = 1e-3 * arrays["voltage"]
            assumed.append(f"{heading} has no unit: mV was assumed")
        else:
            assumed.append(f"{heading} has no unit: V was assumed")
    if not columns["current"].unit and len(arrays["current"]):
        heading, largest = columns["current"].heading, float(np.max(np.abs(arrays["current"])))
        if largest > AMPERES_TO:
            raise ValueError(f"{name}: {heading} has no unit and reaches {largest:g}, which can be A or mA; --current-unit decides")
        assumed.append(f"{heading} has no unit: A was assumed (--current-unit decides)")


def _kelvin(
    columns: dict[str, Column], arrays: dict[str, NDArray[np.float64]], assumed: list[str], remarks: list[str]
) -> NDArray[np.float64] | None:
    values = arrays.get("temperature")
    if values is None or not len(values):
        return None
    unit, heading = columns["temperature"].unit, columns["temperature"].heading
    if not unit:
        kelvin = KELVIN_RANGE[0] < np.min(values) and np.max(values) < KELVIN_RANGE[1]
        unit = "k" if kelvin else "c"
        assumed.append(f"{heading} has no unit: {'kelvin' if kelvin else 'degree Celsius'} was assumed")
    celsius = values - ZERO_CELSIUS_K if unit.startswith("k") else (values - 32) / 1.8 if unit.endswith("f") else values
    if not (CELSIUS_RANGE[0] < np.min(celsius) and np.max(celsius) < CELSIUS_RANGE[1]):
        remarks.append(f"the temperature was left out ({heading} reaches {np.min(celsius):.4g} to {np.max(celsius):.4g} degC)")
        return None
    return np.asarray(celsius + ZERO_CELSIUS_K, dtype=np.float64)


def _compared(
    name: str,
    samples: Samples,
    columns: dict[str, Column],
    source: str,
    time: NDArray[np.float64],
    keep: NDArray[np.bool_],
    remarks: list[str],
) -> None:
    """Compare the clock with the dates of the file, where it has both: another unit is refused, another span is told."""
    if source == "date" or "date" not in columns or not time[-1]:
        return
    # The first, the last and some between tell the span and the order of day and month.
    kept = np.flatnonzero(keep)
    some = np.unique(kept[np.linspace(0, kept.size - 1, min(DATES_READ, kept.size)).astype(int)])
    moments = dates([samples.cells["date"][k] for k in some.tolist()])
    found = [] if moments is None else [seconds for seconds in moments.by_order.values() if np.all(np.diff(seconds) >= 0)]
    # A date alone, without the time of day, tells nothing.
    spans = [float(seconds[-1]) for seconds in found if np.any(seconds % DAY_S)]
    if not spans:
        return
    span = min(spans, key=lambda seconds: abs(seconds - time[-1]))
    # Dates are written in whole seconds or minutes.
    if abs(span - time[-1]) <= max(DATES_SHARE * time[-1], 120.0):
        return
    seen = f"the clock {columns[source].heading} spans {time[-1]:.6g} s, the dates in {columns['date'].heading} {span:.6g} s"
    if not columns[source].unit and ":" not in samples.cells[source][0]:
        raise ValueError(f"{name}: {seen}; {columns[source].heading} has no unit, --time-unit decides")
    remarks.append(f"{seen}; the clock was taken")


def _not_used(samples: Samples, columns: dict[str, Column]) -> Sequence[str]:
    notes = []
    for quantity in ("current", "voltage", "temperature"):
        rest = [column.heading for column in samples.others.get(quantity, [])]
        if rest:
            notes.append(f"{quantity} is {columns[quantity].heading}; not used: {', '.join(rest)}")
    return notes
