"""ReadStudy what battery cyclers write: one CSV table of time, current, voltage and, where there is one, temperature.

Columns are found by name, as Bitrode, Arbin, Neware, BioLogic and the Battery Data Format (BDF) write them:

| quantity | names (spaces, underscores and case do not matter) |
|---|---|
| time | Time(s), Test_Time(s), Test Time / s, test_time_second, time/s, Total Time, Record Time, Time(h:min:s.ms), Relative Time |
| current | Current, Current(A), Current(mA), Current / A, current_ampere, Cur(mA), I/mA, <I>/mA, I/A |
| voltage | Voltage, Voltage(V), Voltage(mV), Voltage / V, voltage_volt, Vol(V), Ecell/V, Ewe/V |
| temperature | Temperature, Temperature(C), Temperature / degC, Surface Temperature / degC, Temp(C), T1/degC, Aux_Temperature_1(C) |

A unit in the name is converted; without one it is s, A, V and degree Celsius; a clock (h:mm:ss) is understood. A time that
restarts with each step is strung together. Semicolon, tab or comma separates; decimal commas and a byte order mark are
understood. Current is positive when it charges; a file with the other sign is recognised by its voltage, which rises with
a charging current. A temperature column with holes is left out.
"""

from __future__ import annotations

import csv
import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from chargetune.battery.identification.record import Record, checked

__all__ = ["read_record"]

NAMES: dict[str, tuple[str, ...]] = {
    "time": ("testtime", "testtimesecond", "totaltime", "recordtime", "time", "relativetime"),
    "current": ("current", "currentampere", "cur", "<i>", "i"),
    "voltage": ("voltage", "voltagevolt", "vol", "ecell", "<ewe>", "ewe", "v"),
    "temperature": ("temperature", "temp", "t1", "temperaturet1", "surfacetemperature", "auxtemperature1", "auxtemp1"),
}
CLOCKS = dict.fromkeys(("h:min:s.ms", "h:m:s", "h:mm:ss", "hh:mm:ss", "hh:mm:ss.ms"), 1.0)
UNITS: dict[str, dict[str, float]] = {
    "time": {"": 1.0, "s": 1.0, "sec": 1.0, "ms": 1e-3, "min": 60.0, "h": 3600.0, **CLOCKS},
    "current": {"": 1.0, "a": 1.0, "ma": 1e-3},
    "voltage": {"": 1.0, "v": 1.0, "mv": 1e-3},
    "temperature": {"": 1.0, "c": 1.0, "degc": 1.0, "°c": 1.0, "k": 1.0},
}
NEEDED = ("time", "current", "voltage")
ZERO_CELSIUS_K = 273.15
# A step's clock that restarts begins at most here, s, or at most at this share of the time before.
RESTART_S, RESTART_SHARE = 1.0, 0.1
RESTART_MAX_S = 60.0
# Steps end and begin with two samples at one time; more of them are damage.
STANDS_SHARE = 0.05
HEADER_LINES = 200

# quantity -> (column, factor to SI, its name in the file)
Columns = dict[str, tuple[int, float, str]]


def read_record(path: str | Path) -> Record:
    """Read one file. Raises FileNotFoundError, and ValueError that names file, row or column, value and what is allowed."""
    name = Path(path).name
    lines = _text(Path(path)).splitlines()
    if not any(line.strip() for line in lines):
        raise ValueError(f"{name} is empty")
    rows, at, columns = _header(name, lines)
    remarks: list[str] = []
    arrays = _numbers(name, rows, at, columns, remarks)
    if len(arrays["time"]) < 2:
        raise ValueError(f"{name} has {len(arrays['time'])} rows of numbers, allowed are at least 2")
    warm = arrays.get("temperature")
    if warm is not None and not columns["temperature"][2].lower().rstrip(") ]").endswith(("/k", "(k", "/ k", "[k")):
        warm = warm + ZERO_CELSIUS_K
    time = _strung(name, arrays["time"], remarks)
    return checked(Record(name, time, arrays["current"], arrays["voltage"], warm, tuple(remarks)))


def _text(path: Path) -> str:
    content = path.read_bytes()
    for encoding in ("utf-8-sig", "utf-16") if content[:2] in (b"\xff\xfe", b"\xfe\xff") else ("utf-8-sig", "cp1252"):
        try:
            return content.decode(encoding)
        except UnicodeDecodeError:
            continue
    raise ValueError(f"{path.name} is not text")


def _header(name: str, lines: list[str]) -> tuple[list[list[str]], int, Columns]:
    """(rows, row of the header, columns), with the separator that shows a header; cyclers write some lines before it."""
    best: Columns = {}
    for delimiter in ";\t,":
        try:
            rows = list(csv.reader(lines, delimiter=delimiter))
        except csv.Error as error:
            raise ValueError(f"{name} is no table of text: {error}") from error
        for at, row in enumerate(rows[:HEADER_LINES]):
            found = _columns(row)
            if set(NEEDED) <= set(found):
                return rows, at, found
            best = max(best, found, key=len)
    missing = [quantity for quantity in NEEDED if quantity not in best]
    raise ValueError(
        f"{name} has no column for {', '.join(missing)}; its first row is: {lines[0].strip()[:200]}. "
        "Known names and units: see chargetune.battery.identification.cycler_files"
    )


def _columns(row: list[str]) -> Columns:
    found: Columns = {}
    rank: dict[str, int] = {}
    for index, cell in enumerate(row):
        # "Test Time / s", "Current(A)", "I/mA" are a name and a unit.
        plain = re.sub(r"[\s_]", "", cell).lower()
        match = re.fullmatch(r"(.+?)(?:[(\[/]([^)\]]*)[)\]]?)?", plain)
        if not match:
            continue
        label, unit = match.group(1), match.group(2) or ""
        for quantity, names in NAMES.items():
            if label in names and unit in UNITS[quantity] and names.index(label) < rank.get(quantity, len(names)):
                rank[quantity] = names.index(label)
                found[quantity] = (index, UNITS[quantity][unit], cell.strip())
    return found


def _numbers(name: str, rows: list[list[str]], at: int, columns: Columns, remarks: list[str]) -> dict[str, NDArray[np.float64]]:
    table: dict[str, list[float]] = {quantity: [] for quantity in columns}
    marks: set[str] = set()
    for number, row in enumerate(rows[at + 1 :], start=at + 2):
        if not any(cell.strip() for cell in row):
            continue
        if any(cell.strip() for cell in row[len(rows[at]) :]):
            raise ValueError(
                f"{name}, row {number} has {len(row)} cells, allowed are {len(rows[at])} as in the header "
                "(decimal commas need semicolons or tabs between columns)"
            )
        for quantity in list(table):
            index, factor, label = columns[quantity]
            cell = row[index].strip() if index < len(row) else ""
            marks |= {mark for mark in ",." if mark in cell and ":" not in cell}
            if len(marks) > 1:
                raise ValueError(f"{name}, row {number}: {label} = {cell!r}, but other numbers have the other decimal mark; allowed is one")
            try:
                table[quantity].append(_value(cell, factor))
            except ValueError as error:
                where = f"row {number}: {label} = {cell!r}, allowed is {error}"
                if quantity in NEEDED:
                    raise ValueError(f"{name}, {where}") from None
                remarks.append(f"the temperature was left out ({where})")
                del table[quantity]
    return {quantity: np.array(values) for quantity, values in table.items()}


def _value(cell: str, factor: float) -> float:
    """The number in SI; a clock is in s whatever the unit. Raises ValueError with what is allowed."""
    clock = re.fullmatch(r"(?:(\d+)-)?(\d+):(\d\d?):(\d\d?(?:[.,]\d+)?)", cell)
    if clock:
        days, hours, minutes, seconds = clock.groups()
        return 86400.0 * int(days or 0) + 3600.0 * int(hours) + 60.0 * int(minutes) + float(seconds.replace(",", "."))
    try:
        value = float(cell.replace(",", "."))
    except ValueError:
        raise ValueError("a number") from None
    if not np.isfinite(value):
        raise ValueError("a finite number")
    return factor * value


def _strung(name: str, time: NDArray[np.float64], remarks: list[str]) -> NDArray[np.float64]:
    """Time that increases: a step whose clock restarts begins where the one before ended."""
    steps = np.diff(time)
    falls = np.flatnonzero(steps < 0)
    for k in falls.tolist():
        # A clock that restarts begins near zero; another one that falls is damage.
        if not 0 <= time[k + 1] <= max(RESTART_S, min(RESTART_SHARE * time[k], RESTART_MAX_S)):
            raise ValueError(f"{name}, sample {k + 2}: time = {time[k + 1]:g} s after {time[k]:g} s, allowed is an increasing time")
        steps[k] = time[k + 1]
    if falls.size:
        remarks.append(f"the clock restarts {falls.size} times (once a step); the steps were strung together")
    stands = steps == 0
    stands[falls] = False
    if np.mean(stands) > STANDS_SHARE:
        k = int(np.argmax(stands))
        raise ValueError(f"{name}, sample {k + 2}: time stands at {time[k]:g} s in {np.sum(stands)} samples, allowed is an increasing time")
    return np.asarray(np.concatenate([[0.0], np.cumsum(steps)]), dtype=np.float64)
