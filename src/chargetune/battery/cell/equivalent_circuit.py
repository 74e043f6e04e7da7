"""Equivalent-circuit model of a cell: OCV, ohmic resistance, R-C pairs over the state of charge; lumped temperature."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import casadi as ca

from chargetune.battery.cell.cell import Cell
from chargetune.model.model import Model, Named, Signal
from chargetune.model.splines import natural_spline, pchip
from chargetune.runtime.cache import Built

__all__ = ["ecm_model", "overpotentials", "start_state", "table_nodes"]

FLOOR = 1e-3
OF_THERMAL = ("heat_capacity_J_K", "cooling_W_K", "ambient_K", "reference_K", "activation_J_mol", "entropic_V_K")

_CIRCUITS = Built(32)


def table_nodes(soc: tuple[float, ...]) -> list[float]:
    """Spline nodes of a table over SOC: the table's own, and 0 and 1 where it does not reach them."""
    return [*([0.0] if soc[0] > 0.0 else []), *soc, *([1.0] if soc[-1] < 1.0 else [])]


def overpotentials(cell: Cell) -> tuple[str, ...]:
    """Names of the states of the R-C pairs: overpotential_V, overpotential2_V, overpotential3_V."""
    return tuple(f"overpotential{'' if k == 1 else k}_V" for k in cell.pairs)


def start_state(cell: Cell, soc: float) -> dict[str, float]:
    """The cell at rest at this SOC and, where it has a temperature, in equilibrium with its ambient."""
    return {"soc": soc} | ({"temperature_K": cell.thermal.ambient_K} if cell.thermal else {})


def ecm_model(
    cell: Cell, sampling_time_s: float = 10.0, settings: Mapping[str, float] | None = None, *, last_current: bool = False
) -> Model:
    """n-RC circuit of a cell, current I charge-positive (A), states z = SOC and U1 .. Un (V), output V.

        z+  = z + eta Ts / (3600 Q) I
        Uk+ = (Uk - Rk I) exp(-Ts / (Rk Ck)) + Rk I,   k = 1 .. n
        V   = OCV(z) + U1 + .. + Un + R0 I

    exact for a current held over the interval and Rk, Ck held at their value at its start. All tables are natural
    cubic splines over SOC whose node values are run-time parameters, held constant beyond the first and last node of
    the table up to SOC 0 and 1, and kept positive by (s + sqrt(s^2 + r^2)) / 2 with r a thousandth of their mean (a
    change below 1e-6 of the value at the nodes); OCV is monotone PCHIP. Source: case study of Hirt et al., ADCHEM 2024, with the sign
    of V corrected (OCV - U1 - R0 I, as printed there, never reaches 4.2 V when charging).

    A cell with ``thermal`` data has the state and output T (`Thermal`), with Q = I (V - OCV) + I T dOCV/dT held over
    the interval:

        T+  = T_e + (T - T_e) exp(-Ts hA / C),   T_e = T_ambient + Q / hA

    and all resistances are multiplied by s(T). A cell with an ``anode`` table has the output anode_potential_V.
    ``settings`` are further run-time parameters for an estimator; of them f and h read resistance_factor alone, where it is
    given: a factor on all resistances. With ``last_current`` the current of the interval before is a state, last_current_A.
    """
    parameters: dict[str, Any] = {name: getattr(cell, name) for name in (*cell.tables, "capacity_Ah", "coulombic_efficiency")}
    if cell.thermal:
        parameters |= {name: getattr(cell.thermal, name) for name in OF_THERMAL}
    parameters |= settings or {}
    factor = cell.thermal and (cell.thermal.factor_K, cell.thermal.factor)
    # All that the equations have as numbers; the rest are parameters, and cells that differ in these alone share one pair of functions.
    key = (cell.soc, tuple(cell.pairs), cell.ocv_soc, cell.ocv_V, factor, cell.anode, tuple(settings or ()), sampling_time_s, last_current)
    circuit = _CIRCUITS.get(key, lambda: _circuit(cell, parameters, sampling_time_s, last_current=last_current))
    return circuit.with_parameters(**parameters)


def _circuit(cell: Cell, parameters: Mapping[str, Any], sampling_time_s: float, *, last_current: bool) -> Model:
    nodes = table_nodes(cell.soc)
    low, high = int(cell.soc[0] > 0.0), int(cell.soc[-1] < 1.0)
    thermal, anode, pairs = cell.thermal, cell.anode, dict(zip(cell.pairs, overpotentials(cell), strict=True))

    def table(z: ca.SX, values: ca.SX) -> Any:
        ends = [values[0]] * low, [values[-1]] * high
        spline = natural_spline(z, nodes, ca.vertcat(*ends[0], values, *ends[1]))
        # Between very unequal nodes a cubic spline dips below zero, where the circuit would be unstable.
        rounding = FLOOR * ca.sum1(values) / values.shape[0]
        return (spline + ca.sqrt(spline**2 + rounding**2)) / 2

    def equations(x: Named, u: Named, p: Named) -> tuple[dict[str, ca.SX], dict[str, ca.SX]]:
        z, current = x["soc"], u["current_A"]
        factor = thermal.resistance_factor(x["temperature_K"], p["activation_J_mol"], p["reference_K"]) if thermal else 1
        factor *= p.get("resistance_factor", 1)
        following = {"soc": z + p["coulombic_efficiency"] * sampling_time_s / 3600 / p["capacity_Ah"] * current}
        polarised = table(z, p["R0_ohm"]) * factor * current
        for k, name in pairs.items():
            r, c = table(z, p[f"R{k}_ohm"]), table(z, p[f"C{k}_F"])
            settled = r * factor * current
            following[name] = (x[name] - settled) * ca.exp(-sampling_time_s / (r * c)) + settled
            polarised += x[name]
        outputs = {"voltage_V": pchip(z, cell.ocv_soc, cell.ocv_V) + polarised, "soc": z, **{name: x[name] for name in pairs.values()}}
        if thermal:
            temperature = x["temperature_K"]
            heat = current * polarised + current * temperature * p["entropic_V_K"]
            settled = p["ambient_K"] + heat / p["cooling_W_K"]
            decay = ca.exp(-sampling_time_s * p["cooling_W_K"] / p["heat_capacity_J_K"])
            following["temperature_K"] = settled + (temperature - settled) * decay
            outputs["temperature_K"] = temperature
        if last_current:
            following["last_current_A"] = current
        if anode:
            outputs["anode_potential_V"] = (
                pchip(z, anode.soc, anode.potential_V) - pchip(z, anode.soc, anode.resistance_ohm) * factor * current
            )
        return following, outputs

    states = [Signal("soc"), *(Signal(name, "V") for name in pairs.values())]
    if thermal:
        states.append(Signal("temperature_K", "K"))
    outputs = list(states)
    if last_current:
        states.append(Signal("last_current_A", "A"))
    return Model.build(
        f"{'R-' + 'RC' * len(pairs)} circuit{' with temperature' if thermal else ''}",
        states=states,
        inputs=(Signal("current_A", "A"),),
        outputs=(Signal("voltage_V", "V"), *outputs, *([Signal("anode_potential_V", "V")] if anode else [])),
        parameters=parameters,
        sampling_time_s=sampling_time_s,
        equations=equations,
    )
