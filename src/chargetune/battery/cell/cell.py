"""Cell: capacity, limits, circuit tables and thermal data of one cell, as data that has been checked."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, fields, replace
from importlib.resources import files
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from chargetune.battery.cell.plating import Anode
from chargetune.battery.cell.thermal import Thermal

__all__ = ["PAIRS_MAX", "VOLTAGE_ABOVE_FULL_V", "Cell", "default_cell", "load_cell", "mismatched"]

# R-C pairs of a circuit; more cannot be told apart in measured pulses.
PAIRS_MAX = 3

# What a single cell can be. Outside these a unit was mistaken: the bounds are wide on purpose.
CAPACITY_MAX_AH = 1000.0
RESISTANCE_MAX_OHM = 1.0
VOLTAGE_RANGE_V = (0.5, 5.0)
# How far the upper limit may lie above the open-circuit voltage of the full cell, which is what the chemistry stands for.
VOLTAGE_ABOVE_FULL_V = 0.1


@dataclass(frozen=True)
class Cell:
    """A cell as R0 and one to three R-C pairs.

    Tables over SOC in 0..1: ``soc`` for R0 (ohm), R1 (ohm), C1 (F) and, where there are more pairs, R2, C2, R3, C3;
    ``ocv_soc`` for the OCV (V). ``thermal`` adds a lumped temperature, ``anode`` a table of the anode potential.
    Charge-positive current. Raises ValueError that names the field, its value and what is allowed.
    """

    name: str
    capacity_Ah: float
    coulombic_efficiency: float
    current_max_A: float
    voltage_min_V: float
    voltage_max_V: float
    soc: tuple[float, ...]
    R0_ohm: tuple[float, ...]
    R1_ohm: tuple[float, ...]
    C1_F: tuple[float, ...]
    ocv_soc: tuple[float, ...]
    ocv_V: tuple[float, ...]
    remark: str = ""
    R2_ohm: tuple[float, ...] = ()
    C2_F: tuple[float, ...] = ()
    R3_ohm: tuple[float, ...] = ()
    C3_F: tuple[float, ...] = ()
    thermal: Thermal | None = None
    anode: Anode | None = None

    @property
    def pairs(self) -> tuple[int, ...]:
        """Numbers of the R-C pairs that the cell has: (1,), (1, 2) or (1, 2, 3)."""
        return tuple(k for k in range(1, PAIRS_MAX + 1) if len(getattr(self, f"R{k}_ohm")))

    @property
    def tables(self) -> tuple[str, ...]:
        """Names of the circuit's tables over ``soc``: R0_ohm, R1_ohm, C1_F and so on."""
        return ("R0_ohm", *(name for k in self.pairs for name in _pair(k)))

    def __post_init__(self) -> None:
        self._check_pairs()
        for name in ("soc", *self.tables, "ocv_soc", "ocv_V"):
            values = getattr(self, name)
            for i, value in enumerate(values):
                _number(f"{name}[{i}]", value)
            object.__setattr__(self, name, tuple(float(v) for v in values))
        _within("capacity_Ah", self.capacity_Ah, 0.0, CAPACITY_MAX_AH, "Ah", hint="was it given in mAh?")
        _within("coulombic_efficiency", self.coulombic_efficiency, 0.5, 1.0, "")
        _within("current_max_A", self.current_max_A, 0.0, 100.0 * self.capacity_Ah, "A", hint="more than 100 times the capacity in Ah")
        if self.current_max_A < self.capacity_Ah / 100.0:
            least = f"at least a hundredth of capacity_Ah = {self.capacity_Ah:g}"
            raise ValueError(f"cell: current_max_A = {self.current_max_A:g}, allowed is {least} (was the capacity given in mAh?)")
        _within("voltage_min_V", self.voltage_min_V, *VOLTAGE_RANGE_V, "V", hint="was it given in mV?")
        _within("voltage_max_V", self.voltage_max_V, *VOLTAGE_RANGE_V, "V", hint="was it given in mV?")
        if self.voltage_max_V <= self.voltage_min_V:
            raise ValueError(f"cell: voltage_max_V = {self.voltage_max_V:g} must be more than voltage_min_V = {self.voltage_min_V:g}")
        _soc_table("soc", self.soc, least=2)
        _soc_table("ocv_soc", self.ocv_soc, least=4)
        if self.ocv_soc[0] > 0.0 or self.ocv_soc[-1] < 1.0:
            raise ValueError(f"cell: ocv_soc = {self.ocv_soc[0]:g}..{self.ocv_soc[-1]:g} must cover 0..1")
        for name in self.tables:
            values = getattr(self, name)
            if len(values) != len(self.soc):
                raise ValueError(f"cell: {name} has {len(values)} values, expected {len(self.soc)}, one for each entry of soc")
            for i, value in enumerate(values):
                if name.startswith("C"):
                    _within(f"{name}[{i}]", value, 0.0, 1e7, "F")
                else:
                    _within(f"{name}[{i}]", value, 0.0, RESISTANCE_MAX_OHM, "ohm", hint="was it given in milliohm?")
        if len(self.ocv_V) != len(self.ocv_soc):
            raise ValueError(f"cell: ocv_V has {len(self.ocv_V)} values, expected {len(self.ocv_soc)}, one for each entry of ocv_soc")
        for i, (low, high) in enumerate(pairwise(self.ocv_V)):
            if high <= low:
                raise ValueError(f"cell: ocv_V[{i + 1}] = {high:g} must be more than ocv_V[{i}] = {low:g}; the OCV increases with SOC")
        _within("ocv_V[0]", self.ocv_V[0], *VOLTAGE_RANGE_V, "V", hint="was it given in mV?")
        _within("ocv_V[-1]", self.ocv_V[-1], *VOLTAGE_RANGE_V, "V", hint="was it given in mV?")
        most = self.ocv_V[-1] + VOLTAGE_ABOVE_FULL_V
        if self.voltage_max_V > most:
            why = f"{VOLTAGE_ABOVE_FULL_V:g} V above the OCV of the full cell"
            raise ValueError(f"cell: voltage_max_V = {self.voltage_max_V:g}, allowed is at most {most:g} V, {why}")

    def _check_pairs(self) -> None:
        for k in range(2, PAIRS_MAX + 1):
            if bool(len(getattr(self, f"R{k}_ohm"))) != bool(len(getattr(self, f"C{k}_F"))) or (
                k in self.pairs and k - 1 not in self.pairs
            ):
                raise ValueError(f"cell: R{k}_ohm and C{k}_F are given together, and only after pair {k - 1}")


def load_cell(path: str | Path) -> Cell:
    """Read a cell file (TOML). Raises ValueError naming the file and the field at fault, FileNotFoundError."""
    return _read(Path(path).read_bytes(), str(path))


def default_cell() -> Cell:
    """Samsung INR18650-20S, the cell of the case studies; its OCV curve is a stand-in (see the data file's header)."""
    return _read(files(__package__).joinpath("data/inr18650-20s.toml").read_bytes(), "default cell")


def mismatched(cell: Cell, seed: int) -> Cell:
    """The cell as a wrong controller believes it: R0, R1, C1, R2, C2, .. each times 1 + U(-0.5, 0.5), drawn in this order from the seed."""
    draw = np.random.default_rng(seed)
    changed: dict[str, tuple[float, ...]] = {}
    for name in cell.tables:
        values = np.array(getattr(cell, name))
        changed[name] = tuple(values * (1 + draw.uniform(-0.5, 0.5, values.size)))
    return replace(cell, **changed)  # type: ignore[arg-type]


def _read(content: bytes, where: str) -> Cell:
    try:
        data = tomllib.loads(content.decode("utf-8-sig"))
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ValueError(f"cell file {where} is not valid TOML: {error}") from error
    top = ("name", "capacity_Ah", "coulombic_efficiency", "current_max_A", "voltage_min_V", "voltage_max_V")
    tables = {"ecm": ("soc", "R0_ohm", "R1_ohm", "C1_F"), "ocv": ("soc", "V")}
    more = {"ecm": {name for k in range(2, PAIRS_MAX + 1) for name in _pair(k)}}
    parts = {"thermal": Thermal, "anode": Anode}
    _keys(data, {*top, *tables}, {"remark", *parts}, where)
    for name, keys in tables.items():
        _keys(_table(data, name, where), set(keys), more.get(name, set()), f"{where}, table [{name}]")
        for key, value in data[name].items():
            if not isinstance(value, list):
                raise ValueError(f"cell file {where}: {name}.{key} = {value!r}, expected a list of numbers")
    given: dict[str, Any] = {key: data[key] for key in top} | {key: tuple(value) for key, value in data["ecm"].items()}
    try:
        for name, make in parts.items():
            if name in data:
                known = {f.name for f in fields(make)}
                needed = {f.name for f in fields(make) if f.default is MISSING}
                _keys(_table(data, name, where), needed, known - needed, f"{where}, table [{name}]")
                given[name] = make(**{key: tuple(v) if isinstance(v, list) else v for key, v in data[name].items()})
        return Cell(**given, ocv_soc=tuple(data["ocv"]["soc"]), ocv_V=tuple(data["ocv"]["V"]), remark=str(data.get("remark", "")))
    except ValueError as error:
        message = str(error)
        raise ValueError(message if message.startswith("cell file") else f"cell file {where}: {message}") from error


def _table(data: Mapping[str, Any], name: str, where: str) -> Mapping[str, Any]:
    if not isinstance(data[name], Mapping):
        raise ValueError(f"cell file {where}: {name} = {data[name]!r}, expected a table [{name}]")
    table: Mapping[str, Any] = data[name]
    return table


def _pair(k: int) -> tuple[str, str]:
    return f"R{k}_ohm", f"C{k}_F"


def _keys(data: Mapping[str, Any], needed: set[str], optional: set[str], where: str) -> None:
    missing, unknown = sorted(needed - set(data)), sorted(set(data) - needed - optional)
    if missing or unknown:
        raise ValueError(f"cell file {where}: missing {missing}, unknown {unknown}; allowed are {sorted(needed | optional)}")


def _number(name: str, value: object) -> None:
    if not isinstance(value, (int, float)) or isinstance(value, bool) or not math.isfinite(value):
        raise ValueError(f"cell: {name} = {value!r}, allowed is a finite number")


def _within(name: str, value: float, low: float, high: float, unit: str, hint: str = "") -> None:
    _number(name, value)
    if not low < value <= high:
        extra = f" ({hint})" if hint and value > high else ""
        raise ValueError(f"cell: {name} = {value:g}, allowed is more than {low:g} and at most {high:g} {unit}{extra}".replace("  ", " "))


def _soc_table(name: str, values: tuple[float, ...], least: int) -> None:
    if len(values) < least:
        raise ValueError(f"cell: {name} has {len(values)} values, expected at least {least}")
    for i, value in enumerate(values):
        if not 0.0 <= value <= 1.0:
            raise ValueError(f"cell: {name}[{i}] = {value:g}, allowed is 0..1 (a fraction, not per cent)")
    for i, (a, b) in enumerate(pairwise(values)):
        if b <= a:
            raise ValueError(f"cell: {name}[{i + 1}] = {b:g} must be more than {name}[{i}] = {a:g}")
