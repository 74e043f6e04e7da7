"""The range of use of a charging controller, and its charges on cells that are drawn from it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from chargetune.battery.cell.equivalent_circuit import ecm_model, start_state
from chargetune.battery.charging.controller import controller_of
from chargetune.battery.charging.problem import ChargingProblem, judged_exactly
from chargetune.battery.charging.range_settings import ChargingRangeSettings
from chargetune.battery.charging.verdict import NotMeasuredError, charge_samples, score_episode
from chargetune.plants.range_of_use import DrawnPlant, RangeOfUse
from chargetune.plants.simulated import SimulatedPlant
from chargetune.plants.variation import Uniform, Variation

if TYPE_CHECKING:
    from chargetune.episode.compiled import CompiledEpisode
    from chargetune.episode.episode import Episode
    from chargetune.episode.score import Score

__all__ = ["ChargingRange", "range_of_use"]

# Metrics of a charge by which it breaks a limit, or is not solved.
LARGEST = ("overshoot_mV", "overshoot_mVs", "violation_mVs", "current_max_excess_A", "temperature_max_K", "solver_failures")


def range_of_use(problem: ChargingProblem, settings: ChargingRangeSettings) -> RangeOfUse:
    """The cell's circuit with what ``settings`` say that differs.

    The start of each charge is at rest, and where the cell has a temperature in equilibrium with its ambient.
    """
    cell = problem.cell
    resistances, capacitances = ([n for n in cell.tables if n.startswith(letter)] for letter in "RC")
    out = [
        Variation(name, Uniform(-width, width), parameters=dict.fromkeys(tables, 1.0), by_entry=name.endswith("node"))
        for name, width, tables in (
            ("resistance", settings.resistance, resistances),
            ("resistance_by_node", settings.resistance_by_node, resistances),
            ("capacitance", settings.capacitance, capacitances),
            ("capacitance_by_node", settings.capacitance_by_node, capacitances),
            ("capacity", settings.capacity, ["capacity_Ah"]),
        )
        if width and tables
    ]
    if settings.fade or settings.growth:
        changes = dict.fromkeys(resistances, settings.growth) | {"capacity_Ah": -settings.fade}
        out.append(Variation("age", Uniform(0.0, 1.0), parameters=changes))
    start = start_state(cell, problem.episode.soc_start)
    if settings.soc_start:
        start["soc"] = 0.0
        out.append(Variation("soc_start", Uniform(*settings.soc_start), starts={"soc": 1.0}, of="episode"))
    if settings.ambient_K and cell.thermal:
        usual = cell.thermal.ambient_K
        shift = Uniform(*(value - usual for value in settings.ambient_K))
        out.append(Variation("ambient", shift, parameters={"ambient_K": 1.0 / usual}, starts={"temperature_K": 1.0}, of="episode"))
    if settings.voltage_bias_V:
        bias = Uniform(-settings.voltage_bias_V, settings.voltage_bias_V)
        out.append(Variation("voltage_bias", bias, biases={"voltage_V": 1.0}, of="episode"))
    plant = SimulatedPlant(ecm_model(cell, problem.controller.sampling_time_s), start, problem.sensors.sensors())
    return RangeOfUse(plant, tuple(out), {"soc": (0.0, 1.0)})


@dataclass(frozen=True)
class ChargingRange:
    """Charges of the problem's controller over its range of use (a `RangeLoop`), judged by the true outputs.

    The controller is the same for all of them: what it knows of a start it measures.
    """

    # A study's configuration is this problem already, so its identity does not hold it twice.
    problem: ChargingProblem = field(metadata={"identity": False})

    def __post_init__(self) -> None:
        if self.problem.range is None:
            raise ValueError("range = None, allowed is a table [range] that says what differs")

    @property
    def largest_of(self) -> tuple[str, ...]:
        return LARGEST

    def draw(self, count: int, seed: int) -> list[DrawnPlant]:
        return self._range.draw(count, seed)

    def simulate(self, thetas: Sequence[NDArray[np.float64]], plants: Sequence[DrawnPlant]) -> list[Episode | None]:
        from chargetune.episode.episode import Ending

        episodes = self._loop.run_each(list(thetas), [one.plant for one in plants], [one.seed for one in plants])
        return [e.noise_free() if e.ending is Ending.DONE else None for e in episodes]

    def score(self, episode: Episode, *, metrics: bool = True) -> Score | None:
        start = float(episode.signal("soc")[0][0])
        try:
            return score_episode(self._exact, episode, metrics=metrics, soc_start=start)
        except NotMeasuredError:
            return None

    def samples(self, episode: Episode) -> dict[str, tuple[NDArray[np.float64], NDArray[np.int_]]]:
        return charge_samples(self._exact, episode)

    @cached_property
    def _range(self) -> RangeOfUse:
        return range_of_use(self.problem, self.problem.range or ChargingRangeSettings())

    @cached_property
    def _loop(self) -> CompiledEpisode:
        from chargetune.episode.compiled import compiled_episode

        return compiled_episode(controller_of(self.problem), self._range.plant, self.problem.episode.steps)

    @cached_property
    def _exact(self) -> ChargingProblem:
        return judged_exactly(self.problem)
