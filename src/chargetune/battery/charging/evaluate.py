"""One charge of a charging problem, and what it is worth."""

from __future__ import annotations

import os
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from chargetune.battery.cell.equivalent_circuit import ecm_model, start_state
from chargetune.battery.charging.controller import controller_of
from chargetune.battery.charging.problem import ChargingProblem
from chargetune.battery.charging.verdict import NotMeasuredError, score_episode
from chargetune.control.control_step import compiled_act
from chargetune.episode.compiled import CompiledEpisode, compiled_episode
from chargetune.episode.episode import Ending, Episode, Trip
from chargetune.episode.score import Score
from chargetune.episode.stepwise import run_episode
from chargetune.plants.plant import Plant
from chargetune.plants.simulated import SimulatedPlant
from chargetune.runtime.cache import Built

__all__ = ["Evaluation", "evaluate", "outcome", "plant_of", "run_charge", "trips_of"]

_EPISODES = Built(64)


@dataclass(frozen=True)
class Evaluation:
    """What a study runs: ``Evaluation(problem)(theta, seed)`` is `evaluate`. It is data, so a worker process can have it."""

    problem: ChargingProblem

    def __call__(self, theta: NDArray[np.float64], seed: int) -> tuple[Score | None, Episode, str]:
        return evaluate(self.problem, theta, seed)


def evaluate(problem: ChargingProblem, theta: ArrayLike | None, seed: int) -> tuple[Score | None, Episode, str]:
    """One charge at theta, and its `outcome`."""
    return outcome(problem, run_charge(problem, theta, seed))


def outcome(problem: ChargingProblem, episode: Episode, *, soc_start: float | None = None) -> tuple[Score | None, Episode, str]:
    """What a study is told of a charge: (score, episode, ending); no score when the episode did not come to its end.

    ``soc_start``: where the charge began, if not where the problem says.

    Raises KeyboardInterrupt when that is what ended it: a simulation says nothing about theta then, and can be run again.
    """
    if episode.ending is Ending.INTERRUPTED:
        raise KeyboardInterrupt(episode.message)
    if episode.ending is not Ending.DONE:
        return None, episode, f"{episode.ending.value}: {episode.message}"
    try:
        return score_episode(problem, episode, soc_start=soc_start), episode, episode.ending.value
    except NotMeasuredError as error:
        return None, episode, f"{Ending.SENSOR.value}: {error}"


def run_charge(problem: ChargingProblem, theta: ArrayLike | None = None, seed: int = 0) -> Episode:
    """One charge with the controller at theta (None: untuned)."""
    # The variable that chooses the compiler may change while a program runs.
    compiled = _EPISODES.get((problem, os.environ.get("CHARGETUNE_CC")), lambda: _compiled(problem))
    trips, theta = trips_of(problem), problem.theta_in(theta)
    if compiled is not None:
        return compiled.run(theta, seed, trips)
    controller, plant = controller_of(problem), plant_of(problem)
    return run_episode(
        controller, plant, steps=problem.episode.steps, theta=theta, seed=seed, trips=trips, control=compiled_act(controller)
    )


def _compiled(problem: ChargingProblem) -> CompiledEpisode | None:
    """The whole charge as one function, where the plant is a simulated one."""
    plant = plant_of(problem)
    return compiled_episode(controller_of(problem), plant, problem.episode.steps) if isinstance(plant, SimulatedPlant) else None


def plant_of(problem: ChargingProblem) -> Plant:
    """A new plant at its start."""
    start, step, sensors = problem.episode.soc_start, problem.controller.sampling_time_s, problem.sensors.sensors()
    if problem.plant is not None:
        return problem.plant.plant(start, step, sensors)
    return SimulatedPlant(ecm_model(problem.cell, step), start_state(problem.cell, start), sensors)


def trips_of(problem: ChargingProblem) -> tuple[Trip, ...]:
    """What ends an episode at once, whatever the controller does."""
    if problem.safety is None:
        return ()
    margins = {"voltage_max_V": problem.safety.abort_margin_V, "temperature_max_K": problem.safety.abort_margin_K}
    limits = [limit for limit in problem.limits_by_name.values() if margins.get(limit.name) is not None]
    return tuple(Trip(limit.signal, upper=limit.bound + (margins[limit.name] or 0.0)) for limit in limits)
