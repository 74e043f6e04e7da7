"""From a row of headings to columns: which one holds time, current, voltage and the rest, and in which unit."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass

from chargetune.battery.identification.layouts import NAMES, NEEDED, UNITS

__all__ = ["WAYS", "Column", "columns_of", "missing", "unit_of", "units_below"]

# Words that say how a number was got and not what it is.
FILLERS = {"measured", "meas", "in", "value", "actual", "act"}
WAYS = ("charging", "discharging")
CLOCKS = ("time", "step_time", "date")
BRACKETS = re.compile(r"[(\[{]([^()\[\]{}]*)[)\]}]")


@dataclass(frozen=True)
class Column:
    """One column of a file: its place, its heading as printed, its unit as `UNITS` names it ("" where the file names none)."""

    index: int
    heading: str
    quantity: str
    unit: str

    @property
    def factor(self) -> float:
        """To SI; 1 for a clock (a unit with colons)."""
        return UNITS.get(self.quantity, {}).get(self.unit, 1.0)


def unit_of(text: str) -> str:
    """The unit in the letters of `UNITS`; a clock's format ("h:min:s.ms") as it stands."""
    plain = unicodedata.normalize("NFKC", text).lower().strip().replace("μ", "u")
    if ":" in plain:
        return re.sub(r"\s", "", plain)
    return re.sub(r"[^a-z]", "", re.sub(r"degrees?|deg\.?", "", plain))


def columns_of(row: Sequence[str]) -> tuple[dict[str, Column], dict[str, list[Column]], list[str]]:
    """(columns by quantity, further candidates of each, headings known by name in a unit that is not)."""
    ranked: dict[str, list[tuple[float, Column]]] = {}
    odd: list[str] = []
    for index, cell in enumerate(row):
        label, unit, known = _parsed(cell)
        found = False
        for quantity, names in NAMES.items():
            # Sensors are numbered; of several the first one with the best name is taken.
            if quantity == "temperature" and label not in names:
                label_, number = re.sub(r"\d+$", "1", label), True
            else:
                label_, number = label, False
            if label_ not in names:
                continue
            units = UNITS.get(quantity)
            if units is not None and unit not in units and not (quantity in CLOCKS and ":" in unit):
                continue
            # A capital T alone is a temperature, a small t a time.
            if label == "t" and not known and (cell.strip() == "T") != (quantity == "temperature"):
                continue
            found = True
            # "Amps" and "Volts" are their own unit.
            own = label if units is not None and not unit and label in units else unit
            column = Column(index, cell.strip(), quantity, own if units is not None else "")
            ranked.setdefault(quantity, []).append((names.index(label_) + 0.5 * number, column))
        if not found and any(label in NAMES[quantity] for quantity in NEEDED):
            odd.append(cell.strip())
    chosen, others = {}, {}
    for quantity, candidates in ranked.items():
        # One name twice, as "~Time[h]" and "Time": the one with a unit.
        order = [column for _, column in sorted(candidates, key=lambda pair: (pair[0], not pair[1].unit, pair[1].index))]
        chosen[quantity], others[quantity] = order[0], order[1:]
    # One current that is signed says more than two, which may be those of a charger and a load.
    for quantity in WAYS if "current" in chosen or not {*WAYS} <= {*chosen} else ():
        chosen.pop(quantity, None)
    return chosen, others, odd


def missing(found: dict[str, Column]) -> list[str]:
    """The needed quantities that no column has; any clock or date serves as time, and two currents of either way as one."""
    instead = {"time": {*CLOCKS}, "current": {*WAYS}}
    return [q for q in NEEDED if q not in found and not instead.get(q, set()) & set(found)]


def units_below(found: dict[str, Column], row: Sequence[str]) -> dict[str, Column] | None:
    """The columns with the units of a row of units below the headings; None where the row is none."""
    below = {}
    for quantity, column in found.items():
        cell = row[column.index].strip() if column.index < len(row) else ""
        unit = unit_of(cell.strip("()[]{} "))
        if quantity in UNITS and cell and (any(sign.isdigit() for sign in cell) or not (unit in UNITS[quantity] or ":" in unit)):
            return None
        below[quantity] = Column(column.index, column.heading, quantity, unit if quantity in UNITS and not column.unit else column.unit)
    return below if any(below[quantity].unit != found[quantity].unit for quantity in below) else None


def _parsed(cell: str) -> tuple[str, str, bool]:
    """(name, unit, whether a unit stands there): "Test Time / s", "Current(A)", "I/mA", "voltage_mV", "Temperature (C)_1"."""
    text = unicodedata.normalize("NFKC", cell).strip().strip("\ufeff\"'~# ").lower()
    text = re.sub(r"deg(rees?|\.)?[\s_]*(?=[cf]\b)|°\s*", "deg", text)
    unit, known = "", False
    if bracket := BRACKETS.search(text):
        unit, text, known = bracket[1], f"{text[: bracket.start()]} {text[bracket.end() :]}", True
    elif "/" in text:
        text, _, unit = text.rpartition("/")
        known = True
    words = [word for word in re.split(r"[\s_,.]+", text) if word and word not in FILLERS]
    if not known and len(words) > 1 and words[-1].isalpha() and any(unit_of(words[-1]) in units for units in UNITS.values()):
        unit, words, known = words[-1], words[:-1], True
    label = "".join(sign for word in words for sign in word if sign.isalnum())
    return label, unit_of(unit), known
