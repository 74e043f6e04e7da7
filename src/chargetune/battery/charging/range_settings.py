"""What differs between the charges that a controller meets, as the table [range] of a study file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from chargetune.battery.validation import check_interval, check_number

__all__ = ["ADDED", "MEANING", "NOT_ELECTROCHEMICAL", "ChargingRangeSettings", "range_line"]

# What each entry says of the plants, as a certificate states it.
MEANING = {
    "soc_start": "SOC at the start of each charge, [lowest, highest]; null: that of the study",
    "ambient_K": "ambient temperature of each charge, and that of the cell at its start, [lowest, highest] in K; null: the cell's own",
    "resistance": "R0 and the R of all R-C pairs times 1 + v, one v in [-this, this] for all of them",
    "resistance_by_node": "each node of each of these tables times 1 + v, each with its own v in [-this, this]",
    "capacitance": "the C of all R-C pairs times 1 + v, one v in [-this, this] for all of them",
    "capacitance_by_node": "each node of each of these tables times 1 + v, each with its own v in [-this, this]",
    "node_correlation": "of the v of neighbouring nodes of one table; of the i-th and the j-th it is this to the power |i - j|",
    "cells": "folder of cell files of one make, relative to this file: R, C and capacity of another one differ as theirs do",
    "capacity": "the capacity times 1 + v, v in [-this, this]",
    "fade": "the capacity times 1 - this * a, with the same age a in [0, 1] as the growth",
    "growth": "all resistances times 1 + this * a",
    "voltage_bias_V": "the voltage sensor reads too much by v, v in [-this, this], new in each charge",
}
DRAWS_MAX = 100_000
# Nodes that differ by the same are `resistance`.
CORRELATION_MAX = 0.99
# Of an electrochemical plant there is one ohmic resistance, and no circuit.
NOT_ELECTROCHEMICAL = ("resistance_by_node", "capacitance", "capacitance_by_node")
# What is no entry of a range where it is not given.
ADDED = ("node_correlation", "cells")


@dataclass(frozen=True)
class ChargingRangeSettings:
    """Every quantity but ``cells`` is drawn uniformly, all independently of each other; what is not given does not differ.

    soc_start
        SOC at the start, [lowest, highest]; new in each charge.
    ambient_K
        Ambient temperature, [lowest, highest] in K, also that of the cell at the start; new in each charge. Only with a [thermal] table.
    resistance, resistance_by_node
        R0 and the R of all R-C pairs times 1 +- this, all in common; each node of each table times 1 +- this.
    capacitance, capacitance_by_node
        The same of the C of all R-C pairs.
    node_correlation
        Of what neighbouring nodes of one table differ by, c^|i - j| of the i-th and the j-th: one SOC has the material of the next.
    cells
        A folder of cell files of one make. R, C and capacity are those of another cell of it (`population`), and all else is on top.
    capacity
        The capacity times 1 +- this.
    fade, growth
        Of an age a, uniform in [0, 1]: the capacity times 1 - fade a, all resistances times 1 + growth a.
    voltage_bias_V
        The voltage sensor reads too much by +- this; new in each charge.
    cell
        One cell of the range, by the seed that draws it: what is of the plant (resistances, capacitances, capacity, age) is the same in
        every charge, and only what is of a charge differs. The stand-in of a real cell for the tuner "twin". None: all cells.
    draws
        Fresh draws of one trial of the tuner "range": where 0.3 % of all plants break a limit, 1000 show one with probability 0.95.
    objective_quantile
        What theta is chosen for over the plants: none: the mean of the objective; 0.9: what 90 % of them have at least, as a charging time
        that they need at most; 1: the slowest of them.
    drop_idle
        The tuner "range" puts entries of theta back that are worth nothing: no more plants break a limit, and no time is lost.

    Raises ValueError naming field, value and what is allowed.
    """

    soc_start: tuple[float, float] | None = None
    ambient_K: tuple[float, float] | None = None
    resistance: float = 0.0
    resistance_by_node: float = 0.0
    capacitance: float = 0.0
    capacitance_by_node: float = 0.0
    node_correlation: float = 0.0
    cells: str | None = None
    capacity: float = 0.0
    fade: float = 0.0
    growth: float = 0.0
    voltage_bias_V: float = 0.0
    cell: int | None = None
    """One cell of the range, by the seed that draws it; by default all of them."""
    draws: int = 1000
    """Fresh draws of one trial of the tuner "range"."""
    objective_quantile: float | None = None
    """Share of the plants that have the objective that theta is chosen for, or a better one; by default their mean. 1: the slowest."""
    drop_idle: bool = False
    """Whether entries of theta that are worth nothing are put back and left out of the search."""

    def __post_init__(self) -> None:
        for name, most in (("resistance", 0.9), ("resistance_by_node", 0.9), ("capacitance", 0.9), ("capacitance_by_node", 0.9)):
            check_number(f"range: {name}", getattr(self, name), 0.0, most)
        check_number("range: node_correlation", self.node_correlation, 0.0, CORRELATION_MAX)
        if self.node_correlation and not (self.resistance_by_node or self.capacitance_by_node):
            allowed = "allowed only with resistance_by_node or capacitance_by_node"
            raise ValueError(f"range: node_correlation = {self.node_correlation:g}, {allowed}")
        if self.cells == "":
            raise ValueError("range: cells = '', allowed is a folder of cell files")
        check_number("range: capacity", self.capacity, 0.0, 0.5)
        check_number("range: fade", self.fade, 0.0, 0.5)
        check_number("range: growth", self.growth, 0.0, 2.0)
        check_number("range: voltage_bias_V", self.voltage_bias_V, 0.0, 0.1, "V")
        if isinstance(self.draws, bool) or not isinstance(self.draws, int) or not 1 <= self.draws <= DRAWS_MAX:
            raise ValueError(f"range: draws = {self.draws!r}, allowed is an integer in [1, {DRAWS_MAX}]")
        if self.objective_quantile is not None:
            check_number("range: objective_quantile", self.objective_quantile, 0.0, 1.0)
        if not isinstance(self.drop_idle, bool):
            raise ValueError(f"range: drop_idle = {self.drop_idle!r}, allowed is true or false")
        if self.cell is not None and (isinstance(self.cell, bool) or not isinstance(self.cell, int) or self.cell < 0):
            raise ValueError(f"range: cell = {self.cell!r}, allowed is an integer >= 0")
        for name, least, most, unit in (("soc_start", 0.0, 1.0, ""), ("ambient_K", 200.0, 400.0, "K")):
            pair = getattr(self, name)
            if pair is not None:
                check_interval(f"range: {name}", pair, least, most, unit)

    @property
    def entries(self) -> dict[str, float | str | list[float] | None]:
        """What differs, by name, as plain data."""
        pairs = {name: None if (pair := getattr(self, name)) is None else list(pair) for name in ("soc_start", "ambient_K")}
        given = [name for name in MEANING if name not in pairs and (name not in ADDED or getattr(self, name))]
        return pairs | {name: getattr(self, name) for name in given}

    @property
    def line(self) -> str:
        """`range_line` of these entries."""
        return range_line(self.entries) + ("" if self.cell is None else f"; one cell of it, number {self.cell}")

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the entries by which plants or charges differ."""
        of_charge = ("soc_start", "ambient_K", "voltage_bias_V")
        differing = self.entries if self.cell is None else {name: self.entries[name] for name in of_charge}
        differing.pop("node_correlation", None)
        return tuple(name for name, value in differing.items() if (value[0] < value[1] if isinstance(value, list) else value))


def range_line(entries: Mapping[str, float | str | Sequence[float] | None]) -> str:
    """What differs, in one line: "soc_start 0.05 to 0.5, resistance +-0.2, growth 0.1"."""
    shown = []
    for name, value in entries.items():
        if isinstance(value, (int, float)) and value:
            shown.append(f"{name} {'' if name in ('fade', 'growth', 'node_correlation') else '+-'}{value:g}")
        elif isinstance(value, str):
            shown.append(f"{name} like those of {value}")
        elif isinstance(value, Sequence):
            shown.append(f"{name} {value[0]:g} to {value[1]:g}")
    return ", ".join(shown) or "nothing differs but the noise"
