"""The range of use of a charging controller, and its charges on cells that are drawn from it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from chargetune.battery.cell.equivalent_circuit import ecm_model, start_state
from chargetune.battery.charging.controller import controller_of
from chargetune.battery.charging.population import population
from chargetune.battery.charging.problem import ChargingProblem, judged_exactly
from chargetune.battery.charging.range_settings import NOT_ELECTROCHEMICAL, ChargingRangeSettings
from chargetune.battery.charging.verdict import NotMeasuredError, charge_samples, score_episode
from chargetune.battery.plants.electrochemical import Electrochemical
from chargetune.control.control_step import compiled_act
from chargetune.plants.plant import Plant
from chargetune.plants.range_of_use import DrawnPlant, RangeOfUse
from chargetune.plants.sensors import Sensors
from chargetune.plants.simulated import SimulatedPlant
from chargetune.plants.variation import Uniform, Variation

if TYPE_CHECKING:
    from chargetune.episode.compiled import CompiledEpisode
    from chargetune.episode.episode import Episode, Trip
    from chargetune.episode.score import Score

__all__ = ["ChargingRange", "electrochemical", "range_of_use"]

# Metrics of a charge by which it breaks a limit, or is not solved.
LARGEST = ("overshoot_mV", "overshoot_mVs", "violation_mVs", "current_max_excess_A", "temperature_max_K", "solver_failures")


def range_of_use(problem: ChargingProblem, settings: ChargingRangeSettings) -> RangeOfUse:
    """The plant's circuit, or where it has none the cell's, with what ``settings`` say that differs.

    The start of each charge is at rest, and where the cell has a temperature in equilibrium with its ambient.
    """
    cell, out = problem.plant_cell or problem.cell, []
    if settings.cells:
        cell, differ = population(cell, problem.range_cells)
        out.append(differ)
    resistances, capacitances = ([n for n in cell.tables if n.startswith(letter)] for letter in "RC")
    out += [
        Variation(
            name,
            Uniform(-width, width),
            parameters=dict.fromkeys(tables, 1.0),
            by_entry=name.endswith("node"),
            correlation=settings.node_correlation if name.endswith("node") else 0.0,
        )
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
        out.append(Variation("voltage_bias_V", bias, biases={"voltage_V": 1.0}, of="episode"))
    # Another plant may measure what the circuit does not have.
    sensors = problem.sensors.sensors() if problem.plant_cell else Sensors()
    plant = SimulatedPlant(ecm_model(cell, problem.controller.sampling_time_s), start, sensors)
    return RangeOfUse(plant, tuple(out), {"soc": (0.0, 1.0)})


def electrochemical(known: Electrochemical, settings: ChargingRangeSettings, values: Mapping[str, tuple[float, ...]]) -> Electrochemical:
    """The plant with these values of its variations: capacity, ambient, and the ohmic resistance, which is at least the parameter set's."""
    age, resistance, capacity = (values.get(name, (0.0,))[0] for name in ("age", "resistance", "capacity"))
    return replace(
        known,
        resistance_scale=max(1.0, known.resistance_scale * (1 + resistance) * (1 + settings.growth * age)),
        capacity_scale=known.capacity_scale * (1 + capacity) * (1 - settings.fade * age),
        ambient_K=values.get("ambient_K", (known.ambient_K,))[0],
    )


@dataclass(frozen=True)
class ChargingRange:
    """Charges of the problem's controller over its range of use (a `RangeLoop`), judged by the true outputs.

    The controller is the same for all of them: what it knows of a start it measures. Of an `Electrochemical` plant vary what
    `electrochemical` says; what else the settings ask for is refused, and so is another plant: ValueError.

    executor
        Runs the charges of an electrochemical plant, each of which takes seconds; None: one after the other in this process.
    """

    # A study's configuration is this problem already, so its identity does not hold it twice.
    problem: ChargingProblem = field(metadata={"identity": False})
    executor: Executor | None = field(default=None, compare=False, repr=False, metadata={"identity": False})

    def __post_init__(self) -> None:
        if self.problem.range is None:
            raise ValueError("range = None, allowed is a table [range] that says what differs")
        known, settings = self.problem.plant, self.problem.range
        if self.problem.plant_cell is not None or known is None:
            return
        if not isinstance(known, Electrochemical):
            raise ValueError(f"plant {known!r}: a range of use has the cell's circuit or an electrochemical model")
        for name in NOT_ELECTROCHEMICAL:
            if getattr(settings, name):
                raise ValueError(
                    f"range: {name} = {getattr(settings, name):g}, allowed is 0 for an electrochemical plant: it has no circuit"
                )
        if settings.cells:
            raise ValueError(f"range: cells = {settings.cells!r}, allowed is none for an electrochemical plant: it has no circuit")
        # Refused before the first charge is an ambient that the plant may not have.
        for ambient in settings.ambient_K or ():
            replace(known, ambient_K=ambient)

    @property
    def largest_of(self) -> tuple[str, ...]:
        return LARGEST

    def draw(self, count: int, seed: int, scores: NDArray[np.float64] | None = None, *, extreme: float | None = None) -> list[DrawnPlant]:
        """``scores``: what is of each plant (`RangeOfUse.draw`); None: drawn too, or that of the range's one cell."""
        return self.range_of_use.draw(count, seed, scores=self._own_scores if scores is None else scores, extreme=extreme)

    def simulate(self, thetas: Sequence[NDArray[np.float64]], plants: Sequence[DrawnPlant]) -> list[Episode | None]:
        from chargetune.episode.episode import Ending

        return [e.noise_free() if e.ending is Ending.DONE else None for e in self.run(thetas, plants)]

    def run(self, thetas: Sequence[NDArray[np.float64]], plants: Sequence[DrawnPlant], trips: Sequence[Trip] = ()) -> list[Episode]:
        """The episode of each theta on the plant of the same place as it was measured, however it ended; ``trips`` end it."""
        own = [self._theta(theta, one) for theta, one in zip(thetas, plants, strict=True)]
        if self.problem.plant_cell is not None and trips:
            return [replace(self._loop, plant=one.plant).run(theta, one.seed, trips) for theta, one in zip(own, plants, strict=True)]
        if self.problem.plant_cell is not None:
            return self._loop.run_each(own, [one.plant for one in plants], [one.seed for one in plants])
        tasks = [(self.problem, self.plant_of(one), theta, one.seed, tuple(trips)) for theta, one in zip(own, plants, strict=True)]
        if self.executor is None or not tasks:
            return [_stepped(*task) for task in tasks]
        return list(self.executor.map(_stepped, *zip(*tasks, strict=True)))

    def _theta(self, theta: NDArray[np.float64], drawn: DrawnPlant) -> NDArray[np.float64]:
        """The controller's theta in the context of this draw."""
        if self.problem.theta.schedule is None:
            return theta
        told = {name: values[0] for name, values in self.values(drawn).items() if name in ("ambient_K", "age")}
        found = self.problem.theta_in(theta, self.problem.context | told)
        return theta if found is None else found

    def plant_of(self, drawn: DrawnPlant) -> Plant:
        """A new plant of this draw at its start."""
        known, settings = self.problem.plant, self.problem.range
        if not isinstance(known, Electrochemical) or settings is None:
            return drawn.plant
        values, sensors = self.values(drawn), self.problem.sensors.sensors()
        bias = sensors.bias.get("voltage_V", 0.0) + values.get("voltage_bias_V", (0.0,))[0]
        sensors = replace(sensors, bias={**sensors.bias, "voltage_V": bias})
        return electrochemical(known, settings, values).plant(values["soc_start"][0], self.problem.controller.sampling_time_s, sensors)

    def values(self, drawn: DrawnPlant) -> dict[str, tuple[float, ...]]:
        """What was drawn, by names of the settings (fade and growth: age); always soc_start. By node one value a node."""
        start, values = drawn.plant.start, dict(drawn.values)
        if values.pop("ambient", None):
            values["ambient_K"] = (start["temperature_K"],)
        return {**values, "soc_start": (start["soc"],)}

    def score(self, episode: Episode, *, metrics: bool = True) -> Score | None:
        start = float(episode.signal("soc")[0][0])
        try:
            return score_episode(self._exact, episode, metrics=metrics, soc_start=start)
        except NotMeasuredError:
            return None

    def samples(self, episode: Episode) -> dict[str, tuple[NDArray[np.float64], NDArray[np.int_]]]:
        return charge_samples(self._exact, episode)

    @cached_property
    def _own_scores(self) -> NDArray[np.float64] | None:
        """What is of the plant, where the range has one cell."""
        cell = self.problem.range.cell if self.problem.range else None
        return None if cell is None else self.range_of_use.plant_scores(cell)

    @cached_property
    def range_of_use(self) -> RangeOfUse:
        return range_of_use(self.problem, self.problem.range or ChargingRangeSettings())

    @cached_property
    def _loop(self) -> CompiledEpisode:
        from chargetune.episode.compiled import compiled_episode

        return compiled_episode(controller_of(self.problem), self.range_of_use.plant, self.problem.episode.steps)

    @cached_property
    def _exact(self) -> ChargingProblem:
        return judged_exactly(self.problem)


def _stepped(problem: ChargingProblem, plant: Plant, theta: NDArray[np.float64], seed: int, trips: Sequence[Trip]) -> Episode:
    """One charge of a plant that is no circuit."""
    from chargetune.episode.stepwise import run_episode

    controller = controller_of(problem)
    control = compiled_act(controller)
    return run_episode(controller, plant, steps=problem.episode.steps, theta=theta, seed=seed, trips=trips, control=control)
