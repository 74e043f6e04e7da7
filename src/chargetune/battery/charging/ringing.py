"""Whether the observer's loop rings where resistances are other than believed."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chargetune.battery.cell.cell import Cell
from chargetune.battery.cell.equivalent_circuit import ecm_model, start_state
from chargetune.battery.charging.controller import controller_of
from chargetune.battery.charging.observers import Adaptive, OffsetFree
from chargetune.battery.charging.problem import ChargingProblem
from chargetune.checks.finding import Evidence, Finding
from chargetune.episode.compiled import compiled_episode
from chargetune.plants.simulated import SimulatedPlant

__all__ = ["check_ringing"]

# The true resistances over the believed ones: a controller that is wrong by half either way.
RATIOS = (0.5, 2.0)
# A swing of the current is a rise and a fall of this share of its range or more in two intervals; so many in a row are ringing.
SWING, SWINGS = 0.01, 8


def check_ringing(problem: ChargingProblem) -> list[Finding]:
    """A finding where the current swings from sample to sample: on the problem's circuit, and with all resistances at `RATIOS` of it.

    At the voltage limit the loop of the MPC, which asks for dI = -e / R_believed, and of the observer of gain K has the eigenvalue
    1 - K R / R_believed. It is negative, and the current swings, for K R > R_believed; near -1 it rings on.
    """
    if not isinstance(problem.estimator.settings, (OffsetFree, Adaptive)):
        return []
    cells = {"as it is": problem.cell}
    cells |= {f"resistances x {ratio:g} of what is believed": _scaled(problem.controller_cell, ratio) for ratio in RATIOS}
    worst: tuple[int, str, NDArray[np.float64], NDArray[np.float64], float] | None = None
    for name, cell in cells.items():
        # The controller's model and the plant have the same equations, so that one function runs all of them.
        plant = SimulatedPlant(
            ecm_model(cell, problem.controller.sampling_time_s), start_state(cell, problem.episode.soc_start), problem.sensors.sensors()
        )
        run = compiled_episode(controller_of(problem), plant, problem.episode.steps).run(problem.theta_in(problem.theta_values))
        current = run.input[:, 0]
        swings = _swings(current / (problem.current_max_A - problem.limits.current_min_A))
        over = 1e3 * (float(np.max(run.signal("voltage_V", true=True))) - problem.voltage_max_V)
        if swings >= SWINGS and (worst is None or swings > worst[0]):
            worst = swings, name, run.time_s / 60, current, over
    if worst is None:
        return []
    swings, name, minutes, current, over = worst
    return [
        Finding(
            "observer-rings",
            "warning",
            f"the current swings from sample to sample {swings} times in a row ({name}); the voltage is {over:.1f} mV over its limit: "
            "the observer follows the voltage faster than the believed resistances allow",
            "a smaller offset_drift_V or resistance_drift, a larger voltage_sd_V, the observer's defaults, or kind = 'adaptive'",
            {"swings": float(swings), "voltage_over_mV": over},
            Evidence("time (min)", "current (A)", {name: (minutes, current)}),
        )
    ]


def _scaled(cell: Cell, ratio: float) -> Cell:
    changed: dict[str, Any] = {n: tuple(ratio * value for value in getattr(cell, n)) for n in cell.tables if n.startswith("R")}
    return replace(cell, **changed)


def _swings(share: NDArray[np.float64]) -> int:
    """The longest row of turns in which the input changes by `SWING` or more, back and forth."""
    change = np.diff(share)
    turns = (change[1:] * change[:-1] < 0) & (np.minimum(np.abs(change[1:]), np.abs(change[:-1])) >= SWING)
    longest = count = 0
    for turn in turns:
        count = count + 1 if turn else 0
        longest = max(longest, count)
    return longest
