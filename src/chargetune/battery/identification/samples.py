"""The samples of a file as cells of text by quantity: headings found, what is no sample left out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from chargetune.battery.identification.headings import Column, columns_of, missing, units_below
from chargetune.battery.identification.layouts import UNITS
from chargetune.battery.identification.tables import Table, tables

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
    below = [(number, row) for number, row in enumerate(table.rows[at + 1 :], start=at + 2) if any(cell.strip() for cell in row)]
    remarks: list[str] = []
    if below and (united := units_below(columns, below[0][1])) is not None:
        columns, below = united, below[1:]
    below = [(number, row) for number, row in below if [cell.strip() for cell in row[: len(heads)]] != heads]
    # Below headings that begin further right, rows that begin with the first column are the sums of a step or a cycle.
    nested = [not any(cell.strip() for cell in row[:lead]) for _, row in below]
    if any(nested):
        below = [pair for pair, sample in zip(below, nested, strict=True) if sample]
    cells: dict[str, list[str]] = {quantity: [] for quantity in columns}
    numbers: list[int] = []
    before: list[str] = []
    twice = 0
    for count, (number, row) in enumerate(below, start=1):
        if any(cell.strip() for cell in row[len(heads) :]):
            raise ValueError(
                f"{name}, row {number} has {len(row)} cells, allowed are {len(heads)} as in the header "
                "(decimal commas need semicolons or tabs between columns)"
            )
        if row == before:
            twice += 1
            continue
        before = row
        if count == len(below) and len(row) < len(heads) and len(row) <= max(c.index for c in columns.values()):
            remarks.append(f"the last row ({number}) is cut off and was left out")
            continue
        numbers.append(number)
        for quantity, column in columns.items():
            cells[quantity].append(row[column.index].strip() if column.index < len(row) else "")
    if twice:
        remarks.append(f"{twice} rows are equal to the row before in every cell; they were left out")
    return Samples(name, columns, others, cells, numbers, remarks)


def _joined(name: str, parts: list[Samples]) -> Samples:
    """Sheets of one table that goes on from sheet to sheet; others are refused, as one sheet is one record."""
    first = parts[0]
    places = [{quantity: (c.index, c.heading) for quantity, c in part.columns.items()} for part in parts]
    sheets = ", ".join(part.name.rpartition("sheet ")[2] for part in parts)
    source = next(q for q in ("time", "step_time", "date") if q in first.columns)
    starts = [(part.cells[source][0], part.cells[source][-1]) for part in parts] if all(p == places[0] for p in places) else []
    goes_on = bool(starts) and all(_rank(a[1]) <= _rank(b[0]) for a, b in zip(starts, starts[1:], strict=False))
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
