"""chargetune identify."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any, Literal, NamedTuple, cast

import numpy as np
from rich.console import Console
from rich.table import Table

from chargetune.battery.cell.cell import load_cell
from chargetune.battery.identification.current_sign import Sign
from chargetune.battery.identification.cycler_files import Reading, read_record
from chargetune.battery.identification.open_circuit import Branch
from chargetune.battery.identification.pulse_fit import SETS_MIN, Identification, cell_toml, identify, predicted_voltage
from chargetune.battery.identification.pulses import ZERO_CELSIUS_K, find_pulse_sets, set_temperatures
from chargetune.battery.identification.record import Record, assumptions_told, segments
from chargetune.battery.identification.thermal import activation_energy
from chargetune.cli.output import console
from chargetune.cli.outputs import Kind, Output, claim, figure_kind
from chargetune.report.figures.style import check_format
from chargetune.runtime.interrupts import raise_lost_interrupt
from chargetune.study.files import write_whole

__all__ = ["identify_command"]


class Check(NamedTuple):
    """A discharge that was predicted with the cell, and what was assumed, mended or left out when its file was read."""

    file: str
    rate_C: float
    rms_mV: float
    worst_mV: float
    remarks: tuple[str, ...]


# The options that a refusal calls by the names of the Python interface.
OPTIONS = {name: f"--{name.replace('_', '-')}" for name in ("time_unit", "current_unit", "capacity_Ah")} | {
    "temperature_C": "--temperature"
}


@contextmanager
def _options_named() -> Iterator[None]:
    try:
        yield
    except ValueError as error:
        if type(error) is not ValueError:
            raise
        raise ValueError(re.sub(rf"\b({'|'.join(OPTIONS)}) = ", lambda found: f"{OPTIONS[found[1]]} = ", str(error))) from error


@_options_named()
def identify_command(
    data: Path,
    *,
    out: Path,
    rc: int,
    capacity_Ah: float | None,
    ocv: Path | None,
    name: str | None,
    figure: Path | None,
    check: list[Path],
    temperature_C: float | None,
    branch: str,
    sign: str | None,
    units: tuple[str | None, str | None],
    series: int,
    parallel: int,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Fit a cell to measured pulses, at each temperature where there are several, write it, and say how well it fits."""
    if figure is not None:
        check_format(figure, "--figure")
    reading = Reading(cast("Sign | None", sign), *units, series=series, parallel=parallel)
    read = [data, *([] if ocv is None else [ocv]), *check]
    record = read_record(data, reading)
    at = _temperatures(record, temperature_C)
    outs, figures = ({t: _with_temperature(path, t) if len(at) > 1 else path for t in at} for path in (out, figure))
    claim(_outputs(outs, figures), inputs=read, overwrite=overwrite)
    slow = None if ocv is None else read_record(ocv, reading)
    known = [read_record(path, reading) for path in check]
    results = []
    for t in at:
        found = identify(
            record,
            rc=cast("Literal[1, 2]", rc),
            capacity_Ah=capacity_Ah,
            ocv=slow,
            name=(name or data.stem) + (f" {t:g} degC" if len(at) > 1 else ""),
            temperature_C=t,
            branch=cast("Branch", branch),
        )
        today = datetime.now().astimezone().date().isoformat()
        found = replace(found, cell=replace(found.cell, remark=f"{found.cell.remark} Fitted {today}.", series=series, parallel=parallel))
        results.append((t, found, [_check(found, one) for one in known]))
    raise_lost_interrupt()
    for t, found, _ in results:
        _write(found, cast("Path", outs[t]), figures[t])
    if as_json:
        documents = [{"temperature_C": t, "cell": str(outs[t]), **_document(found, checks)} for t, found, checks in results]
        print(json.dumps(documents[0] if len(documents) == 1 else {"cells": documents}))  # noqa: T201
        return
    screen = console()
    for t, found, checks in results:
        if len(at) > 1:
            screen.print(f"{t:g} degC", style="bold")
        _show(screen, found, checks)
        drawn = f"\nfigure {figures[t]}" if figures[t] else ""
        screen.print(f"cell in {outs[t]}{drawn}", markup=False, soft_wrap=True)
        if found.cell.pack_line:
            screen.print(found.cell.pack_line, markup=False, soft_wrap=True)
    if len(at) > 1:
        joules = activation_energy({cast("float", t) + ZERO_CELSIUS_K: found.cell for t, found, _ in results})
        screen.print(
            f"R0 + R1 at {', '.join(f'{t:g}' for t in at)} degC: activation energy {1e-3 * joules:.1f} kJ/mol ([thermal] activation_J_mol)",
            markup=False,
            soft_wrap=True,
        )
    screen.print(f"next: put the limits of its data sheet into it, then chargetune init --cell {outs[at[0]]}", markup=False, soft_wrap=True)


def _outputs(outs: Mapping[float | None, Path | None], figures: Mapping[float | None, Path | None]) -> list[Output]:
    cells = [Output("--output", path, Kind.CELL) for path in outs.values() if path is not None]
    return cells + [Output("--figure", path, figure_kind(path)) for path in figures.values() if path is not None]


def _temperatures(record: Record, chosen: float | None) -> list[float | None]:
    """The temperatures that get a cell: the chosen one (None where the record has one or none), or each with enough pulses."""
    levels = [] if chosen is not None else set_temperatures(record, find_pulse_sets(record))
    enough: list[float | None] = [level for level, sets in levels if len(sets) >= SETS_MIN]
    return enough if len(levels) > 1 and enough else [chosen]


def _with_temperature(path: Path | None, t: float | None) -> Path | None:
    return path if path is None or t is None else path.with_name(f"{path.stem}_{t:g}degC{path.suffix}")


def _write(found: Identification, out: Path, figure: Path | None) -> None:
    out.parent.mkdir(parents=True, exist_ok=True)
    write_whole(out, cell_toml(found.cell, found.remarks))
    # What was written is what a controller will read.
    cell = load_cell(out)
    if figure is not None:
        from chargetune.report.figures.identification import identification_figure
        from chargetune.report.figures.style import save

        figure.parent.mkdir(parents=True, exist_ok=True)
        save(identification_figure(replace(found, cell=cell)), figure)


def _document(found: Identification, checks: list[Check]) -> dict[str, Any]:
    points = [
        {"set": fit.number, "soc": fit.soc, "rms_mV": 1e3 * fit.rms_V, "ocv_V": fit.ocv_V, "values": fit.values, "sd": fit.sd}
        for fit in found.fits
    ]
    return {
        "points": points,
        "capacity_Ah": found.cell.capacity_Ah,
        "seconds": found.seconds,
        "remarks": list(found.remarks),
        "checks": [check._asdict() for check in checks],
    }


def _show(screen: Console, found: Identification, checks: list[Check]) -> None:
    screen.print(_table(found))
    for remark in found.remarks:
        screen.print(remark, style="dim", markup=False, soft_wrap=True)
    for check in checks:
        line = f"{check.file}: discharge at {check.rate_C:.2f}C predicted with {check.rms_mV:.1f} mV rms, {check.worst_mV:.0f} mV at worst"
        screen.print(line, markup=False, soft_wrap=True)
        for remark in check.remarks:
            screen.print(f"{check.file}: {remark}", style="dim", markup=False, soft_wrap=True)


def _check(found: Identification, record: Record) -> Check:
    """How the voltage is predicted for the first full discharge of a record, from a full cell at rest."""
    for first, last, sign in segments(record):
        if sign < 0 and -record.part(first, last).charge_Ah[-1] > 0.5 * found.cell.capacity_Ah:
            _, measured, predicted = predicted_voltage(found.cell, record.part(max(first - 1, 0), last), 1.0)
            error = 1e3 * (predicted - measured)
            rate = -float(np.median(record.current_A[first:last])) / found.cell.capacity_Ah
            return Check(record.source, rate, float(np.sqrt(np.mean(error**2))), float(np.max(np.abs(error))), record.remarks)
    with assumptions_told(record):
        raise ValueError(f"{record.source}: no discharge of at least half the capacity, so there is nothing to check the cell against")


def _table(found: Identification) -> Table:
    table = Table(box=None, pad_edge=False)
    resistances = ["R0_ohm", *(f"R{k}_ohm" for k in found.cell.pairs)]
    times = [f"tau{k}_s" for k in found.cell.pairs]
    for heading in ("SOC %", "OCV V", *(f"{r[:2]} mΩ" for r in resistances), *(f"{t[:-2]} s" for t in times), "rms mV"):
        table.add_column(heading, justify="right", no_wrap=True)
    for fit in found.fits:
        values = [f"{1e3 * fit.values[r]:.2f}±{1e3 * fit.sd[r]:.2f}" for r in resistances]
        values += [f"{fit.values[t]:.1f}±{fit.sd[t]:.1f}" for t in times]
        table.add_row(f"{100 * fit.soc:.1f}", f"{fit.ocv_V:.3f}", *values, f"{1e3 * fit.rms_V:.2f}")
    return table
