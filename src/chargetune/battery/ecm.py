"""Equivalent-circuit model of a cell: OCV, ohmic resistance and one R-C pair over the state of charge."""

from __future__ import annotations

from typing import Any

import casadi as ca

from chargetune.battery.cell import Cell
from chargetune.model.model import Model, Named, Signal
from chargetune.model.splines import natural_spline, pchip

__all__ = ["ecm_model", "table_nodes"]

FLOOR = 1e-3


def table_nodes(soc: tuple[float, ...]) -> list[float]:
    """Spline nodes of a table over SOC: the table's own, and 0 and 1 where it does not reach them."""
    return [*([0.0] if soc[0] > 0.0 else []), *soc, *([1.0] if soc[-1] < 1.0 else [])]


def ecm_model(cell: Cell, sampling_time_s: float = 10.0) -> Model:
    """R-RC circuit of a cell, current I charge-positive (A), states z = SOC and U1 (V), output V.

        z+  = z + eta Ts / (3600 Q) I
        U1+ = (U1 - R1 I) exp(-Ts / (R1 C1)) + R1 I
        V   = OCV(z) + U1 + R0 I

    exact for a current held over the interval and R1, C1 held at their value at its start. R0, R1, C1 are natural
    cubic splines over SOC whose node values are run-time parameters, held constant beyond the first and last node of
    the table up to SOC 0 and 1, and kept positive by (s + sqrt(s^2 + r^2)) / 2 with r a thousandth of their mean (a
    change below 1e-6 of the value at the nodes); OCV is monotone PCHIP. Source: case study of Hirt et al., ADCHEM 2024, with the sign
    of V corrected (OCV - U1 - R0 I, as printed there, never reaches 4.2 V when charging).
    """
    nodes = table_nodes(cell.soc)
    low, high = int(cell.soc[0] > 0.0), int(cell.soc[-1] < 1.0)

    def table(z: ca.SX, values: ca.SX) -> Any:
        ends = [values[0]] * low, [values[-1]] * high
        spline = natural_spline(z, nodes, ca.vertcat(*ends[0], values, *ends[1]))
        # Between very unequal nodes a cubic spline dips below zero, where the circuit would be unstable.
        rounding = FLOOR * ca.sum1(values) / values.shape[0]
        return (spline + ca.sqrt(spline**2 + rounding**2)) / 2

    def equations(x: Named, u: Named, p: Named) -> tuple[dict[str, ca.SX], dict[str, ca.SX]]:
        z, u1, current = x["soc"], x["overpotential_V"], u["current_A"]
        r0, r1, c1 = (table(z, p[name]) for name in ("R0_ohm", "R1_ohm", "C1_F"))
        decay = ca.exp(-sampling_time_s / (r1 * c1))
        following = {
            "soc": z + p["coulombic_efficiency"] * sampling_time_s / 3600 / p["capacity_Ah"] * current,
            "overpotential_V": (u1 - r1 * current) * decay + r1 * current,
        }
        voltage = pchip(z, cell.ocv_soc, cell.ocv_V) + u1 + r0 * current
        return following, {"voltage_V": voltage, "soc": z, "overpotential_V": u1}

    return Model.build(
        "R-RC circuit",
        states=(Signal("soc"), Signal("overpotential_V", "V")),
        inputs=(Signal("current_A", "A"),),
        outputs=(Signal("voltage_V", "V"), Signal("soc"), Signal("overpotential_V", "V")),
        parameters={
            "R0_ohm": cell.R0_ohm,
            "R1_ohm": cell.R1_ohm,
            "C1_F": cell.C1_F,
            "capacity_Ah": cell.capacity_Ah,
            "coulombic_efficiency": cell.coulombic_efficiency,
        },
        sampling_time_s=sampling_time_s,
        equations=equations,
    )
