"""The samples of a file as cells of text by quantity: headings found, what is no sample left out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

from chargetune.battery.identification.headings import Column, columns_of, missing, units_below
from chargetune.battery.identification.layouts import UNITS
from chargetune.battery.identification.tables import Table, tables
from chargetune.runtime.counted import counted

__all__ = ["Samples", "read_samples"]

# Cyclers write so many lines at most before the headings.
HEADER_LINES = 200


@dataclass(frozen=True)
class Samples:
    """Columns by quantity, further candidates of each, cells by quantity, the number of each row in the file, remarks."""

    name: str
    columns: dict[str, Column]
    others: dict[str, list[Column]]
    cells: dict[str, list[str]]
    numbers: list[int]
    remarks: list[str]


def read_samples(path: Path) -> Samples:
    """Find the headings and take the rows below. Raises FileNotFoundError, and ValueError that says what is missing."""
    best: tuple[int, list[str], list[str], list[str]] = (-1, [], [], [])
    for candidates in tables(path):
        found = []
        for table in candidates:
            for at, row in enumerate(table.rows[:HEADER_LINES]):
                columns, others, odd = columns_of(row)
                lacks = missing(columns)
                if not lacks:
                    found.append(_samples(path.name, table, at, columns, others))
                    break
                # Of two rows with as much in them the one with more cells is likelier to be the headings.
                if not table.likely:
                    continue
                known = sum(quantity in columns for quantity in ("time", "current", "voltage")) + len(odd)
                cells = [cell.strip() for cell in row if cell.strip()]
                if (known, len(cells)) > (best[0], len(best[2])):
                    best = known, lacks, cells, odd
        found = [samples for samples in found if samples.numbers] or found[:1]
        if found:
            return found[0] if len(found) == 1 else _joined(path.name, found)
    _, lacks, cells, odd = best
    unit = f" in a known unit ({', '.join(odd)}; {_allowed(lacks)})" if odd else ""
    raise ValueError(
        f"{path.name} has no column for {', '.join(lacks or ['time', 'current', 'voltage'])}{unit}; the row most like headings is: "
        f"{', '.join(cells)[:200]}. Known names and units: see docs/cycler-files.md"
    )


def _allowed(lacks: Sequence[str]) -> str:
    return "; ".join(f"allowed for {q} are {', '.join(unit for unit in UNITS[q] if unit and len(unit) < 4)}" for q in lacks)


def _samples(name: str, table: Table, at: int, columns: dict[str, Column], others: dict[str, list[Column]]) -> Samples:
    name = f"{name}, {table.where}" if table.where else name
    heads = [cell.strip() for cell in table.rows[at]]
    while heads and not heads[-1]:
        heads.pop()
    lead = next(i for i, cell in enumerate(heads) if cell)
    below = [(number, row) for number, row in enumerate(table.rows[at + 1 :], start=at + 2) if "".join(row).strip()]
    remarks: list[str] = []
    if below and (united := units_below(columns, below[0][1])) is not None:
        columns, below = united, below[1:]
    # A file that was joined from several has its headings again.
    first = heads[lead]
    below = [pair for pair in below if first not in pair[1] or [cell.strip() for cell in pair[1][: len(heads)]] != heads]
    # Below headings that begin further right, rows that begin with the first column are the sums of a step or a cycle.
    nested = [not "".join(row[:lead]).strip() for _, row in below] if lead else []
    if any(nested):
        below = [pair for pair, sample in zip(below, nested, strict=True) if sample]
    places, width = [column.index for column in columns.values()], len(heads)
    numbers: list[int] = []
    found: list[list[str]] = []
    before: list[str] = []
    twice = 0
    for count, (number, row) in enumerate(below, start=1):
        if len(row) > width and "".join(row[width:]).strip():
            raise ValueError(
                f"{name}, row {number} has {counted(len(row), 'cell')}, allowed are {width} as in the header "
                "(decimal commas need semicolons or tabs between columns)"
            )
        if count == len(below) > 1 and len(row) <= max(places) and len(row) < len(below[-2][1]):
            remarks.append(f"the last row ({number}) is cut off and was left out")
            continue
        picked = [row[k].strip() if k < len(row) else "" for k in places]
        if picked == before:
            twice += 1
            continue
        before = picked
        numbers.append(number)
        found.append(picked)
    if twice:
        remarks.append(f"{twice} row{'s are' if twice > 1 else ' is'} equal to the row before in time, current and voltage: left out")
    cells = {quantity: [picked[k] for picked in found] for k, quantity in enumerate(columns)}
    return Samples(name, columns, others, cells, numbers, remarks)


def _joined(name: str, parts: list[Samples]) -> Samples:
    """Sheets of one table that goes on from sheet to sheet; others are refused, as one sheet is one record."""
    first = parts[0]
    places = [{quantity: (c.index, c.heading) for quantity, c in part.columns.items()} for part in parts]
    sheets = ", ".join(part.name.rpartition("sheet ")[2] for part in parts)
    source = next(q for q in ("time", "step_time", "date") if q in first.columns)
    starts = [(part.cells[source][0], part.cells[source][-1]) for part in parts] if all(p == places[0] for p in places) else []
    goes_on = bool(starts) and all(_rank(a[1]) <= _rank(b[0]) for a, b in pairwise(starts))
    if not goes_on:
        raise ValueError(f"{name} has samples in the sheets {sheets}, allowed is one record; keep the sheet that is wanted")
    cells = {quantity: [cell for part in parts for cell in part.cells[quantity]] for quantity in first.columns}
    numbers = [number for part in parts for number in part.numbers]
    remarks = [*(remark for part in parts for remark in part.remarks), f"the sheets {sheets} were joined, as their time goes on"]
    return replace(first, name=name, cells=cells, numbers=numbers, remarks=remarks)


def _rank(cell: str) -> tuple[float, str]:
    try:
        return float(cell.replace(",", ".")), ""
    except ValueError:
        return float(len(cell)), cell
