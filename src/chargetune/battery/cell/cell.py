"""Cell: capacity, limits, circuit tables and thermal data of one cell, as data that has been checked."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, fields, replace
from difflib import get_close_matches
from importlib.resources import files
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from chargetune.battery.cell.plating import Anode
from chargetune.battery.cell.thermal import Thermal
from chargetune.battery.validation import check_count
from chargetune.runtime.counted import counted

__all__ = [
    "CAPACITY_MAX_AH",
    "FLAT_BELOW_V",
    "PACK",
    "PACK_MAX",
    "PAIRS_MAX",
    "RESISTANCE_MAX_V",
    "Cell",
    "default_cell",
    "highest_voltage",
    "load_cell",
    "load_cells",
    "mismatched",
]

# R-C pairs of a circuit; more cannot be told apart in measured pulses.
PAIRS_MAX = 3

# What a single cell can be. Outside these a unit was mistaken: the bounds are wide on purpose, and those of currents and
# resistances are in proportion to the capacity, so that they hold for a coin cell of 45 mAh as for a prismatic one of 280 Ah.
# The largest cells on sale are storage cells of 1.2 kAh.
CAPACITY_MAX_AH = 1500.0
VOLTAGE_RANGE_V = (0.5, 5.0)
# Largest current over capacity, 1/h: least and most.
RATES_PER_H = (0.01, 100.0)
# Voltage that one resistance may take at 1C. New cells have 0.003 to 0.1 V; cold, empty or aged ones ten times as much.
RESISTANCE_MAX_V = 2.0
# Of an R-C pair, s: from the double layer of an electrode to the slowest diffusion, a day.
TIME_CONSTANT_RANGE_S = (1e-3, 1e5)
# How far the upper limit may lie above the OCV of the full cell. Flat chemistries, whose full cell is below 3.7 V, are charged far above
# it: LFP 0.3 V, LTO 0.4 V, NiMH 0.2 V. The OCV of the others (NMC, NCA, LCO, LMO) goes on rising beyond full, which is overcharge.
FLAT_BELOW_V = 3.7
ABOVE_FULL_V = {"flat": 0.5, "rising": 0.2}
# From empty to full the OCV rises at least by this (NiMH: 0.2 V), and of the SOC at most this share is without any rise (LFP: a third).
OCV_RISE_MIN_V = 0.05
OCV_FLAT_MAX = 0.5
# Cells in series or in parallel: the longest strings are those of grid storage, some 500 cells for 1500 V.
PACK_MAX = 1000
PACK = ("series", "parallel")


@dataclass(frozen=True)
class Cell:
    """A cell as R0 and one to three R-C pairs.

    Tables over SOC in 0..1: ``soc`` for R0 (ohm), R1 (ohm), C1 (F) and, where there are more pairs, R2, C2, R3, C3;
    ``ocv_soc`` for the OCV (V). ``thermal`` adds a lumped temperature, ``anode`` a table of the anode potential.
    Charge-positive current. ``series`` and ``parallel`` say of how many such cells a pack consists; every number is of one
    cell all the same (`line`). Raises ValueError that names the field, its value and what is allowed.
    """

    name: Annotated[str, Field(description="Name of the cell, shown in every output.")]
    capacity_Ah: Annotated[float, Field(description="Charge between SOC 0 and 1, Ah; more than 0, at most 1500.")]
    coulombic_efficiency: Annotated[float, Field(description="Charge stored over charge passed, 1; more than 0.5, at most 1.")]
    current_max_A: Annotated[float, Field(description="Largest charging current, A; 0.01 to 100 times capacity_Ah.")]
    voltage_min_V: Annotated[float, Field(description="Lower limit of the terminal voltage, V; 0.5 to 5, below the OCV of the full cell.")]
    voltage_max_V: Annotated[
        float,
        Field(description="Upper limit of the terminal voltage, V; at most 5, and 0.2 V (flat OCV: 0.5 V) above that of the full cell."),
    ]
    soc: Annotated[tuple[float, ...], Field(description="SOC of the circuit's tables, 1; increasing within 0 to 1, at least 2.")]
    R0_ohm: Annotated[tuple[float, ...], Field(description="Ohmic resistance over soc, ohm; more than 0, at most 2 V / capacity_Ah.")]
    R1_ohm: Annotated[tuple[float, ...], Field(description="Resistance of the first R-C pair, ohm; bounds as of R0_ohm.")]
    C1_F: Annotated[tuple[float, ...], Field(description="Capacitance of the first R-C pair, F; R1 C1 is 1e-3 to 1e5 s.")]
    ocv_soc: Annotated[tuple[float, ...], Field(description="SOC of the open-circuit voltage, 1; increasing from 0 to 1, at least 4.")]
    ocv_V: Annotated[
        tuple[float, ...],
        Field(
            description="Open-circuit voltage over ocv_soc, V; it never falls, rises by 0.05 V, and is flat over at most half of the SOC."
        ),
    ]
    remark: Annotated[str, Field(description="A note, shown beside the name.")] = ""
    R2_ohm: Annotated[tuple[float, ...], Field(description="Resistance of the second R-C pair, ohm; bounds as of R0_ohm.")] = ()
    C2_F: Annotated[tuple[float, ...], Field(description="Capacitance of the second R-C pair, F; R2 C2 is 1e-3 to 1e5 s.")] = ()
    R3_ohm: Annotated[tuple[float, ...], Field(description="Resistance of the third R-C pair, ohm; bounds as of R0_ohm.")] = ()
    C3_F: Annotated[tuple[float, ...], Field(description="Capacitance of the third R-C pair, F; R3 C3 is 1e-3 to 1e5 s.")] = ()
    thermal: Annotated[Thermal | None, Field(description="Lumped temperature; without it there is none.")] = None
    anode: Annotated[Anode | None, Field(description="Anode potential; without it the circuit does not predict it.")] = None
    series: Annotated[int, Field(description="Cells in series in the pack, 1 to 1000; all numbers stay those of one cell.")] = 1
    parallel: Annotated[int, Field(description="Cells in parallel in the pack, 1 to 1000; all numbers stay those of one cell.")] = 1

    @property
    def pairs(self) -> tuple[int, ...]:
        """Numbers of the R-C pairs that the cell has: (1,), (1, 2) or (1, 2, 3)."""
        return tuple(k for k in range(1, PAIRS_MAX + 1) if len(getattr(self, f"R{k}_ohm")))

    @property
    def tables(self) -> tuple[str, ...]:
        """Names of the circuit's tables over ``soc``: R0_ohm, R1_ohm, C1_F and so on."""
        return ("R0_ohm", *(name for k in self.pairs for name in _pair(k)))

    @property
    def title(self) -> str:
        """Its name, and for a pack of how many cells."""
        return self.name if (self.series, self.parallel) == (1, 1) else f"{self.name}, {self.series}s{self.parallel}p pack, values per cell"

    @property
    def pack_line(self) -> str:
        """What a pack's numbers are, in one line; empty for a single cell."""
        if (self.series, self.parallel) == (1, 1):
            return ""
        volts, amperes = self.series * self.voltage_max_V, self.parallel * self.current_max_A
        return (
            f"pack of {self.series} in series x {self.parallel} in parallel, all values per cell: the pack has {self.series} x the voltage "
            f"(at most {volts:g} V) and {self.parallel} x current and charge (at most {amperes:g} A)"
        )

    def __post_init__(self) -> None:
        for name in PACK:
            check_count(f"cell: {name}", getattr(self, name), 1, PACK_MAX)
        self._check_pairs()
        for name in ("soc", *self.tables, "ocv_soc", "ocv_V"):
            values = getattr(self, name)
            for i, value in enumerate(values):
                _number(f"{name}[{i}]", value)
            object.__setattr__(self, name, tuple(float(v) for v in values))
        self._check_numbers()
        _soc_table("soc", self.soc, least=2)
        self._check_circuit()
        self._check_ocv()
        self._check_parts()

    def _check_numbers(self) -> None:
        _within("capacity_Ah", self.capacity_Ah, 0.0, CAPACITY_MAX_AH, "Ah", hint="was it given in mAh?")
        _within("coulombic_efficiency", self.coulombic_efficiency, 0.5, 1.0, "")
        slow, fast = RATES_PER_H
        hint = f"more than {fast:g} times the capacity in Ah"
        _within("current_max_A", self.current_max_A, 0.0, fast * self.capacity_Ah, "A", hint=hint)
        if self.current_max_A < slow * self.capacity_Ah:
            least = f"at least a hundredth of capacity_Ah = {self.capacity_Ah:g}"
            raise ValueError(f"cell: current_max_A = {self.current_max_A:g}, allowed is {least} (was the capacity given in mAh?)")
        for name in ("voltage_min_V", "voltage_max_V"):
            _within(name, getattr(self, name), *VOLTAGE_RANGE_V, "V", hint="was it given in mV? is it a pack's?")
        if self.voltage_max_V <= self.voltage_min_V:
            raise ValueError(f"cell: voltage_max_V = {self.voltage_max_V:g} must be more than voltage_min_V = {self.voltage_min_V:g}")

    def _check_circuit(self) -> None:
        for name in self.tables:
            values = getattr(self, name)
            if len(values) != len(self.soc):
                raise ValueError(f"cell: {name} has {counted(len(values), 'value')}, expected {len(self.soc)}, one for each entry of soc")
            if name.startswith("C"):
                self._check_time_constants(name)
            else:
                self._check_resistance(name, values)

    def _check_resistance(self, name: str, values: tuple[float, ...], *, zero: bool = False) -> None:
        most = RESISTANCE_MAX_V / self.capacity_Ah
        for i, value in enumerate(values):
            if zero and value == 0:
                continue
            unit = f"ohm, {RESISTANCE_MAX_V:g} V at 1C"
            _within(f"{name}[{i}]", value, 0.0, most, unit, hint="was it given in milliohm? capacity_Ah in mAh?")

    def _check_time_constants(self, name: str) -> None:
        least, most = TIME_CONSTANT_RANGE_S
        resistances = name.replace("C", "R").replace("_F", "_ohm")
        for i, (farad, ohm) in enumerate(zip(getattr(self, name), getattr(self, resistances), strict=True)):
            _within(f"{name}[{i}]", farad, 0.0, math.inf, "F")
            if not least <= ohm * farad <= most:
                times = f"time constant {resistances}[{i}] x {name}[{i}] = {ohm * farad:.3g} s"
                raise ValueError(f"cell: {name}[{i}] = {farad:g}: the {times}, allowed is {least:g} to {most:g} s")

    def _check_ocv(self) -> None:
        _soc_table("ocv_soc", self.ocv_soc, least=4)
        if self.ocv_soc[0] > 0.0 or self.ocv_soc[-1] < 1.0:
            raise ValueError(f"cell: ocv_soc = {self.ocv_soc[0]:g}..{self.ocv_soc[-1]:g} must cover 0..1")
        if len(self.ocv_V) != len(self.ocv_soc):
            raise ValueError(
                f"cell: ocv_V has {counted(len(self.ocv_V), 'value')}, expected {len(self.ocv_soc)}, one for each entry of ocv_soc"
            )
        since = 0
        for i, (low, high) in enumerate(pairwise(self.ocv_V), start=1):
            if high < low:
                raise ValueError(f"cell: ocv_V[{i}] = {high:g} must not be less than ocv_V[{i - 1}] = {low:g}; the OCV increases with SOC")
            since = since if high == low else i
            flat = self.ocv_soc[i] - self.ocv_soc[since]
            if flat > OCV_FLAT_MAX:
                where = f"from SOC {self.ocv_soc[since]:g} to {self.ocv_soc[i]:g}"
                raise ValueError(f"cell: ocv_V[{i}] = {high:g} is the same {where}, allowed is {OCV_FLAT_MAX:g} of the SOC without a rise")
        for end in (0, -1):
            _within(f"ocv_V[{end}]", self.ocv_V[end], *VOLTAGE_RANGE_V, "V", hint="was it given in mV? is it a pack's?")
        empty, full = self.ocv_V[0], self.ocv_V[-1]
        if full - empty < OCV_RISE_MIN_V:
            least = f"at least {OCV_RISE_MIN_V:g} V above ocv_V[0] = {empty:g}"
            raise ValueError(f"cell: ocv_V[-1] = {full:g}, allowed is {least}; the OCV increases with SOC")
        most = highest_voltage(full)
        if self.voltage_max_V > most:
            why = f"{most - full:.2g} V above the OCV of the full cell, ocv_V[-1] = {full:g}"
            raise ValueError(f"cell: voltage_max_V = {self.voltage_max_V:g}, allowed is at most {most:g} V, {why}")
        if self.voltage_max_V <= empty:
            raise ValueError(
                f"cell: voltage_max_V = {self.voltage_max_V:g}, allowed is more than the OCV of the empty cell, ocv_V[0] = {empty:g}"
            )
        if self.voltage_min_V >= full:
            raise ValueError(
                f"cell: voltage_min_V = {self.voltage_min_V:g}, allowed is less than the OCV of the full cell, ocv_V[-1] = {full:g}"
            )

    def _check_parts(self) -> None:
        if self.anode is not None:
            # Without a resistance, as a slow charge shows it, the potential does not depend on the current.
            self._check_resistance("anode.resistance_ohm", self.anode.resistance_ohm, zero=True)

    def _check_pairs(self) -> None:
        for k in range(2, PAIRS_MAX + 1):
            if bool(len(getattr(self, f"R{k}_ohm"))) != bool(len(getattr(self, f"C{k}_F"))) or (
                k in self.pairs and k - 1 not in self.pairs
            ):
                raise ValueError(f"cell: R{k}_ohm and C{k}_F are given together, and only after pair {k - 1}")


def highest_voltage(full_V: float) -> float:
    """The largest upper limit of the terminal voltage of a cell whose OCV is ``full_V`` when full, V."""
    return full_V + ABOVE_FULL_V["flat" if full_V < FLAT_BELOW_V else "rising"]


def load_cell(path: str | Path) -> Cell:
    """Read a cell file (TOML). Raises ValueError naming the file and the field at fault, FileNotFoundError."""
    return _read(Path(path).read_bytes(), str(path))


def load_cells(folder: str | Path) -> tuple[Cell, ...]:
    """Read all cell files (*.toml) of a folder, by name. Raises ValueError where it is none, and as `load_cell`."""
    if not Path(folder).is_dir():
        raise ValueError(f"cells = {str(folder)!r}, allowed is a folder of cell files")
    return tuple(load_cell(path) for path in sorted(Path(folder).glob("*.toml")))


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
    _keys(data, {*top, *tables}, {"remark", *PACK, *parts}, where)
    for name in ("name", "remark"):
        if not isinstance(data.get(name, ""), str):
            raise ValueError(f"cell file {where}: {name} = {data[name]!r}, expected text")
    for name, keys in tables.items():
        _keys(_table(data, name, where), set(keys), more.get(name, set()), f"{where}, table [{name}]")
        for key, value in data[name].items():
            if not isinstance(value, list):
                raise ValueError(f"cell file {where}: {name}.{key} = {value!r}, expected a list of numbers")
    given: dict[str, Any] = {key: data[key] for key in (*top, *PACK) if key in data} | {
        key: tuple(value) for key, value in data["ecm"].items()
    }
    try:
        for name, make in parts.items():
            if name in data:
                known = {f.name for f in fields(make)}
                needed = {f.name for f in fields(make) if f.default is MISSING}
                _keys(_table(data, name, where), needed, known - needed, f"{where}, table [{name}]")
                given[name] = make(**{key: tuple(v) if isinstance(v, list) else v for key, v in data[name].items()})
        return Cell(**given, ocv_soc=tuple(data["ocv"]["soc"]), ocv_V=tuple(data["ocv"]["V"]), remark=data.get("remark", ""))
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
    known = needed | optional
    missing, unknown = sorted(needed - set(data)), sorted(set(data) - known)
    said = []
    for name in unknown:
        # Of another case, or slightly misspelt: what it stands for is not told as missing beside it.
        near = next((k for k in known if k.lower() == name.lower()), None) or next(iter(get_close_matches(name, known, 1, 0.75)), None)
        if near:
            said.append(f"{name} is not a known key; did you mean {near}?")
            missing, unknown = [k for k in missing if k != near], [k for k in unknown if k != name]
    said += [f"{', '.join(unknown)} {'is not a known key' if len(unknown) == 1 else 'are not known keys'}"] if unknown else []
    said += [f"{', '.join(missing)} {'is' if len(missing) == 1 else 'are'} not given, and needed"] if missing else []
    if said:
        raise ValueError("\n".join(f"cell file {where}: {line}" for line in said) + f"\nknown keys are {', '.join(sorted(known))}")


def _number(name: str, value: object) -> None:
    if not isinstance(value, (int, float)) or isinstance(value, bool) or not math.isfinite(value):
        raise ValueError(f"cell: {name} = {value!r}, allowed is a finite number")


def _within(name: str, value: float, low: float, high: float, unit: str, hint: str = "") -> None:
    _number(name, value)
    if not low < value <= high:
        extra = f" ({hint})" if hint and value > high else ""
        most = f" and at most {high:g} {unit}" if high < math.inf else f" {unit}"
        raise ValueError(f"cell: {name} = {value:g}, allowed is more than {low:g}{most}{extra}".replace("  ", " "))


def _soc_table(name: str, values: tuple[float, ...], least: int) -> None:
    if len(values) < least:
        raise ValueError(f"cell: {name} has {counted(len(values), 'value')}, expected at least {least}")
    for i, value in enumerate(values):
        if not 0.0 <= value <= 1.0:
            raise ValueError(f"cell: {name}[{i}] = {value:g}, allowed is 0..1 (a fraction, not per cent)")
    for i, (a, b) in enumerate(pairwise(values)):
        if b <= a:
            raise ValueError(f"cell: {name}[{i + 1}] = {b:g} must be more than {name}[{i}] = {a:g}")
