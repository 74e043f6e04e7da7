"""The lumped temperature of a cell from one measured charge, and how its resistance depends on temperature from several cells."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.optimize import nnls

from chargetune.battery.cell.cell import Cell
from chargetune.battery.cell.thermal import GAS_CONSTANT, Thermal
from chargetune.battery.identification.record import Record
from chargetune.runtime.counted import counted

__all__ = ["activation_energy", "with_thermal"]

# Less warming than this is noise, K.
WARMING_MIN_K = 2.0


def with_thermal(cell: Cell, record: Record, soc_start: float, *, activation_J_mol: float = 0.0) -> Cell:
    """The cell with a lumped temperature, from a record that begins at rest at ambient temperature and warms the cell.

    Heat capacity C and cooling hA are the non-negative least-squares solution of the energy balance at every sample

        int I (V - OCV(z)) dt = C (T - T_0) + hA int (T - T_0) dt

    without reversible heat. Raises ValueError when the record has no temperature, or no warming to tell them from.
    """
    if record.temperature_K is None:
        raise ValueError(f"{record.source}: no column for the temperature; needed to identify heat_capacity_J_K and cooling_W_K")
    warming = record.temperature_K - record.temperature_K[0]
    if np.max(warming) < WARMING_MIN_K:
        raise ValueError(
            f"{record.source}: the cell warms by {np.max(warming):.2f} K, needed are {WARMING_MIN_K:g} K to identify heat_capacity_J_K"
        )
    steps = np.diff(record.time_s, prepend=record.time_s[0])
    soc = soc_start + record.charge_Ah / cell.capacity_Ah
    ocv = PchipInterpolator(cell.ocv_soc, cell.ocv_V)(np.clip(soc, 0.0, 1.0))
    heat = np.cumsum(steps * record.current_A * (record.voltage_V - ocv))
    (capacity, cooling), _ = nnls(np.column_stack([warming, np.cumsum(steps * warming)]), heat)
    if capacity <= 0 or cooling <= 0:
        missing = "heat_capacity_J_K" if capacity <= 0 else "cooling_W_K"
        raise ValueError(f"{record.source}: the data do not hold {missing}; a longer charge, and a rest after it, would")
    ambient = float(record.temperature_K[0])
    return replace(cell, thermal=Thermal(float(capacity), float(cooling), ambient, ambient, activation_J_mol))


def activation_energy(cells: Mapping[float, Cell]) -> float:
    """E (J/mol) of Arrhenius' law from cells identified at several temperatures (K): slope of ln(mean R0 + R1) over 1 / (R T)."""
    if len(cells) < 2:
        raise ValueError(f"cells at {counted(len(cells), 'temperature')}, needed are at least 2 to identify activation_J_mol")
    inverse = [1 / (GAS_CONSTANT * temperature) for temperature in cells]
    total = [np.log(np.mean(np.add(cell.R0_ohm, cell.R1_ohm))) for cell in cells.values()]
    return float(np.polyfit(inverse, total, 1)[0])
