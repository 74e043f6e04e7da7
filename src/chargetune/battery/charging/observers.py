"""Observers of a charging controller that read the voltage: a disturbance on it, and a common factor of the resistances."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import partial
from typing import Any, Literal

import casadi as ca

from chargetune.battery.cell.cell import Cell
from chargetune.battery.cell.equivalent_circuit import overpotentials
from chargetune.battery.validation import check_number
from chargetune.control.kalman import ExtendedKalman
from chargetune.model.disturbances import with_disturbances
from chargetune.model.model import Model, Named
from chargetune.model.splines import pchip

__all__ = ["Adaptive", "OffsetFree", "observer_filter", "observer_model", "settings_of"]

# Standard deviations of random walks are stated for a minute, so that they hold for any sampling time.
MINUTE_S = 60.0
# Newton steps from the inverse table to the SOC at which the OCV is the voltage at rest: error below 1e-4.
NEWTON_STEPS = 2
RESISTANCE_FACTOR = "resistance_factor"


@dataclass(frozen=True)
class OffsetFree:
    """Offset-free MPC: the voltage's error of the model is a disturbance that the filter follows, constant over the horizon.

    All are standard deviations; ``.._drift`` is what a random walk adds in a minute. The first measurement, at rest, sets the SOC through
    the OCV (``soc_from_rest``; else the believed start does). From then on it is "counted", with the controller's own capacity, or
    "measured". Overpotentials follow the controller's own model; a temperature is measured and filtered.

    The steady-state gain K of the disturbance follows from r = voltage_sd_V and q = offset_drift_V sqrt(Ts / 60 s): K^2 / (1 - K) = q^2 / r^2.
    At a voltage limit the closed loop rings where K R / R_believed is near 2, and does not overshoot where it is at most 1. The
    defaults give K = 0.77 at 10 s and 0.39 at 1 s.

    gate_sd
        None: no gate. A resistance that is wrong by half looks like an outlier of tens of standard deviations.
    """

    soc: Literal["counted", "measured"] = "counted"
    soc_from_rest: bool = True
    voltage_sd_V: float = 2e-3
    offset_start_sd_V: float = 5e-3
    offset_drift_V: float = 8e-3
    soc_sd: float = 1e-3
    temperature_sd_K: float = 0.1
    temperature_drift_K: float = 0.5
    gate_sd: float | None = None

    def __post_init__(self) -> None:
        _check("offset_free", self, ("counted", "measured"))


@dataclass(frozen=True)
class Adaptive:
    """Adaptive MPC: a filter on SOC, overpotentials, temperature, the logarithm of a common factor of the resistances, a voltage offset.

    All are standard deviations; ``.._drift`` is what a random walk adds in a minute, ``.._start_sd`` is of the start. The first
    measurement, at rest, sets the SOC through the OCV (``soc_from_rest``). "estimated", the SOC is corrected by the voltage as well
    (then its start and drift count); "counted" and "measured" are as in `OffsetFree`. In steady state SOC and offset cannot be told
    apart: their start and drift decide which of them a lasting difference is given to.

    gate_sd
        Samples further off than so many standard deviations of the innovation are left out, at most ten in a row.
    """

    soc: Literal["counted", "measured", "estimated"] = "estimated"
    soc_from_rest: bool = True
    voltage_sd_V: float = 2e-3
    offset_start_sd_V: float = 5e-3
    offset_drift_V: float = 4e-3
    resistance_start_sd: float = 0.4
    resistance_drift: float = 0.05
    overpotential_drift_V: float = 2e-3
    soc_start_sd: float = 5e-3
    soc_drift: float = 1e-4
    soc_sd: float = 1e-3
    temperature_sd_K: float = 0.1
    temperature_drift_K: float = 0.5
    gate_sd: float | None = 5.0

    def __post_init__(self) -> None:
        _check("adaptive", self, ("counted", "measured", "estimated"))


Observer = OffsetFree | Adaptive


def _check(table: str, observer: Observer, ways: tuple[str, ...]) -> None:
    if observer.soc not in ways:
        raise ValueError(f"{table}: soc = {observer.soc!r}, allowed is {' or '.join(map(repr, ways))}")
    if not isinstance(observer.soc_from_rest, bool):
        raise ValueError(f"{table}: soc_from_rest = {observer.soc_from_rest!r}, allowed is true or false")
    for name, value in settings_of(observer).items():
        check_number(f"{table}: {name}", value, 0.0, 100.0, open_low=name in ("voltage_sd_V", "temperature_sd_K", "soc_sd", "gate_sd"))


def settings_of(observer: Observer) -> dict[str, float]:
    """Its numbers by name: run-time parameters of the controller's model, which theta can set."""
    values = {part.name: getattr(observer, part.name) for part in fields(observer)}
    return {name: value for name, value in values.items() if not isinstance(value, (str, bool)) and value is not None}


def observer_model(circuit: Model, observer: Observer) -> Model:
    """The circuit with the observer's disturbances; one for `Adaptive` has a parameter resistance_factor (`ecm_model`)."""
    factor = {"resistance": (RESISTANCE_FACTOR,)} if isinstance(observer, Adaptive) else {}
    return with_disturbances(circuit, outputs=("voltage_V",), parameters=factor, settings=settings_of(observer))


def observer_filter(cell: Cell, model: Model, observer: Observer) -> ExtendedKalman:
    """The filter on `observer_model` of this cell."""
    share = math.sqrt(model.sampling_time_s / MINUTE_S)

    def drift(name: str) -> Any:
        return partial(_scaled, name=name, share=share)

    measurement: dict[str, Any] = {"voltage_V": "voltage_sd_V"}
    process: dict[str, Any] = {"voltage_V_offset": drift("offset_drift_V")}
    start: dict[str, Any] = {"voltage_V_offset": "offset_start_sd_V"}
    if observer.soc == "measured":
        measurement["soc"], process["soc"], start["soc"] = "soc_sd", "soc_sd", "soc_sd"
    if cell.thermal:
        measurement["temperature_K"], process["temperature_K"] = "temperature_sd_K", drift("temperature_drift_K")
        start["temperature_K"] = "temperature_sd_K"
    if isinstance(observer, Adaptive):
        process["resistance_log_factor"], start["resistance_log_factor"] = drift("resistance_drift"), "resistance_start_sd"
        process |= dict.fromkeys(overpotentials(cell), drift("overpotential_drift_V"))
        if observer.soc == "estimated":
            process["soc"], start["soc"] = drift("soc_drift"), "soc_start_sd"
    first = partial(_soc_at_rest, cell=cell) if observer.soc_from_rest and observer.soc != "measured" else None
    gate = None if observer.gate_sd is None else "gate_sd"
    return ExtendedKalman.of(model, measurement_sd=measurement, process_sd=process, start_sd=start, gate_sd=gate, first=first)


def _scaled(p: Named, name: str, share: float) -> Any:
    return p[name] * share


def _soc_at_rest(y: Mapping[str, Any], p: Named, cell: Cell) -> dict[str, Any]:
    """The SOC whose OCV is the voltage at rest, within 0 and 1: from the inverse table by Newton steps on the table itself."""
    voltage = ca.fmin(ca.fmax(y["voltage_V"], cell.ocv_V[0]), cell.ocv_V[-1])
    z = ca.SX.sym("z")
    ocv = pchip(z, cell.ocv_soc, cell.ocv_V)
    step = ca.Function("newton", [z], [ocv, ca.jacobian(ocv, z)])
    soc = pchip(voltage, cell.ocv_V, cell.ocv_soc)
    for _ in range(NEWTON_STEPS):
        value, slope = step(soc)
        soc = ca.fmin(ca.fmax(soc + (voltage - value) / ca.fmax(slope, 1e-3), 0.0), 1.0)
    # A sample that is lost says nothing: fmin and fmax would drop the nan.
    return {"soc": ca.if_else(ca.fabs(y["voltage_V"]) < math.inf, soc, ca.SX.nan())}
