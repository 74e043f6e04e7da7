"""A cell from measured pulses: OCV, R0 and one or two R-C pairs over the state of charge, with uncertainties."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

from chargetune.battery.cell.cell import CAPACITY_MAX_AH, Cell, highest_voltage
from chargetune.battery.cell.equivalent_circuit import ecm_model
from chargetune.battery.identification.circuit_fit import PulseFit, fit_set
from chargetune.battery.identification.fit_remarks import remarks_on, without_spikes
from chargetune.battery.identification.open_circuit import Branch, ocv_from_rests, ocv_from_slow
from chargetune.battery.identification.pulses import (
    PULSE_MAX_S,
    REST_MIN_S,
    TEMPERATURES_APART_K,
    ZERO_CELSIUS_K,
    PulseSet,
    find_pulse_sets,
    groups,
    set_temperatures,
    unused_pulses,
)
from chargetune.battery.identification.record import Record, assumptions_told, segments
from chargetune.battery.validation import check_number
from chargetune.runtime.counted import counted

__all__ = ["SETS_MIN", "Identification", "PulseFit", "cell_toml", "identify", "predicted_voltage"]

# Sets of pulses that a table over SOC takes.
SETS_MIN = 3
# Pulses that leave more of the SOC than this at one end leave the person a remark.
UNCOVERED_TOLD = 0.1


@dataclass(frozen=True)
class Identification:
    """The cell, the fits it is made of (falling SOC in the order of the file), remarks, and how long it took."""

    cell: Cell
    fits: tuple[PulseFit, ...]
    remarks: tuple[str, ...]
    seconds: float


def identify(
    record: Record,
    *,
    rc: Literal[1, 2] = 1,
    capacity_Ah: float | None = None,
    ocv: Record | None = None,
    name: str = "",
    temperature_C: float | None = None,
    branch: Branch = "middle",
) -> Identification:
    """Fit a cell to a record of pulses at several SOC.

    SOC is 1 where the record's charge is largest (a full charge) and counts the charge from there; without
    ``capacity_Ah`` it is 0 where the charge is smallest, which takes a full discharge. The OCV is what the rests before
    the pulses show, or with ``ocv`` that of one slow charge and discharge, on ``branch`` of its hysteresis. Of a record at
    several temperatures ``temperature_C`` says which sets are used. A set whose fit the data do not hold is left out, and
    the remarks say so. Raises ValueError that says which parameter the data do not hold at any SOC, or the temperatures.
    """
    if rc not in {1, 2}:
        raise ValueError(f"rc = {rc!r}, allowed is 1 or 2")
    if branch not in {"charge", "discharge", "middle"}:
        raise ValueError(f"branch = {branch!r}, allowed are charge, discharge and middle")
    with assumptions_told(record):
        return _identified(record, rc, capacity_Ah, ocv, name, temperature_C, branch)


def _identified(
    record: Record,
    rc: Literal[1, 2],
    capacity_Ah: float | None,
    ocv: Record | None,
    name: str,
    temperature_C: float | None,
    branch: Branch,
) -> Identification:
    began = time.perf_counter()
    every = find_pulse_sets(record)
    if len(every) < SETS_MIN:
        raise ValueError(
            f"{record.source}: {counted(len(every), 'set')} of pulses after a rest; to identify R0, R1 and C1 over SOC "
            f"at least {SETS_MIN} are needed (pulses of at most {PULSE_MAX_S:g} s after rests of at least {REST_MIN_S:g} s)"
        )
    remarks = [*record.remarks, "SOC 1 is the fullest point of the record"]
    chosen, within = _at_temperature(record, every, temperature_C, remarks)
    charge = record.charge_Ah
    # What was done with the cell before the charge that leads to the first set does not count.
    start = max(
        (
            a
            for a, b, kind in segments(record)
            if kind > 0 and b <= every[0].first and record.time_s[b - 1] - record.time_s[a] > PULSE_MAX_S
        ),
        default=0,
    )
    fullest, span = float(np.max(charge[start:])), float(np.ptp(charge[start:]))
    capacity = span if capacity_Ah is None else check_number("capacity_Ah", capacity_Ah, 0.0, CAPACITY_MAX_AH, "Ah", open_low=True)
    if capacity < 0.999 * span:
        raise ValueError(f"capacity_Ah = {capacity:g}, allowed is at least {span:.4g} Ah, the charge that the record passes")
    soc = 1.0 + (charge - fullest) / capacity
    if capacity_Ah is None:
        remarks.append(f"capacity {capacity:.4g} Ah is the charge between the fullest and the emptiest point of the record")
    remarks += unused_pulses(record, every, soc)
    sets = [every[k] for k in chosen]
    within[:start] = False
    if ocv is None:
        grid, volts = ocv_from_rests(record, sets, soc, remarks, branch, within)
    else:
        with assumptions_told(ocv):
            grid, volts = ocv_from_slow(ocv, capacity, remarks, branch)
    curve = PchipInterpolator(grid, volts, extrapolate=True)
    fits, unfit = list[PulseFit](), list[ValueError]()
    for k in chosen:
        try:
            fits.append(fit_set(record, every[k], k + 1, soc, curve, rc, capacity))
        except ValueError as error:
            unfit.append(error)
    if len(fits) < SETS_MIN:
        more = f" (unfit: {len(unfit)} of {counted(len(chosen), 'set')})" if fits else ""
        raise ValueError(f"{unfit[0]}{more}")
    remarks += [f"left out: {str(error).replace(f' of {record.source}', '')}" for error in unfit]
    remarks += remarks_on(fits)
    least, most = (pick(fit.soc for fit in fits) for pick in (min, max))
    if least > UNCOVERED_TOLD or most < 1 - UNCOVERED_TOLD:
        remarks.append(f"the pulses reach from SOC {least:.2f} to {most:.2f}; beyond, the circuit is that of the nearest of them")
    cell = _cell(record, fits, capacity, (grid, volts), rc, name or record.source, within)
    remarks.append(
        f"{cell.voltage_min_V:g} V to {cell.voltage_max_V:g} V and {cell.current_max_A:g} A are the extremes of the record; "
        "the limits of the data sheet belong in their place"
    )
    return Identification(cell, tuple(fits), tuple(remarks), time.perf_counter() - began)


def _at_temperature(
    record: Record, sets: list[PulseSet], temperature_C: float | None, remarks: list[str]
) -> tuple[list[int], NDArray[np.bool_]]:
    """(sets at one temperature, samples near it). Raises ValueError that names the temperatures where none was chosen."""
    levels = set_temperatures(record, sets)
    if not levels or record.temperature_K is None:
        if temperature_C is not None:
            raise ValueError(f"{record.source}: temperature_C = {temperature_C:g}, but there is no column for the temperature")
        return list(range(len(sets))), np.ones(len(record), dtype=bool)
    shown = ", ".join(f"{level:g}" for level, _ in levels)
    if temperature_C is None and len(levels) > 1:
        raise ValueError(
            f"{record.source}: pulses at {counted(len(levels), 'temperature')}, {shown} degC; --temperature says "
            "which of them the cell is for"
        )
    near = [(level, chosen) for level, chosen in levels if temperature_C is None or abs(level - temperature_C) <= TEMPERATURES_APART_K]
    if not near:
        raise ValueError(f"{record.source}: temperature_C = {temperature_C:g}, allowed are those of its pulses, {shown} degC")
    level, chosen = min(near, key=lambda pair: abs(pair[0] - (temperature_C or pair[0])))
    if len(chosen) < SETS_MIN:
        raise ValueError(f"{record.source}: {counted(len(chosen), 'set')} of pulses at {level:g} degC, needed are at least {SETS_MIN}")
    if len(levels) == 1:
        return chosen, np.ones(len(record), dtype=bool)
    remarks.append(f"temperature {level:g} degC: {len(chosen)} of {counted(len(sets), 'set')} of pulses (the record has {shown} degC)")
    off = record.temperature_K - ZERO_CELSIUS_K - level
    return chosen, np.asarray(np.abs(off) <= TEMPERATURES_APART_K)


def _cell(
    record: Record,
    fits: list[PulseFit],
    capacity: float,
    ocv: tuple[NDArray[np.float64], NDArray[np.float64]],
    rc: int,
    name: str,
    within: NDArray[np.bool_],
) -> Cell:
    ordered = sorted(fits, key=lambda fit: fit.soc)
    # A spline through two sets at nearly one SOC would follow their noise.
    near = groups(np.array([fit.soc for fit in ordered]))
    table = {
        key: tuple(float(np.mean([ordered[i].values[key] for i in group])) for group in near)
        for key in ("R0_ohm", *(k for i in range(1, rc + 1) for k in (f"R{i}_ohm", f"C{i}_F")))
    }
    worst = 1e3 * max(fit.rms_V for fit in fits)
    volts = without_spikes(record)[within]
    highest, lowest = float(np.max(volts)), float(np.min(volts))
    made = f"Identified from the pulses in {record.source}: {counted(len(near), 'SOC point')}, {rc}-RC, rms at most {worst:.2f} mV."
    return Cell(
        name=name,
        capacity_Ah=round(capacity, 6),
        coulombic_efficiency=1.0,
        current_max_A=float(np.max(np.abs(record.current_A[within]))),
        voltage_min_V=round(min(lowest, float(ocv[1][0])), 3),
        voltage_max_V=min(highest, np.floor(1e3 * highest_voltage(float(ocv[1][-1]))) / 1e3),
        soc=tuple(float(np.mean([ordered[i].soc for i in group])) for group in near),
        ocv_soc=tuple(float(z) for z in ocv[0]),
        ocv_V=tuple(float(v) for v in ocv[1]),
        remark=made,
        **table,  # type: ignore[arg-type]
    )


def cell_toml(cell: Cell, notes: Sequence[str] = ()) -> str:
    """The cell as the file that `load_cell` reads, with ``notes`` as comments at its top."""

    def row(values: tuple[float, ...]) -> str:
        return "[" + ", ".join(f"{value:.7g}" for value in values) + "]"

    def text(value: str) -> str:
        # A JSON string is a TOML string, line breaks and all.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")

    def comment(value: str) -> str:
        return "# " + "".join(letter if letter.isprintable() else " " for letter in value)

    lines = [*map(comment, (cell.remark, *notes)), f"name = {text(cell.name)}", f"remark = {text(cell.remark)}"]
    lines += [
        f"{key} = {getattr(cell, key):.7g}"
        for key in ("capacity_Ah", "coulombic_efficiency", "current_max_A", "voltage_min_V", "voltage_max_V")
    ]
    if (cell.series, cell.parallel) != (1, 1):
        lines += [f"series = {cell.series} # cells of the pack; every number here is of one cell", f"parallel = {cell.parallel}"]
    lines += ["", "[ecm] # over SOC: ohm, farad", f"soc = {row(cell.soc)}"]
    lines += [f"{key} = {row(getattr(cell, key))}" for key in cell.tables]
    lines += ["", "[ocv] # open-circuit voltage, V", f"soc = {row(cell.ocv_soc)}", f"V = {row(cell.ocv_V)}"]
    for name in ("thermal", "anode"):
        part = getattr(cell, name)
        if part is not None:
            given = {key: value for key, value in part.__dict__.items() if value != ()}
            lines += [
                "",
                f"[{name}]",
                *(f"{key} = {row(value) if isinstance(value, tuple) else f'{value:.7g}'}" for key, value in given.items()),
            ]
    return "\n".join(lines) + "\n"


def predicted_voltage(
    cell: Cell, record: Record, soc_start: float, *, step_s: float = 1.0
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """(time s, measured V, V of the cell's circuit) under the record's current, from rest at ``soc_start``, every ``step_s``."""
    model = ecm_model(replace(cell, thermal=None), step_s)
    at = np.arange(record.time_s[0], record.time_s[-1], step_s)
    # The current of an interval is that of the first sample after its start.
    after = np.minimum(np.searchsorted(record.time_s, at + 1e-9, side="left"), len(record) - 1)
    current = record.current_A[after]
    count = len(at)
    whole = model.f.mapaccum("charge", count)(ca.DM([soc_start, *[0.0] * len(cell.pairs)]), current.reshape(1, -1), model.nominal)
    voltage = np.array(model.h.map(count)(whole, current.reshape(1, -1), ca.repmat(ca.DM(model.nominal), 1, count)))[0]
    return at + step_s, np.interp(at + step_s, record.time_s, record.voltage_V), voltage
