"""How cells of the same kind, their age and their start differ from the one that was tuned on: what a certificate draws."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from chargetune.battery.cell.equivalent_circuit import ecm_model, start_state
from chargetune.battery.charging.controller import controller_of
from chargetune.battery.charging.problem import ChargingProblem, judged_exactly
from chargetune.battery.charging.verdict import NotMeasuredError, score_episode
from chargetune.battery.plants.electrochemical import Electrochemical
from chargetune.battery.validation import check_number
from chargetune.control.control_step import compiled_act
from chargetune.episode.compiled import compiled_episode
from chargetune.episode.episode import Ending, Episode
from chargetune.episode.score import Score
from chargetune.episode.stepwise import run_episode
from chargetune.model.model import Model
from chargetune.plants.simulated import SimulatedPlant

__all__ = ["MEANING", "Draw", "PlantVariation", "Variations"]

MEANING = (
    "The plant differs from the tuned one, the controller does not know it. Each draw is uniform: "
    "SOC at the start +- soc_start (the controller's belief of it moves along); "
    "R0 and each R-C pair's R, over all SOC, times 1 +- resistance; each C times 1 +- capacitance; the capacity times 1 +- capacity; "
    "an age a in [0, 1] takes the share a fade of the capacity and adds a growth to all resistances; sensor noise from a fresh seed. "
    "Of an electrochemical plant vary the ohmic resistance (not below the set's own) and the capacity."
)


@dataclass(frozen=True)
class Draw:
    """One episode's plant: SOC at the start, noise seed, age, and the factors on the plant's parameters by name."""

    soc_start: float
    seed: int
    age: float
    factors: Mapping[str, float]


@dataclass(frozen=True)
class PlantVariation:
    """Half widths of what is drawn uniformly, relative except for the SOC; ``fade`` and ``growth`` at full age.

    The defaults are the scatter of new cells of one make and the first few hundred cycles. See `MEANING`.
    """

    soc_start: float = 0.03
    resistance: float = 0.05
    capacitance: float = 0.05
    capacity: float = 0.02
    fade: float = 0.05
    growth: float = 0.10

    def __post_init__(self) -> None:
        most = {"soc_start": 0.5, "resistance": 0.9, "capacitance": 0.9, "capacity": 0.5, "fade": 0.5, "growth": 2.0}
        for part in fields(self):
            check_number(f"spread: {part.name}", getattr(self, part.name), 0.0, most[part.name])

    def draw(self, problem: ChargingProblem, seed: int, index: int) -> Draw:
        """Draw ``index`` of a certificate with this seed; independent of every seed that a study gives its trials."""
        # A study's trials have spawn keys of one number.
        stream = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(index, 1)))
        noise = int(stream.integers(2**53))
        shift, age = stream.uniform(-self.soc_start, self.soc_start), float(stream.uniform())
        factors = {}
        for name in (*problem.cell.tables, "capacity_Ah"):
            width = self.capacity if name == "capacity_Ah" else self.capacitance if name.startswith("C") else self.resistance
            factors[name] = float(1.0 + stream.uniform(-width, width))
            if name == "capacity_Ah":
                factors[name] *= 1.0 - self.fade * age
            elif name.startswith("R"):
                factors[name] *= 1.0 + self.growth * age
        return Draw(float(np.clip(problem.episode.soc_start + shift, 0.0, problem.episode.soc_target - 0.01)), noise, age, factors)


@dataclass(frozen=True)
class Variations:
    """Episodes of one controller on drawn plants. The circuit's are quick: its model and the controller are built once."""

    problem: ChargingProblem

    def __post_init__(self) -> None:
        other = self.problem.plant
        if other is not None and not isinstance(other, Electrochemical):
            raise ValueError(f"plant {other!r}: allowed are the cell's circuit and an electrochemical model")

    @cached_property
    def model(self) -> Model:
        """The circuit whose parameters are drawn."""
        return ecm_model(self.problem.cell, self.problem.controller.sampling_time_s)

    def run(self, draw: Draw, theta: ArrayLike) -> tuple[Score | None, Episode]:
        """One charge on the drawn plant and the verdict on its true outputs; no score when it did not come to its end."""
        problem, factors, known, step = self.problem, draw.factors, self.problem.plant, self.problem.controller.sampling_time_s
        sensors = problem.sensors.sensors()
        # What the controller believes moves along, and is a SOC, however wrong it is.
        believed = start_state(problem.cell, min(max(draw.soc_start + problem.estimator.soc_start_error, 0.0), 1.0))
        names = controller_of(problem).model.state_names
        controller = replace(controller_of(problem), start=tuple(believed.get(name, 0.0) for name in names))
        if isinstance(known, Electrochemical):
            resistance = max(1.0, known.resistance_scale * factors["R0_ohm"])
            other = replace(known, resistance_scale=resistance, capacity_scale=known.capacity_scale * factors["capacity_Ah"])
            drawn = other.plant(draw.soc_start, step, sensors)
            control = compiled_act(controller)
            episode = run_episode(controller, drawn, steps=problem.episode.steps, theta=theta, seed=draw.seed, control=control)
        else:
            nominal = dict(self.model.parameters)
            scaled = {name: np.array(nominal[name]) * factor for name, factor in factors.items()}
            plant = SimulatedPlant(self.model.with_parameters(**scaled), start_state(problem.cell, draw.soc_start), sensors)
            episode = compiled_episode(controller, plant, problem.episode.steps).run(theta, draw.seed)
        if episode.ending is not Ending.DONE:
            return None, episode
        # Judged is the problem as it stands: one that began at the drawn SOC may be a problem that nobody may state, a cell at rest
        # above its limit for one, and is an episode all the same.
        try:
            return score_episode(judged_exactly(problem), episode.noise_free(), soc_start=draw.soc_start), episode
        except NotMeasuredError:
            return None, episode
