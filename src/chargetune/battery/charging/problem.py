"""The fast-charging problem: a cell as plant, a wrong model in the controller, limits, theta, objective."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from chargetune.battery.cell.cell import Cell, mismatched
from chargetune.battery.charging.kalman import Kalman
from chargetune.battery.charging.limits import Limit, LimitSettings
from chargetune.battery.charging.observers import settings_of
from chargetune.battery.charging.population import check_population
from chargetune.battery.charging.range_settings import ChargingRangeSettings
from chargetune.battery.charging.settings import (
    ControllerSettings,
    EpisodeSettings,
    EstimatorSettings,
    Objective,
    SafetySettings,
    SensorSettings,
)
from chargetune.battery.charging.tunables import Tunables
from chargetune.battery.plants.circuit import Circuit
from chargetune.battery.validation import check_count, check_number
from chargetune.model.parameter_space import ParameterSpace
from chargetune.plants.plant import Plant
from chargetune.plants.sensors import Sensors
from chargetune.runtime.cache import built_once

__all__ = ["ChargingProblem", "PlantModel", "judged_exactly", "knowing_the_plant", "stand_in", "with_feedback"]


class PlantModel(Protocol):
    """Another plant than the cell's own circuit, as data that can be hashed, such as a frozen dataclass."""

    def plant(self, soc_start: float, sampling_time_s: float, sensors: Sensors) -> Plant:
        """A new plant at its start; its outputs are among voltage_V, soc, temperature_K, anode_potential_V."""
        ...


@dataclass(frozen=True)
class ChargingProblem:
    """Data of one charging study, one field for each table of its file: it pickles small and is compared by its content.

    ``cell`` is the truth, and ``controller.mismatch_seed`` makes the controller's belief of it (None: the belief is the truth); with
    a ``plant`` that is the truth, and the cell what is known of it. Each field checks itself; here is checked what concerns
    more than one. Raises ValueError naming field, value and what is allowed.
    """

    cell: Cell
    plant: PlantModel | None = None
    controller: ControllerSettings = field(default_factory=ControllerSettings)
    estimator: EstimatorSettings = field(default_factory=EstimatorSettings)
    limits: LimitSettings = field(default_factory=LimitSettings)
    episode: EpisodeSettings = field(default_factory=EpisodeSettings)
    sensors: SensorSettings = field(default_factory=SensorSettings)
    objective: Objective = field(default_factory=Objective)
    theta: Tunables = field(default_factory=Tunables)
    safety: SafetySettings | None = None
    range: ChargingRangeSettings | None = None
    range_cells: tuple[Cell, ...] = ()
    """The cells of the files in the folder ``range.cells``."""

    def __post_init__(self) -> None:
        try:
            hash(self.plant)
        except TypeError as error:
            raise ValueError(f"plant = {self.plant!r}, allowed is data that can be hashed, such as a frozen dataclass: {error}") from error
        if self.objective.charge_time_to_soc is not None:
            start, most, span = self.episode.soc_start, self.episode.soc_target, "from episode.soc_start to soc_target"
            check_number("objective.charge_time_to_soc", self.objective.charge_time_to_soc, start, most, span, open_low=True)
        check_count("objective.verdict_samples", self.objective.verdict_samples, 1, self.episode.steps)
        believed = self.episode.soc_start + self.estimator.soc_start_error
        check_number("believed SOC at the start (soc_start + soc_start_error)", believed, 0.0, 1.0)
        self._check_bounds()
        self._check_theta()
        self._check_physics()
        self._check_range()

    def _check_bounds(self) -> None:
        cell = self.cell
        each = " per cell of the pack" if cell.pack_line else ""
        least = check_number("limits.current_min_A", self.limits.current_min_A, -cell.current_max_A, cell.current_max_A, f"A{each}")
        most = check_number("limits.current_max_A", self.current_max_A, 0.0, cell.current_max_A, f"A{each}", open_low=True)
        highest = check_number(
            "limits.voltage_max_V", self.voltage_max_V, cell.voltage_min_V, cell.voltage_max_V, f"V{each}", open_low=True
        )
        lowest = check_number("limits.voltage_min_V", self.voltage_min_V, cell.voltage_min_V, cell.voltage_max_V, f"V{each}")
        if least >= most:
            raise ValueError(f"limits.current_min_A = {least:g} must be less than current_max_A = {most:g}")
        if lowest >= highest:
            raise ValueError(f"limits.voltage_min_V = {lowest:g} must be less than voltage_max_V = {highest:g}")
        if self.plant is None:
            known = {"voltage": True, "temperature": cell.thermal is not None, "anode": cell.anode is not None}
            missing = [limit.name for limit in self.limits_by_name.values() if not known[limit.of]]
            if missing:
                raise ValueError(f"{missing} cannot be measured on this cell: it has no [thermal] or [anode] table")
        elif isinstance(self.plant, Circuit):
            self._check_plant_cell(self.plant.cell)

    def _check_plant_cell(self, plant: Cell) -> None:
        """Whether the plant's circuit measures what the controller reads and what is limited."""
        named = f"plant: the cell {plant.name!r}"
        for table, limit in (("thermal", "temperature_max_K"), ("anode", "anode_min_V")):
            if getattr(plant, table) is None and limit in self.limits_by_name:
                raise ValueError(f"{named} has no table [{table}], and limits.{limit} = {self.limits_by_name[limit].bound:g} is of it")
        if plant.thermal is None and self.cell.thermal is not None:
            raise ValueError(f"{named} has no table [thermal], and the controller's cell has one: it reads the temperature")
        if self.estimator.kind == "exact" and not set(self.cell.pairs) <= set(plant.pairs):
            raise ValueError(
                f"{named} has {len(plant.pairs)} R-C pairs; with estimator.kind = 'exact' allowed are at least the "
                f"{len(self.cell.pairs)} of the controller's cell"
            )
        if (plant.series, plant.parallel) not in ((1, 1), (self.cell.series, self.cell.parallel)):
            raise ValueError(
                f"{named} is in a pack of {plant.series}s{plant.parallel}p, allowed is that of the controller's cell, "
                f"{self.cell.series}s{self.cell.parallel}p"
            )
        resting, highest = float(np.interp(self.episode.soc_start, plant.ocv_soc, plant.ocv_V)), self.voltage_max_V
        if resting >= highest:
            raise ValueError(
                f"{named} rests at {resting:.3f} V at soc_start = {self.episode.soc_start:g}, allowed is below voltage_max_V = {highest:g}"
            )

    def _check_theta(self) -> None:
        theta, known = self.theta, ("R0", *(f"R{k}" for k in self.cell.pairs))
        if not set(theta.ratios) <= set(known):
            raise ValueError(f"theta has ratios of {', '.join(theta.ratios)}, allowed are those of this cell: {', '.join(known)}")
        kept = {limit.of for limit in self.limits_by_name.values() if limit.kind != "scored"}
        if not set(theta.limit_backoffs) <= kept:
            of = [f"{name}_backoff" for name in theta.limit_backoffs]
            raise ValueError(
                f"theta has {', '.join(of)}, allowed is one of each limit that the controller's model predicts: {', '.join(sorted(kept))}"
            )
        if theta.voltage_sd is not None:
            if not isinstance(self.estimator.settings, Kalman):
                raise ValueError("theta.voltage_sd is given without estimator.kalman: only a Kalman filter has a spread to tune")
            own = self.estimator.settings.voltage_sd_V
            check_number(
                "estimator.kalman: voltage_sd_V", own, theta.voltage_sd.lower_V, theta.voltage_sd.upper_V, "V (what theta.voltage_sd spans)"
            )

        ramp = self.controller.current_ramp_A_s
        if theta.current_ramp is not None:
            low, high = theta.current_ramp.lower_A_s, theta.current_ramp.upper_A_s
            if ramp is None:
                raise ValueError(
                    "theta.current_ramp is given without controller.current_ramp_A_s, allowed is the untuned ramp there, "
                    f"in [{low:g}, {high:g}] A/s"
                )
            check_number("controller: current_ramp_A_s", ramp, low, high, "A/s (what theta.current_ramp spans)")
        numbers = self._observer_numbers
        for part in theta.observer:
            if part.name not in numbers or isinstance(self.estimator.settings, Kalman):
                raise ValueError(
                    f"theta.observer names {part.name!r}, allowed are numbers of the estimator of kind {self.estimator.kind!r}: "
                    f"{', '.join(numbers) or '(none)'}"
                )
            # The unit is the last word of most names.
            unit = next((f"{unit} " for unit in ("V", "K") if part.name.endswith(f"_{unit}")), "")
            name = f"estimator.{self.estimator.kind}: {part.name}"
            check_number(name, numbers[part.name], part.lower, part.upper, f"{unit}(what theta.observer spans)")

        thermal, adaptive = self.cell.thermal is not None, self.estimator.kind == "adaptive"
        for name, over in theta.over.items():
            over.check(f"theta.{name}", thermal=thermal, adaptive=adaptive)
        if theta.schedule is not None:
            if theta.schedule.ambient_K and not thermal:
                raise ValueError(
                    f"theta.schedule: ambient_K = {list(theta.schedule.ambient_K)}, allowed only for a cell with a [thermal] table"
                )
            theta.schedule.schedule.shares(self.context)
            _ = self.space

    def _check_physics(self) -> None:
        cell, start, highest, backoff = self.cell, self.episode.soc_start, self.voltage_max_V, self.theta.backoff
        resting = float(np.interp(start, cell.ocv_soc, cell.ocv_V))
        if resting >= highest:
            raise ValueError(f"soc_start = {start:g}: the resting voltage {resting:.3f} V is not below voltage_max_V = {highest:g}")
        step = self.controller.sampling_time_s
        shortest, least = min(r * c for r, c in zip(cell.R1_ohm, cell.C1_F, strict=True)), step / 20
        if shortest < least:
            what = f"sampling_time_s = {step:g} s; allowed is at least a twentieth, {least:.3g} s"
            raise ValueError(f"the time constant R1 C1 = {shortest:.3g} s is far below {what}")
        if backoff is not None and highest - backoff.upper_V <= resting:
            allowed = f"allowed is less than {highest - resting:.3g} V"
            raise ValueError(f"backoff: upper_V = {backoff.upper_V:g} V forbids any charging from soc_start; {allowed}")

    def _check_range(self) -> None:
        if self.range is None:
            return
        if self.range.cells:
            check_population(self.plant_cell or self.cell, self.range_cells, self.range.cells)
        if self.range.ambient_K is not None and (self.plant_cell or self.cell).thermal is None:
            raise ValueError(f"range: ambient_K = {list(self.range.ambient_K)}, allowed only for a cell with a [thermal] table")
        if self.theta.schedule is not None:
            if self.range.ambient_K is not None:
                self.theta.schedule.check_span("ambient_K", self.range.ambient_K)
            if self.range.fade or self.range.growth:
                self.theta.schedule.check_span("age", (0.0, 1.0))
        highest = self.range.soc_start[1] if self.range.soc_start else 0.0
        wanted = self.objective.charge_time_to_soc or self.episode.soc_target
        if highest >= wanted:
            raise ValueError(
                f"range: soc_start = {list(self.range.soc_start or ())}, allowed is less than the SOC that is charged to, {wanted:g}"
            )

    @property
    def current_max_A(self) -> float:
        """The largest current: the problem's own, else the cell's."""
        return self.cell.current_max_A if self.limits.current_max_A is None else self.limits.current_max_A

    @property
    def voltage_max_V(self) -> float:
        """The upper voltage limit: the problem's own, else the cell's."""
        return self.limits_by_name["voltage_max_V"].bound

    @property
    def voltage_min_V(self) -> float:
        """The lower voltage limit: the problem's own, else the cell's."""
        return self.limits_by_name["voltage_min_V"].bound

    @cached_property
    def limits_by_name(self) -> dict[str, Limit]:
        """Every limit that is set, in the order of the score: voltage_max_V, voltage_min_V, temperature_max_K, anode_min_V."""
        return self.limits.by_name(self.cell)

    @property
    def plant_cell(self) -> Cell | None:
        """The cell whose circuit is the plant: the problem's own, or that of a `Circuit`; None for any other plant."""
        if self.plant is None:
            return self.cell
        return self.plant.cell if isinstance(self.plant, Circuit) else None

    @property
    def plant_line(self) -> str:
        """What the plant is, in words."""
        return "its own circuit, simulated" if self.plant is None else str(getattr(self.plant, "line", self.plant))

    @property
    def setting_lines(self) -> list[str]:
        """What is not the usual case of one cell on its own circuit, in words: the plant, the pack."""
        return [*([f"plant: {self.plant_line}"] if self.plant else []), *([self.cell.pack_line] if self.cell.pack_line else [])]

    @property
    def controller_cell(self) -> Cell:
        """What the untuned controller believes of the cell."""
        seed = self.controller.mismatch_seed
        return self.cell if seed is None else mismatched(self.cell, seed)

    @property
    def space(self) -> ParameterSpace:
        """The space of theta."""
        return _space(self.theta, len(self.cell.soc), tuple(self._observer_numbers.items()), self.controller.current_ramp_A_s)

    @property
    def base_space(self) -> ParameterSpace:
        """The space of the theta of one context: that of the controller."""
        return _base_space(self.theta, len(self.cell.soc), tuple(self._observer_numbers.items()), self.controller.current_ramp_A_s)

    @property
    def context(self) -> dict[str, float]:
        """What is known of the study's own charge before it begins."""
        thermal = (self.plant_cell or self.cell).thermal
        ambient = getattr(self.plant, "ambient_K", None) or (thermal.ambient_K if thermal else None)
        return {"age": 0.0} | ({} if ambient is None else {"ambient_K": ambient})

    def theta_in(self, theta: ArrayLike | None, context: Mapping[str, float] | None = None) -> NDArray[np.float64] | None:
        """The controller's theta in a context (None: the study's own), by the schedule if there is one; None is untuned.

        Raises ValueError for a context outside the schedule.
        """
        settings = self.theta.schedule
        if theta is None or settings is None:
            return None if theta is None else np.asarray(theta, dtype=np.float64)
        return settings.schedule.theta(self.base_space, theta, self.context if context is None else context)

    @property
    def _observer_numbers(self) -> dict[str, float]:
        """The filter's numbers that theta may set, by name."""
        observer = self.estimator.settings
        if isinstance(observer, Kalman):
            return {"voltage_sd_V": observer.voltage_sd_V}
        return {} if observer is None else settings_of(observer)

    @property
    def theta_values(self) -> NDArray[np.float64]:
        """theta as ``theta.values`` gives it; what they do not name is untuned."""
        return self.space.from_dict(dict(self.theta.values))

    @property
    def safe_start(self) -> NDArray[np.float64] | None:
        """The theta that is declared safe, None where none is."""
        start = self.safety.start if self.safety else None
        return None if start is None else self.space.from_dict(dict(start))


@built_once(64)
def _space(theta: Tunables, nodes: int, observer: tuple[tuple[str, float], ...], ramp_A_s: float | None) -> ParameterSpace:
    return theta.space(nodes, dict(observer), ramp_A_s)


@built_once(64)
def _base_space(theta: Tunables, nodes: int, observer: tuple[tuple[str, float], ...], ramp_A_s: float | None) -> ParameterSpace:
    return theta.base_space(nodes, dict(observer), ramp_A_s)


def with_feedback(problem: ChargingProblem) -> ChargingProblem:
    """The same problem, untuned, with the observer that reads the voltage (`OffsetFree`) instead of its own."""
    return replace(problem, estimator=EstimatorSettings(kind="offset_free"), theta=Tunables(), safety=None)


def knowing_the_plant(problem: ChargingProblem) -> ChargingProblem:
    """The same problem, untuned, with a controller whose model is the plant's circuit (`ChargingProblem.plant_cell`); limits stay."""
    own, cell = problem.cell, problem.plant_cell or problem.cell
    # The limits are of the controller's cell; those of the plant's file were never in force.
    names = ("current_max_A", "voltage_min_V", "voltage_max_V", "series", "parallel")
    known = cell if cell is own else replace(cell, **{name: getattr(own, name) for name in names})
    believed = replace(problem.controller, mismatch_seed=None)
    return replace(problem, cell=known, plant=None, controller=believed, theta=Tunables())


def judged_exactly(problem: ChargingProblem) -> ChargingProblem:
    """The problem with sensors that have no error, so that each sample of the true outputs is judged by itself."""
    return replace(problem, sensors=SensorSettings(), objective=replace(problem.objective, verdict_samples=1))


def stand_in(problem: ChargingProblem) -> ChargingProblem:
    """The problem on the cell's own circuit with exact sensors: a check runs hundreds of charges and never touches a real plant.

    Its ambient is that of the plant. Limits of signals that the circuit does not have are left out.
    """
    problem = replace(judged_exactly(problem), safety=None, range=None)
    if problem.plant is None:
        return problem
    cell, limits = problem.cell, problem.limits
    absent = {name for name, known in (("anode_min_V", cell.anode), ("temperature_max_K", cell.thermal)) if known is None}
    limits = replace(
        limits,
        anode_min_V=limits.anode_min_V if cell.anode else None,
        temperature_max_K=limits.temperature_max_K if cell.thermal else None,
        hard=tuple(name for name in limits.hard if name not in absent),
        scored_only=tuple(name for name in limits.scored_only if name not in absent),
    )
    ambient, plant = problem.context.get("ambient_K"), None
    if cell.thermal and ambient is not None and ambient != cell.thermal.ambient_K:
        plant = Circuit(replace(cell, thermal=replace(cell.thermal, ambient_K=ambient)))
    return replace(problem, plant=plant, limits=limits)
