"""chargetune identify."""

from __future__ import annotations

import json
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
from rich.table import Table

from chargetune.battery.cell.cell import load_cell
from chargetune.battery.identification.cycler_files import Reading, read_record
from chargetune.battery.identification.pulse_fit import Identification, cell_toml, identify, predicted_voltage
from chargetune.battery.identification.record import Record, segments
from chargetune.cli.output import console
from chargetune.cli.outputs import Kind, Output, claim, figure_kind
from chargetune.report.figures.style import check_format
from chargetune.runtime.interrupts import raise_lost_interrupt
from chargetune.study.files import write_whole

__all__ = ["identify_command"]


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
    series: int,
    parallel: int,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Fit a cell to measured pulses, write it, and say how well it fits."""
    if figure is not None:
        check_format(figure)
    drawn = [] if figure is None else [Output("--figure", figure, figure_kind(figure))]
    read = [data, *([] if ocv is None else [ocv]), *check]
    claim([Output("--output", out, Kind.CELL), *drawn], inputs=read, overwrite=overwrite)
    reading = Reading(series=series, parallel=parallel)
    slow = None if ocv is None else read_record(ocv, reading)
    known = [read_record(path, reading) for path in check]
    found = identify(read_record(data, reading), rc=cast("Literal[1, 2]", rc), capacity_Ah=capacity_Ah, ocv=slow, name=name or data.stem)
    checks = [(record.source, *_check(found, record)) for record in known]
    today = datetime.now().astimezone().date().isoformat()
    found = replace(found, cell=replace(found.cell, remark=f"{found.cell.remark} Fitted {today}.", series=series, parallel=parallel))
    raise_lost_interrupt()
    out.parent.mkdir(parents=True, exist_ok=True)
    write_whole(out, cell_toml(found.cell, found.remarks))
    # What was written is what a controller will read.
    cell = load_cell(out)
    if figure is not None:
        from chargetune.report.figures.identification import identification_figure
        from chargetune.report.figures.style import save

        figure.parent.mkdir(parents=True, exist_ok=True)
        save(identification_figure(replace(found, cell=cell)), figure)
    if as_json:
        document: dict[str, Any] = {
            "points": [{"soc": fit.soc, "rms_mV": 1e3 * fit.rms_V, "values": fit.values, "sd": fit.sd} for fit in found.fits],
            "seconds": found.seconds,
            "remarks": list(found.remarks),
            "checks": [{"file": file, "rate_C": rate, "rms_mV": rms, "worst_mV": worst} for file, rate, rms, worst in checks],
        }
        print(json.dumps(document))  # noqa: T201
        return
    screen = console()
    screen.print(_table(found))
    for remark in found.remarks:
        screen.print(remark, style="dim", markup=False, soft_wrap=True)
    for file, rate, rms, worst in checks:
        line = f"{file}: discharge at {rate:.2f}C predicted with {rms:.1f} mV rms, {worst:.0f} mV at worst"
        screen.print(line, markup=False, soft_wrap=True)
    screen.print(f"cell in {out}" + (f"\nfigure {figure}" if figure else ""), markup=False, soft_wrap=True)
    if found.cell.pack_line:
        screen.print(found.cell.pack_line, markup=False, soft_wrap=True)
    screen.print(f"next: put the limits of its data sheet into it, then chargetune init --cell {out}", markup=False, soft_wrap=True)


def _check(found: Identification, record: Record) -> tuple[float, float, float]:
    """(rate in 1/h, rms mV, worst mV) of the voltage predicted for the first full discharge of a record, from a full cell at rest."""
    for first, last, sign in segments(record):
        if sign < 0 and -record.part(first, last).charge_Ah[-1] > 0.5 * found.cell.capacity_Ah:
            _, measured, predicted = predicted_voltage(found.cell, record.part(max(first - 1, 0), last), 1.0)
            error = 1e3 * (predicted - measured)
            rate = -float(np.median(record.current_A[first:last])) / found.cell.capacity_Ah
            return rate, float(np.sqrt(np.mean(error**2))), float(np.max(np.abs(error)))
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
