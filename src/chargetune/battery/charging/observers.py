"""Observers of a charging controller that read the voltage: a disturbance on it, and a common factor of the resistances."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from functools import partial
from typing import Any, Literal

import casadi as ca
import numpy as np

from chargetune.battery.cell.cell import Cell
from chargetune.battery.cell.equivalent_circuit import overpotentials
from chargetune.battery.validation import check_number
from chargetune.control.kalman import ExtendedKalman
from chargetune.control.riccati import steady_filter
from chargetune.model.disturbances import Ramp, with_disturbances
from chargetune.model.model import Model, Named
from chargetune.model.splines import pchip

__all__ = ["Adaptive", "OffsetFree", "observer_filter", "observer_model", "settings_of", "voltage_backoff"]

# Standard deviations of random walks are stated for a minute, so that they hold for any sampling time.
MINUTE_S = 60.0
# Newton steps from the inverse table to the SOC at which the OCV is the voltage at rest: error below 1e-4.
NEWTON_STEPS = 2
# An OCV that rises by less from empty to full (V) is flat there (LFP), and a Newton step would leave it on a millivolt of noise.
FLAT_V = 0.02
RESISTANCE_FACTOR = "resistance_factor"


@dataclass(frozen=True)
class OffsetFree:
    """Offset-free MPC: the voltage's error of the model is a disturbance that the filter follows, constant over the horizon.

    All but backoff_sd are standard deviations; ``.._drift`` is what a random walk adds in a minute. The first
    measurement, at rest, sets the SOC through the OCV (``soc_from_rest``; else the believed start does). From then on it is "counted",
    with the controller's own capacity, or "measured". Overpotentials follow the controller's
    own model; a temperature is measured and filtered.

    The variance that an interval adds to the disturbance is q^2 = offset_drift_V^2 Ts / 60 s + (R I resistance_drift)^2 dz, the second
    term for a relative error of the resistances that walks by resistance_drift over the whole SOC, dz the SOC of the interval, R the
    mean of all resistances. The steady-state gain K follows from it and r = voltage_sd_V: K^2 / (1 - K) = q^2 / r^2. At a voltage limit the
    current swings from sample to sample where K R / R_believed is above 1, and rings on near 2 (`check_ringing`).

    backoff_sd
        The default backoff of the voltage limit in standard deviations of the voltage one interval ahead (`voltage_backoff`); 0: none.

    gate_sd
        None: no gate. A resistance that is wrong by half looks like an outlier of tens of standard deviations.
    """

    soc: Literal["counted", "measured"] = "counted"
    """"counted": the SOC is counted from the current; "measured": it is read."""
    soc_from_rest: bool = True
    """Whether the first voltage, at rest, sets the SOC through the OCV."""
    voltage_sd_V: float = 2e-3
    """Standard deviation of the voltage's noise."""
    offset_start_sd_V: float = 5e-3
    """Standard deviation of the voltage's offset at the start."""
    offset_drift_V: float = 3e-3
    """What a minute adds to the voltage's offset, standard deviation."""
    resistance_drift: float = 0.15
    """What the whole SOC adds to the relative error of the resistances, standard deviation."""
    backoff_sd: float = 3.0
    """Margin to the voltage limit in standard deviations of the voltage one interval ahead; 0: none."""
    soc_sd: float = 1e-3
    """Standard deviation of a measured SOC."""
    temperature_sd_K: float = 0.1
    """Standard deviation of the temperature's noise."""
    temperature_drift_K: float = 0.5
    """What a minute adds to the temperature, standard deviation."""
    gate_sd: float | None = None
    """A sample further off than so many standard deviations is left out; not given: none is."""

    def __post_init__(self) -> None:
        _check("offset_free", self, ("counted", "measured"))


@dataclass(frozen=True)
class Adaptive:
    """Adaptive MPC: a filter on SOC, overpotentials, temperature, the logarithm of a common factor of the resistances, a voltage offset.

    All are standard deviations; ``.._drift`` is what a random walk adds in a minute, ``.._start_sd`` is of the start. The first
    measurement, at rest, sets the SOC through the OCV (``soc_from_rest``). "estimated", the SOC is corrected by the voltage as well
    (then its start and drift count); "counted" and "measured" are as in `OffsetFree`. In steady state SOC and offset cannot be told
    apart: their start and drift decide which of them a lasting difference is given to. resistance_drift and resistance_rate_drift are
    random walks over the SOC, of the logarithm and of its rate of change; a rate reaches resistance_rate_decay of SOC far.

    backoff_sd
        As in `OffsetFree`.

    gate_sd
        A sample further below its prediction than so many standard deviations of the innovation is left out, but never two in a row; one
        further above counts as one at the gate. A resistance four times as large as believed looks like an outlier in every sample, and
        where such samples are left out the current goes on rising.
    """

    soc: Literal["counted", "measured", "estimated"] = "estimated"
    """"counted" or "measured" as in offset_free; "estimated": the voltage corrects the counted SOC."""
    soc_from_rest: bool = True
    """Whether the first voltage, at rest, sets the SOC through the OCV."""
    voltage_sd_V: float = 2e-3
    """Standard deviation of the voltage's noise."""
    offset_start_sd_V: float = 5e-3
    """Standard deviation of the voltage's offset at the start."""
    offset_drift_V: float = 2e-3
    """What a minute adds to the voltage's offset, standard deviation."""
    resistance_start_sd: float = 0.3
    """Standard deviation of the logarithm of the common resistance factor at the start."""
    resistance_drift: float = 0.05
    """Random walk of that logarithm over the whole SOC, standard deviation."""
    resistance_rate_start_sd: float = 5.0
    """Standard deviation of its rate of change with SOC at the start."""
    resistance_rate_drift: float = 12.0
    """Random walk of that rate over the whole SOC, standard deviation."""
    resistance_rate_decay: float = 0.04
    """How much of the SOC a rate reaches."""
    overpotential_drift_V: float = 1e-3
    """What a minute adds to each overpotential, standard deviation."""
    soc_start_sd: float = 5e-3
    """Standard deviation of the SOC at the start, for "estimated"."""
    soc_drift: float = 1e-4
    """What a minute adds to the SOC, standard deviation, for "estimated"."""
    backoff_sd: float = 3.0
    """Margin to the voltage limit in standard deviations of the voltage one interval ahead; 0: none."""
    soc_sd: float = 1e-3
    """Standard deviation of a measured SOC."""
    temperature_sd_K: float = 0.1
    """Standard deviation of the temperature's noise."""
    temperature_drift_K: float = 0.5
    """What a minute adds to the temperature, standard deviation."""
    gate_sd: float | None = 5.0
    """A sample further below its prediction is left out, but never two in a row; one further above counts as at the gate."""

    def __post_init__(self) -> None:
        _check("adaptive", self, ("counted", "measured", "estimated"))


Observer = OffsetFree | Adaptive


def _check(table: str, observer: Observer, ways: tuple[str, ...]) -> None:
    if observer.soc not in ways:
        raise ValueError(f"{table}: soc = {observer.soc!r}, allowed is {' or '.join(map(repr, ways))}")
    if not isinstance(observer.soc_from_rest, bool):
        raise ValueError(f"{table}: soc_from_rest = {observer.soc_from_rest!r}, allowed is true or false")
    for name, value in settings_of(observer).items():
        check_number(f"{table}: {name}", value, 0.0, 1e4, open_low=name in ("voltage_sd_V", "temperature_sd_K", "soc_sd", "gate_sd"))


def settings_of(observer: Observer) -> dict[str, float]:
    """Its numbers by name: run-time parameters of the controller's model, which theta can set."""
    values = {part.name: getattr(observer, part.name) for part in fields(observer)}
    return {name: value for name, value in values.items() if not isinstance(value, (str, bool)) and value is not None}


def observer_model(circuit: Model, observer: Observer) -> Model:
    """The circuit with the observer's disturbances; one for `Adaptive` has a parameter resistance_factor (`ecm_model`)."""
    factor = {"resistance": (RESISTANCE_FACTOR,)} if isinstance(observer, Adaptive) else {}
    ramps = {}
    if isinstance(observer, Adaptive):
        along = partial(_charge, sampling_time_s=circuit.sampling_time_s)
        ramps["resistance_log_factor"] = Ramp(along, observer.resistance_rate_decay)
    settings = {name: value for name, value in settings_of(observer).items() if name != "resistance_rate_decay"}
    return with_disturbances(circuit, outputs=("voltage_V",), parameters=factor, ramps=ramps, settings=settings)


def observer_filter(cell: Cell, model: Model, observer: Observer) -> ExtendedKalman:
    """The filter on `observer_model` of this cell."""
    share = math.sqrt(model.sampling_time_s / MINUTE_S)

    def drift(name: str) -> Any:
        return partial(_scaled, name=name, share=share)

    measurement: dict[str, Any] = {"voltage_V": "voltage_sd_V"}
    process: dict[str, Any] = {"voltage_V_offset": drift("offset_drift_V")}
    if isinstance(observer, OffsetFree):
        process["voltage_V_offset"] = partial(_offset_drift, cell=cell, sampling_time_s=model.sampling_time_s)
    start: dict[str, Any] = {"voltage_V_offset": "offset_start_sd_V"}
    if observer.soc == "measured":
        measurement["soc"], process["soc"], start["soc"] = "soc_sd", "soc_sd", "soc_sd"
    if cell.thermal:
        measurement["temperature_K"], process["temperature_K"] = "temperature_sd_K", drift("temperature_drift_K")
        start["temperature_K"] = "temperature_sd_K"
    if isinstance(observer, Adaptive):
        for state, name in (("resistance_log_factor", "resistance"), ("resistance_log_factor_rate", "resistance_rate")):
            process[state] = partial(_per_charge, name=f"{name}_drift", sampling_time_s=model.sampling_time_s)
            start[state] = f"{name}_start_sd"
        process |= dict.fromkeys(overpotentials(cell), drift("overpotential_drift_V"))
        if observer.soc == "estimated":
            process["soc"], start["soc"] = drift("soc_drift"), "soc_start_sd"
    first = partial(_first_sample, cell=cell, soc_from_rest=observer.soc_from_rest, soc_measured=observer.soc == "measured")
    gate = None if observer.gate_sd is None else "gate_sd"
    return ExtendedKalman.of(
        model, measurement_sd=measurement, process_sd=process, start_sd=start, gate_sd=gate, rejections_max=1, believed="above", first=first
    )


def voltage_backoff(cell: Cell, model: Model, current_max_A: float, observer: Observer) -> Callable[[Named, Named], Any]:
    """(u, p) -> the default backoff of the voltage limit, V: backoff_sd standard deviations of the voltage one interval ahead.

        b(I) = k (s(0) + (s(I_max) - s(0)) (I / I_max)^2)

    with s(I) = sqrt(C P C') from the filter's Riccati equation at this current and half charge (`riccati.steady_filter`): noise that is
    left, drift in one interval, and what the estimate lags behind. s is between these two at rest and at the largest current, and grows
    more than linearly: what is unknown of the resistances changes with R I and the root of the SOC that passes. k = 3 is one sample in 740.
    """
    estimator = observer_filter(cell, model, observer)
    x = np.zeros(len(model.states))
    x[model.state_names.index("soc")] = 0.5
    if cell.thermal:
        x[model.state_names.index("temperature_K")] = cell.thermal.ambient_K
    at_rest, at_most = (float(steady_filter(model, estimator, x, np.array([current])).prediction_sd[0]) for current in (0.0, current_max_A))
    return partial(_backoff, at_rest=at_rest, at_most=at_most, current_max_A=current_max_A)


def _backoff(u: Named, p: Named, at_rest: float, at_most: float, current_max_A: float) -> Any:
    return p["backoff_sd"] * (at_rest + (at_most - at_rest) * (u["current_A"] / current_max_A) ** 2)


def _scaled(p: Named, _: Named, name: str, share: float) -> Any:
    return p[name] * share


def _offset_drift(p: Named, u: Named, cell: Cell, sampling_time_s: float) -> Any:
    """What an interval adds to the voltage's error, sd: a drift with time, and R I times one of the resistances over the SOC."""
    # Both are random walks, so that one number holds for every sampling time: a variance in proportion to time, and to charge.
    of_charge = (_resistance(p, cell) * u["current_A"] * p["resistance_drift"]) ** 2 * ca.fabs(_charge(u, p, sampling_time_s))
    return ca.sqrt(p["offset_drift_V"] ** 2 * sampling_time_s / MINUTE_S + of_charge)


def _resistance(p: Named, cell: Cell) -> Any:
    """Mean of the sum of all resistances over the SOC, in ohm."""
    return sum(ca.sum1(p[name]) for name in cell.tables if name.startswith("R")) / len(cell.soc)


def _charge(u: Named, p: Named, sampling_time_s: float) -> Any:
    """The change of the SOC in an interval."""
    return p["coulombic_efficiency"] * sampling_time_s / 3600 / p["capacity_Ah"] * u["current_A"]


def _per_charge(p: Named, u: Named, name: str, sampling_time_s: float) -> Any:
    """What a random walk over the SOC adds in an interval."""
    return p[name] * ca.sqrt(ca.fabs(_charge(u, p, sampling_time_s)))


def _first_sample(y: Mapping[str, Any], _: Named, cell: Cell, *, soc_from_rest: bool, soc_measured: bool) -> dict[str, Any]:
    """What the first sample sets: a belief of before the charge is worth nothing where a sensor tells the same."""
    known = {"soc": y["soc"]} if soc_measured else _soc_at_rest(y, cell) if soc_from_rest else {}
    return known | ({"temperature_K": y["temperature_K"]} if cell.thermal else {})


def _soc_at_rest(y: Mapping[str, Any], cell: Cell) -> dict[str, Any]:
    """The SOC whose OCV is the voltage at rest, within 0 and 1: from the inverse table by Newton steps on the table itself."""
    # Where the table is flat the voltage tells no SOC but that it is in there: its middle.
    volts = sorted(set(cell.ocv_V))
    middles = [float(np.mean([z for z, v in zip(cell.ocv_soc, cell.ocv_V, strict=True) if v == value])) for value in volts]
    voltage = ca.fmin(ca.fmax(y["voltage_V"], volts[0]), volts[-1])
    z = ca.SX.sym("z")
    ocv = pchip(z, cell.ocv_soc, cell.ocv_V)
    step = ca.Function("newton", [z], [ocv, ca.jacobian(ocv, z)])
    soc = pchip(voltage, volts, middles)
    for _step in range(NEWTON_STEPS):
        value, slope = step(soc)
        soc = ca.fmin(ca.fmax(soc + (voltage - value) / ca.fmax(slope, FLAT_V), 0.0), 1.0)
    # A sample that is lost says nothing: fmin and fmax would drop the nan.
    return {"soc": ca.if_else(ca.fabs(y["voltage_V"]) < math.inf, soc, ca.SX.nan())}
