"""The range of use of a certificate whose study declares none."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from chargetune.battery.charging.problem import ChargingProblem
from chargetune.battery.charging.range_settings import NOT_ELECTROCHEMICAL, ChargingRangeSettings

__all__ = ["default_range"]

# The SOC at the start differs by +- this.
SOC_START = 0.03
# Below the SOC that is charged to a start stays by this.
SOC_ROOM = 0.01
# New cells of one make and their first few hundred cycles. They differ as a whole; by node little, since neighbouring SOC have one
# material. The nodes let R0 and R1 differ from each other.
USUAL = ChargingRangeSettings(resistance=0.05, resistance_by_node=0.02, capacitance=0.05, capacity=0.02, fade=0.05, growth=0.10)


def default_range(problem: ChargingProblem) -> ChargingRangeSettings:
    """`USUAL`, and a start within `SOC_START` of the problem's; of an electrochemical plant what can differ there."""
    start, wanted = problem.episode.soc_start, problem.objective.charge_time_to_soc or problem.episode.soc_target
    low = max(0.0, start - SOC_START)
    settings = replace(USUAL, soc_start=(low, max(low, min(start + SOC_START, wanted - SOC_ROOM))))
    none: dict[str, Any] = dict.fromkeys(NOT_ELECTROCHEMICAL, 0.0)
    return settings if problem.plant_cell else replace(settings, **none)
