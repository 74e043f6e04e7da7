"""The three files: study, campaign and cell, each with its tables and with who refuses what is wrong in it."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any

from pydantic import ValidationError

from chargetune.battery.cell.cell import Cell, default_cell
from chargetune.battery.cell.plating import Anode
from chargetune.battery.cell.thermal import Thermal
from chargetune.battery.charging.range_settings import MEANING, ChargingRangeSettings
from chargetune.battery.charging.tunables import WIDEST
from chargetune.battery.file_formats.bounds import Bounds, bounds_of
from chargetune.battery.file_formats.keys import Key, Table, part_of, table_of
from chargetune.battery.studies.campaign_file import CampaignFile
from chargetune.battery.studies.study_file import Config

__all__ = ["FORMATS", "Format"]

# Tables of the circuit, which a cell file has in [ecm].
CIRCUIT = re.compile(r"soc|R\d_ohm|C\d_F")
# What a table needs beside the key that is asked about.
COMPLETE: dict[tuple[str, ...], dict[str, Any]] = {
    ("study", "earlier"): {"store": "earlier.sqlite", "study": "study"},
    ("theta", "observer"): {"name": "backoff_sd", "lower": 0.1, "upper": 6.0},
    ("theta", "current_ramp"): {"lower_A_s": 0.01, "upper_A_s": 0.1},
    ("theta", "temperature_backoff"): {"lower": 0.0, "upper": 5.0},
    ("theta", "anode_backoff"): {"lower": 0.0, "upper": 0.05},
    **{("theta", name, "over"): {"temperature_K": [280.0, 310.0]} for name in ("backoff", "temperature_backoff", "anode_backoff")},
    ("theta", "schedule"): {"age": [0.0, 1.0]},
}
# Two tables of one class: the margin to a limit in the limit's unit.
BACKOFF_UNITS = {(f"{of}_backoff", name): unit for of, (_, unit) in WIDEST.items() for name in ("lower", "upper")}
# The parts of a cell that the default cell has not.
THERMAL = Thermal(heat_capacity_J_K=40.0, cooling_W_K=0.1)
ANODE = Anode(soc=(0.0, 0.3, 0.6, 1.0), potential_V=(0.5, 0.3, 0.2, 0.1), resistance_ohm=(0.03,) * 4)
KELVINS = (250.0, 260.0, 270.0, 280.0)
NODES, VOLTS = (0.0, 0.3, 0.6, 1.0), (3.0, 3.5, 3.8, 4.2)
TABLES = ("R0_ohm", "R1_ohm", "C1_F", "R2_ohm", "C2_F", "R3_ohm", "C3_F")


@dataclass(frozen=True)
class Format:
    """A kind of file: its name, a title and a first paragraph for its page, its tables, what it refuses, and its required tables."""

    name: str
    title: str
    about: str
    make: Callable[[], Table]
    refused: Callable[[Cell, Table, Key, Any], str]
    required: tuple[str, ...] = ()

    def table(self) -> Table:
        """The whole file."""
        return self.make()

    def bounds(self, table: Table, key: Key) -> Bounds:
        """The bounds of a number."""
        return bounds_of(table, key, [partial(self.refused, cell) for cell in _cells()])


@cache
def _cells() -> tuple[Cell, Cell]:
    """Two cells that share no bound of their own."""
    one = default_cell()
    smaller = replace(one, capacity_Ah=one.capacity_Ah / 2, current_max_A=one.current_max_A / 2)
    return one, replace(smaller, voltage_min_V=one.voltage_min_V + 0.1, voltage_max_V=one.voltage_max_V - 0.05)


@cache
def _study() -> Table:
    whole = table_of(Config, sentence="A study of fast charging.", texts={ChargingRangeSettings: MEANING})
    return _with_units(whole)


def _with_units(table: Table) -> Table:
    of = table.path[-1] if table.path else ""
    keys = tuple(replace(key, unit=BACKOFF_UNITS.get((of, key.name), key.unit)) for key in table.keys)
    return replace(table, keys=keys, tables=tuple(map(_with_units, table.tables)))


def _refused_study(cell: Cell, table: Table, key: Key, value: Any) -> str:
    return _message(Config, _document(table, {**COMPLETE.get(table.path, {}), key.name: value}), key, cell)


@cache
def _campaign() -> Table:
    return table_of(CampaignFile, sentence="Many studies with many seeds.")


def _refused_campaign(_: Cell, table: Table, key: Key, value: Any) -> str:
    return _message(CampaignFile, _document(table, {"configs": ["study.toml"], key.name: value}), key)


def _document(table: Table, entries: dict[str, Any]) -> dict[str, Any]:
    inner: Any = [entries] if table.many else entries
    for depth in range(len(table.path) - 1, -1, -1):
        # A table around this one may need keys of its own.
        inner = {**COMPLETE.get(table.path[:depth], {}), table.path[depth]: inner}
    return dict(inner)


def _message(model: type[Config | CampaignFile], document: dict[str, Any], key: Key, cell: Cell | None = None) -> str:
    """What is said of this key; other keys may be refused too, since the document holds no more than it."""
    try:
        read = model.model_validate_json(json.dumps(document))
        if isinstance(read, Config):
            read.problem(cell=cell)
    except ValidationError as error:
        return " ".join(p["msg"] for p in error.errors() if key.name in (*p["loc"], *re.findall(r"\w+", p["msg"])))
    except ValueError as error:
        return str(error) if key.name in str(error) else ""
    return ""


@cache
def _cell() -> Table:
    """Tables of a cell file. Its reader takes them apart into the fields of `Cell`: [ecm], [ocv] with soc and V, [thermal], [anode]."""
    whole = table_of(Cell)
    top = [key for key in whole.keys if not CIRCUIT.fullmatch(key.name) and not key.name.startswith("ocv_")]
    circuit = [key for key in whole.keys if CIRCUIT.fullmatch(key.name)]
    ocv = [replace(part_of(whole.keys, f"ocv_{name}"), name=name) for name in ("soc", "V")]
    tables = (
        Table(("ecm",), many=False, sentence="The circuit: R0 and one to three R-C pairs over the SOC.", keys=tuple(circuit)),
        Table(("ocv",), many=False, sentence="Open-circuit voltage over the SOC, at least 4 nodes.", keys=tuple(ocv)),
        *whole.tables,
    )
    return Table((), many=False, sentence="A cell as a circuit.", keys=tuple(top), tables=tables)


def _refused_cell(cell: Cell, table: Table, key: Key, value: Any) -> str:
    entry: dict[str, Any] = {key.name: tuple(value) if isinstance(value, list) else value}
    try:
        match table.path:
            case ("thermal",):
                # A table of factors has as many temperatures.
                more: dict[str, Any] = (
                    {"factor_K": (250.0, 260.0, 270.0, 280.0), "factor": (1.0,) * 4} if key.name.startswith("factor") else {}
                )
                replace(THERMAL, **{**more, **entry})
            case ("anode",):
                replace(ANODE, **entry)
            case ("ocv",):
                curve = {"soc": NODES, "V": VOLTS, **entry}
                replace(cell, ocv_soc=curve["soc"], ocv_V=curve["V"])
            case ("ecm",):
                full: dict[str, Any] = dict.fromkeys(TABLES, (1.0,) * len(NODES)) | {"soc": NODES}
                replace(cell, **{**full, **entry})
            case _:
                replace(cell, **entry)
    except ValueError as error:
        return str(error)
    return ""


FORMATS = {
    "study": Format(
        "study",
        "Study file",
        "A study file (TOML) declares what is tuned on which plant, within which limits. Every table and every key may be left out, "
        "except those that are said to be required. `chargetune init` writes one with comments.",
        _study,
        _refused_study,
    ),
    "cell": Format(
        "cell",
        "Cell file",
        "A cell file (TOML) holds a cell as an equivalent circuit. `chargetune identify` writes it from measured pulses. "
        "Current is positive when it charges; the SOC is a fraction from 0 to 1.",
        _cell,
        _refused_cell,
        ("ecm", "ocv"),
    ),
    "campaign": Format(
        "campaign",
        "Campaign file",
        "A campaign file (TOML) names study files and seeds; `chargetune campaign` tunes all of them into one store.",
        _campaign,
        _refused_campaign,
        ("campaign",),
    ),
}
