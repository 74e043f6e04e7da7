"""Another cell's circuit as plant: the controller has fresh pulses, the plant is the aged cell."""

from __future__ import annotations

from dataclasses import dataclass

from chargetune.battery.cell.cell import Cell
from chargetune.battery.cell.equivalent_circuit import ecm_model, start_state
from chargetune.plants.sensors import Sensors
from chargetune.plants.simulated import SimulatedPlant

__all__ = ["Circuit"]


@dataclass(frozen=True)
class Circuit:
    """The equivalent circuit of ``cell``, its OCV, R-C pairs, temperature and anode potential; the limits are the controller's cell's."""

    cell: Cell

    def plant(self, soc_start: float, sampling_time_s: float, sensors: Sensors) -> SimulatedPlant:
        """A new plant at rest at this SOC."""
        return SimulatedPlant(ecm_model(self.cell, sampling_time_s), start_state(self.cell, soc_start), sensors)

    @property
    def line(self) -> str:
        """What it is, in words."""
        return f"the circuit of {self.cell.name}, simulated"
