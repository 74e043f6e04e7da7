"""Plants of the tests of learning."""

from dataclasses import dataclass, replace

from chargetune.battery.cell.cell import Cell
from chargetune.battery.cell.equivalent_circuit import ecm_model, start_state
from chargetune.plants.simulated import SimulatedPlant


@dataclass(frozen=True)
class TwoPairs:
    """A cell that no R-RC circuit is: a second pair of 12 milliohm and 300 s, and an OCV 4 mV higher."""

    cell: Cell

    def plant(self, soc_start, sampling_time_s, sensors):
        count = len(self.cell.soc)
        ocv = tuple(v + 0.004 for v in self.cell.ocv_V)
        cell = replace(self.cell, R2_ohm=(0.012,) * count, C2_F=(25e3,) * count, ocv_V=ocv)
        return SimulatedPlant(ecm_model(cell, sampling_time_s), start_state(cell, soc_start), sensors)


@dataclass(frozen=True)
class AnotherCell:
    """The circuit of this cell as plant, whatever the learner knows."""

    cell: Cell

    def plant(self, soc_start, sampling_time_s, sensors):
        return SimulatedPlant(ecm_model(self.cell, sampling_time_s), start_state(self.cell, soc_start), sensors)
