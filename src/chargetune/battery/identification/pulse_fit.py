"""A cell from measured pulses: OCV, R0 and one or two R-C pairs over the state of charge, with uncertainties."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator
from scipy.optimize import least_squares, nnls

from chargetune.battery.cell.cell import CAPACITY_MAX_AH, RESISTANCE_MAX_V, Cell, highest_voltage
from chargetune.battery.cell.equivalent_circuit import ecm_model
from chargetune.battery.identification.open_circuit import ocv_from_rests, ocv_from_slow
from chargetune.battery.identification.pulses import PULSE_MAX_S, REST_MIN_S, PulseSet, find_pulse_sets, groups
from chargetune.battery.identification.record import Record
from chargetune.battery.validation import check_number

__all__ = ["Identification", "PulseFit", "cell_toml", "identify", "predicted_voltage"]

# Time constants that pulses of some ten seconds can tell, s: the first pair, and both where there are two.
TIME_CONSTANTS_S = {1: ((0.5, 400.0),), 2: ((0.5, 30.0), (15.0, 1000.0))}
# Least and largest voltage of a resistance at 1C.
RESISTANCES_V = (1e-6, RESISTANCE_MAX_V)
# A standard deviation of more than this share says that the data do not hold the parameter.
SPREAD_MAX = 1.0
GRID = 12
# More than any sensor's noise, mV.
OFFSET_MAX_MV = 20.0
# Nearer to a bound than this, in logarithm, the bound and not the data gave the value.
AT_BOUND = 0.01
# Pulses that leave more of the SOC than this at one end leave the person a remark.
UNCOVERED_TOLD = 0.1


@dataclass(frozen=True)
class PulseFit:
    """One set of pulses: SOC in its middle, OCV before it (V), parameters and their standard deviations by name, rms (V).

    The standard deviations come from the Jacobian at the solution, s^2 (J'J)^-1 with s^2 the sum of squared residuals over
    the degrees of freedom: they hold for independent noise, so they are too small where the circuit itself does not fit.
    ``sd`` also has that of ``ocv_V``.
    """

    soc: float
    ocv_V: float
    values: dict[str, float]
    sd: dict[str, float]
    rms_V: float
    time_s: NDArray[np.float64]
    measured_V: NDArray[np.float64]
    fitted_V: NDArray[np.float64]


@dataclass(frozen=True)
class Identification:
    """The cell, the fits it is made of (falling SOC in the order of the file), remarks, and how long it took."""

    cell: Cell
    fits: tuple[PulseFit, ...]
    remarks: tuple[str, ...]
    seconds: float


def identify(
    record: Record, *, rc: Literal[1, 2] = 1, capacity_Ah: float | None = None, ocv: Record | None = None, name: str = ""
) -> Identification:
    """Fit a cell to a record of pulses at several SOC.

    SOC is 1 where the record's charge is largest (a full charge) and counts the charge from there; without
    ``capacity_Ah`` it is 0 where the charge is smallest, which takes a full discharge. The OCV is what the rests before
    the pulses show, or with ``ocv`` the mean of one slow charge and discharge. Raises ValueError that says which
    parameter the data do not hold.
    """
    began = time.perf_counter()
    if rc not in (1, 2):
        raise ValueError(f"rc = {rc!r}, allowed is 1 or 2")
    sets = find_pulse_sets(record)
    if len(sets) < 3:
        raise ValueError(
            f"{record.source}: {len(sets)} sets of pulses after a rest; to identify R0, R1 and C1 over SOC at least 3 are needed "
            f"(pulses of at most {PULSE_MAX_S:g} s after rests of at least {REST_MIN_S:g} s)"
        )
    charge = record.charge_Ah
    span = float(np.max(charge[sets[0].first :]) - np.min(charge[sets[0].first :]))
    capacity = span if capacity_Ah is None else check_number("capacity_Ah", capacity_Ah, 0.0, CAPACITY_MAX_AH, "Ah", open_low=True)
    if capacity < 0.999 * span:
        raise ValueError(f"capacity_Ah = {capacity:g}, allowed is at least {span:.4g} Ah, the charge that the record passes")
    soc = 1.0 + (charge - float(np.max(charge[sets[0].first :]))) / capacity
    remarks = [*record.remarks, "SOC 1 is the fullest point of the record"]
    if capacity_Ah is None:
        remarks.append(f"capacity {capacity:.4g} Ah is the charge between the fullest and the emptiest point of the record")
    grid, volts = ocv_from_rests(record, sets, soc) if ocv is None else ocv_from_slow(ocv, capacity, remarks)
    curve = PchipInterpolator(grid, volts, extrapolate=True)
    fits = [_fit(record, part, soc, curve, rc, capacity) for part in sets]
    least, most = (pick(fit.soc for fit in fits) for pick in (min, max))
    if least > UNCOVERED_TOLD or most < 1 - UNCOVERED_TOLD:
        remarks.append(f"the pulses reach from SOC {least:.2f} to {most:.2f}; beyond, the circuit is that of the nearest of them")
    cell = _cell(record, fits, capacity, (grid, volts), rc, name or record.source)
    remarks.append(
        f"{cell.voltage_min_V:g} V to {cell.voltage_max_V:g} V and {cell.current_max_A:g} A are the extremes of the record; "
        "the limits of the data sheet belong in their place"
    )
    return Identification(cell, tuple(fits), tuple(remarks), time.perf_counter() - began)


def _response(t: NDArray[np.float64], current: NDArray[np.float64], tau: float) -> NDArray[np.float64]:
    """Voltage of an R-C pair with R = 1 ohm, from rest; each sample's current flowed since the sample before. Shape (n,)."""
    out = np.zeros(t.size)
    decay = np.exp(-np.diff(t) / tau)
    for k in range(1, t.size):
        out[k] = out[k - 1] * decay[k - 1] + (1 - decay[k - 1]) * current[k]
    return out


def _fit(record: Record, part: PulseSet, soc: NDArray[np.float64], curve: Any, rc: int, capacity_Ah: float) -> PulseFit:
    pulses = part.of(record)
    t, current, z = pulses.time_s - pulses.time_s[0], pulses.current_A, soc[part.first : part.last]
    # What the OCV itself moves during the pulses is known; its level is measured just before them.
    overpotential = pulses.voltage_V - pulses.voltage_V[0] - (curve(z) - curve(z[0]))
    place = f"{record.source} at SOC {z[0]:.2f}"

    # The level before the pulses is one sample with its noise, hence an offset (in mV, so that all unknowns are of one size).
    def model(x: NDArray[np.float64]) -> NDArray[np.float64]:
        r0, *pairs = np.exp(x[:-1])
        slow = sum(r * _response(t, current, tau) for r, tau in zip(pairs[::2], pairs[1::2], strict=True))
        return np.asarray(1e-3 * x[-1] + r0 * current + slow, dtype=np.float64)

    ranges = TIME_CONSTANTS_S[rc]
    start = _start(t, current, overpotential, ranges)
    ohms = RESISTANCES_V[0] / capacity_Ah, RESISTANCES_V[1] / capacity_Ah
    names = ["R0_ohm", *(name for k in range(1, rc + 1) for name in (f"R{k}_ohm", f"tau{k}_s"))]
    bounds = dict(zip(names, (ohms, *(pair for taus in ranges for pair in (ohms, taus))), strict=True))
    lower, upper = (np.append(np.log([pair[end] for pair in bounds.values()]), OFFSET_MAX_MV * (2 * end - 1)) for end in (0, 1))
    found = least_squares(
        lambda x: model(x) - overpotential, np.clip(np.append(start, 0.0), lower + 1e-6, upper - 1e-6), bounds=(lower, upper), x_scale=1.0
    )
    rms = float(np.sqrt(np.mean(found.fun**2)))
    # Logarithms are fitted, so the spreads are relative; the last unknown is the offset.
    covariance = _covariance(found.jac, found.fun)
    spread = np.sqrt(np.diag(covariance))
    for i, (label, (least, most)) in enumerate(bounds.items()):
        if not spread[i] <= SPREAD_MAX:
            raise ValueError(
                f"{place}: the data do not hold {label} (standard deviation {100 * spread[i]:.0f} % of it); "
                f"longer pulses, faster sampling or {'--rc 1' if rc == 2 else 'larger currents'} would"
            )
        if min(found.x[i] - lower[i], upper[i] - found.x[i]) < AT_BOUND:
            raise ValueError(
                f"{place}: the data do not hold {label}; its fit ends at {np.exp(found.x[i]):.3g}, allowed is {least:.3g} to {most:.3g}; "
                f"{'faster sampling' if found.x[i] - lower[i] < AT_BOUND else 'longer pulses'}"
                f"{' or --rc 1' if rc == 2 else ''} would"
            )
    values = dict(zip(names, np.exp(found.x[:-1]).tolist(), strict=True))
    sd = {label: values[label] * float(s) for label, s in zip(names, spread[:-1], strict=True)} | {"ocv_V": 1e-3 * float(spread[-1])}
    for k in range(1, rc + 1):
        r, tau = names.index(f"R{k}_ohm"), names.index(f"tau{k}_s")
        values[f"C{k}_F"] = values[f"tau{k}_s"] / values[f"R{k}_ohm"]
        sd[f"C{k}_F"] = values[f"C{k}_F"] * float(np.sqrt(covariance[r, r] + covariance[tau, tau] - 2 * covariance[r, tau]))
    middle = float(np.clip(np.mean(z), 0.0, 1.0))
    fitted = pulses.voltage_V - overpotential + model(found.x)
    return PulseFit(middle, float(pulses.voltage_V[0] + 1e-3 * found.x[-1]), values, sd, rms, t, pulses.voltage_V, fitted)


def _covariance(jacobian: NDArray[np.float64], residuals: NDArray[np.float64]) -> NDArray[np.float64]:
    """s^2 (J'J)^-1, very large (not infinite) along what the data do not hold. Shape (p, p)."""
    _, sizes, directions = np.linalg.svd(jacobian, full_matrices=False)
    scaled = directions / np.maximum(sizes, 1e-12)[:, None]
    freedom = max(residuals.size - jacobian.shape[1], 1)
    return np.asarray(scaled.T @ scaled * (np.sum(residuals**2) / freedom), dtype=np.float64)


def _start(
    t: NDArray[np.float64], current: NDArray[np.float64], overpotential: NDArray[np.float64], ranges: tuple[tuple[float, float], ...]
) -> NDArray[np.float64]:
    """Logarithms of R0, R1, tau1, ..: the best of a grid of time constants, resistances by non-negative least squares."""
    grids = [np.geomspace(low * 1.05, high / 1.05, GRID) for low, high in ranges]
    best, error = np.zeros(0), np.inf
    responses = [[_response(t, current, tau) for tau in grid] for grid in grids]
    for choice in np.ndindex(*(GRID,) * len(grids)):
        columns = np.column_stack([current, *(responses[k][i] for k, i in enumerate(choice))])
        resistances, residual = nnls(columns, overpotential)
        if residual < error:
            error = residual
            pairs = [value for k, i in enumerate(choice) for value in (max(resistances[k + 1], 1e-6), grids[k][i])]
            best = np.log([max(resistances[0], 1e-6), *pairs])
    return best


def _cell(
    record: Record, fits: list[PulseFit], capacity: float, ocv: tuple[NDArray[np.float64], NDArray[np.float64]], rc: int, name: str
) -> Cell:
    ordered = sorted(fits, key=lambda fit: fit.soc)
    # A spline through two sets at nearly one SOC would follow their noise.
    near = groups(np.array([fit.soc for fit in ordered]))
    table = {
        key: tuple(float(np.mean([ordered[i].values[key] for i in group])) for group in near)
        for key in ("R0_ohm", *(k for i in range(1, rc + 1) for k in (f"R{i}_ohm", f"C{i}_F")))
    }
    worst = 1e3 * max(fit.rms_V for fit in fits)
    highest, lowest = float(np.max(record.voltage_V)), float(np.min(record.voltage_V))
    made = f"Identified from the pulses in {record.source}: {len(near)} SOC points, {rc}-RC, rms at most {worst:.2f} mV."
    return Cell(
        name=name,
        capacity_Ah=round(capacity, 6),
        coulombic_efficiency=1.0,
        current_max_A=float(np.max(np.abs(record.current_A))),
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
