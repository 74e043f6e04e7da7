"""Reading what battery cyclers write: one CSV table of time, current, voltage and, where there is one, temperature.

Columns are found by name, as Bitrode, Arbin, Neware, BioLogic and the Battery Data Format (BDF) write them:

| quantity | names (spaces, underscores and case do not matter) |
|---|---|
| time | Time(s), Test_Time, Test_Time(s), Test Time / s, time/s, Total Time, Record Time, Time (also h:mm:ss) |
| current | Current, Current(A), Current(mA), Current / A, Cur(mA), I/mA, <I>/mA, I/A |
| voltage | Voltage, Voltage(V), Voltage(mV), Voltage / V, Vol(V), Ecell/V |
| temperature | Temperature, Temperature(C), Temperature / degC, Temp(C), T1/degC, Aux_Temperature_1(C) |

A unit in the name is converted; without one it is s, A, V and degree Celsius. A time that restarts with each step is
strung together. Comma, semicolon or tab separates; decimal commas and a byte order mark are understood. Current is
positive when it charges; a file with the other sign is recognised by its voltage, which rises with a charging current.
"""

from __future__ import annotations

import csv
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

__all__ = ["Record", "read_record"]

NAMES: dict[str, tuple[str, ...]] = {
    "time": ("testtime", "totaltime", "recordtime", "time"),
    "current": ("current", "cur", "<i>", "i"),
    "voltage": ("voltage", "vol", "ecell", "v"),
    "temperature": ("temperature", "temp", "t1", "auxtemperature1", "auxtemp1"),
}
UNITS: dict[str, dict[str, float]] = {
    "time": {"": 1.0, "s": 1.0, "sec": 1.0, "ms": 1e-3, "min": 60.0, "h": 3600.0},
    "current": {"": 1.0, "a": 1.0, "ma": 1e-3},
    "voltage": {"": 1.0, "v": 1.0, "mv": 1e-3},
    "temperature": {"": 1.0, "c": 1.0, "degc": 1.0, "°c": 1.0, "k": 1.0},
}
ZERO_CELSIUS_K = 273.15
# A single cell in V; what is beyond was another unit, or a pack.
VOLTAGE_RANGE_V = (0.0, 10.0)
CURRENT_MAX_A = 2000.0
# Longest time between two samples with current, s: the charge of a longer one is unknown.
GAP_MAX_S = 300.0
# Below this share of the largest current a cell rests.
REST_SHARE = 0.02
HEADER_LINES = 200


@dataclass(frozen=True)
class Record:
    """A measurement: time (s, increasing), current (A, positive charges), voltage (V), temperature (K) or None; each (n,)."""

    source: str
    time_s: NDArray[np.float64]
    current_A: NDArray[np.float64]
    voltage_V: NDArray[np.float64]
    temperature_K: NDArray[np.float64] | None = None
    remarks: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.time_s)

    @property
    def rest_A(self) -> float:
        """Currents smaller than this are rest."""
        return REST_SHARE * float(np.max(np.abs(self.current_A)))

    @property
    def charge_Ah(self) -> NDArray[np.float64]:
        """Charge since the first sample; a sample's current flowed since the sample before. Shape (n,)."""
        steps = np.diff(self.time_s, prepend=self.time_s[0])
        return np.asarray(np.cumsum(steps * self.current_A) / 3600, dtype=np.float64)

    def part(self, first: int, last: int) -> Record:
        """Samples ``first`` .. ``last`` (last not included)."""
        warm = None if self.temperature_K is None else self.temperature_K[first:last]
        return Record(self.source, self.time_s[first:last], self.current_A[first:last], self.voltage_V[first:last], warm, self.remarks)


def read_record(path: str | Path) -> Record:
    """Read one file. Raises FileNotFoundError, and ValueError that names file, row or column, value and what is allowed."""
    name = Path(path).name
    text = _text(Path(path))
    lines = text.splitlines()
    if not any(line.strip() for line in lines):
        raise ValueError(f"{name} is empty")
    delimiter = max(";\t,", key=lambda mark: sum(line.count(mark) for line in lines[:HEADER_LINES]))
    rows = list(csv.reader(lines, delimiter=delimiter))
    at, columns = _header(name, rows)
    table = {quantity: [] for quantity in columns}  # type: dict[str, list[float]]
    for number, row in enumerate(rows[at + 1 :], start=at + 2):
        if not any(cell.strip() for cell in row):
            continue
        for quantity, (index, factor, label) in columns.items():
            cell = row[index].strip() if index < len(row) else ""
            table[quantity].append(factor * _value(name, number, label, cell))
    if len(table["time"]) < 2:
        raise ValueError(f"{name} has {len(table['time'])} rows of numbers, allowed are at least 2")
    arrays = {quantity: np.array(values) for quantity, values in table.items()}
    warm = arrays.get("temperature")
    if warm is not None and not columns["temperature"][2].lower().rstrip(") ").endswith(("/k", "(k", "/ k", "[k]")):
        warm = warm + ZERO_CELSIUS_K
    remarks: list[str] = []
    time = _strung(name, arrays["time"], remarks)
    record = Record(name, time, arrays["current"], arrays["voltage"], warm)
    _refuse_nonsense(record)
    if _reversed(record):
        record = Record(name, time, -arrays["current"], arrays["voltage"], warm)
        remarks.append("current was positive when discharging; its sign was changed")
    return Record(name, record.time_s, record.current_A, record.voltage_V, warm, tuple(remarks))


def _text(path: Path) -> str:
    content = path.read_bytes()
    for encoding in ("utf-8-sig", "utf-16") if content[:2] in (b"\xff\xfe", b"\xfe\xff") else ("utf-8-sig", "cp1252"):
        try:
            return content.decode(encoding)
        except UnicodeDecodeError:
            continue
    raise ValueError(f"{path.name} is not text")


def _header(name: str, rows: list[list[str]]) -> tuple[int, dict[str, tuple[int, float, str]]]:
    """(row of the header, quantity -> (column, factor to SI, its name)); cyclers write some lines before the header."""
    best: dict[str, tuple[int, float, str]] = {}
    for at, row in enumerate(rows[:HEADER_LINES]):
        found = _columns(row)
        if {"time", "current", "voltage"} <= set(found):
            return at, found
        best = max(best, found, key=len)
    missing = [quantity for quantity in ("time", "current", "voltage") if quantity not in best]
    has = ", ".join(cell.strip() for cell in rows[0] if cell.strip())[:200]
    raise ValueError(f"{name} has no column for {', '.join(missing)}; its first row is: {has}. Known names: see chargetune.battery.cyclers")


def _columns(row: list[str]) -> dict[str, tuple[int, float, str]]:
    found: dict[str, tuple[int, float, str]] = {}
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


def _value(name: str, number: int, label: str, cell: str) -> float:
    clock = re.fullmatch(r"(?:(\d+)-)?(\d+):(\d\d):(\d\d(?:[.,]\d+)?)", cell)
    if clock:
        days, hours, minutes, seconds = clock.groups()
        return 86400.0 * int(days or 0) + 3600.0 * int(hours) + 60.0 * int(minutes) + float(seconds.replace(",", "."))
    try:
        value = float(cell.replace(",", "."))
    except ValueError:
        raise ValueError(f"{name}, row {number}: {label} = {cell!r}, allowed is a number") from None
    if not np.isfinite(value):
        raise ValueError(f"{name}, row {number}: {label} = {cell!r}, allowed is a finite number")
    return value


def _strung(name: str, time: NDArray[np.float64], remarks: list[str]) -> NDArray[np.float64]:
    """Time that increases: a step whose clock restarts begins where the one before ended."""
    steps = np.diff(time)
    falls = np.flatnonzero(steps < 0)
    for k in falls.tolist():
        # A clock that restarts begins near zero; another one that falls is damage.
        if time[k + 1] > 0.1 * time[k] and time[k + 1] > 60.0:
            raise ValueError(f"{name}, sample {k + 2}: time = {time[k + 1]:g} s after {time[k]:g} s, allowed is an increasing time")
        steps[k] = max(time[k + 1], 0.0)
    if falls.size:
        remarks.append(f"the clock restarts {falls.size} times (once a step); the steps were strung together")
    out = np.concatenate([[0.0], np.cumsum(steps)])
    stands = steps == 0
    stands[falls] = False
    if np.mean(stands) > 0.05:
        k = int(np.argmax(stands))
        raise ValueError(f"{name}, sample {k + 2}: time stands at {time[k]:g} s in {np.sum(stands)} samples, allowed is an increasing time")
    return np.asarray(out, dtype=np.float64)


def _refuse_nonsense(record: Record) -> None:
    low, high = VOLTAGE_RANGE_V
    typical = float(np.median(record.voltage_V))
    if not low < typical <= high:
        raise ValueError(
            f"{record.source}: voltage is {typical:g} V in the middle, allowed is {low:g} to {high:g} V (was it given in mV? is it a pack?)"
        )
    largest = float(np.max(np.abs(record.current_A)))
    if not 0 < largest <= CURRENT_MAX_A:
        raise ValueError(
            f"{record.source}: the largest current is {largest:g} A, allowed is more than 0 and at most {CURRENT_MAX_A:g} A (mA?)"
        )
    flowing = np.abs(record.current_A) > record.rest_A
    gap = (np.diff(record.time_s) > GAP_MAX_S) & flowing[1:] & flowing[:-1]
    if gap.any():
        k = int(np.argmax(gap))
        seconds = record.time_s[k + 1] - record.time_s[k]
        raise ValueError(
            f"{record.source}, sample {k + 2}: a gap of {seconds:.0f} s with current, allowed is {GAP_MAX_S:g} s; its charge is unknown"
        )


def _reversed(record: Record) -> bool:
    """Whether the voltage falls where the current jumps up."""
    jump, answer = np.diff(record.current_A), np.diff(record.voltage_V)
    large = np.abs(jump) > 0.2 * np.max(np.abs(record.current_A))
    return bool(large.any() and np.sum(jump[large] * answer[large]) < 0)
