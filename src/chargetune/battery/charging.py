"""The fast-charging problem: a cell as plant, a wrong model in the controller, limits, theta, objective."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from chargetune.battery.cell import Cell, mismatched
from chargetune.battery.ecm import ecm_model
from chargetune.battery.metrics import charging_metrics
from chargetune.control.controller import Controller, SoftLimit, Stage
from chargetune.control.estimators import ExactState, Propagated
from chargetune.episode.compiled import CompiledEpisode, compiled_episode
from chargetune.episode.episode import Ending, Episode
from chargetune.episode.score import Score
from chargetune.model.parameters import Parameter, ParameterSpace
from chargetune.model.splines import natural_spline
from chargetune.plants.sensors import Sensors
from chargetune.plants.simulated import SimulatedPlant

__all__ = ["Backoff", "ChargingProblem", "ResistanceRatio"]


@dataclass(frozen=True)
class Backoff:
    """theta in the set Y: the controller keeps V <= v_max - b(z), b a natural cubic spline on equidistant SOC nodes.

    ``at="measured"`` takes b at the measured z_k for the whole horizon (the paper's text), ``"predicted"`` at each z_i.
    A signed backoff (lower < 0) lets the controller also correct a model that is too pessimistic.
    """

    nodes: int = 7
    lower_V: float = -0.25
    upper_V: float = 0.25
    at: Literal["measured", "predicted"] = "measured"

    def __post_init__(self) -> None:
        if isinstance(self.nodes, bool) or not isinstance(self.nodes, int) or not 2 <= self.nodes <= 50:
            raise ValueError(f"backoff: nodes = {self.nodes!r}, allowed is an integer in [2, 50]")
        _check("backoff: lower_V", self.lower_V, -1.0, 0.0, "V")
        _check("backoff: upper_V", self.upper_V, 0.0, 1.0, "V", open_low=True)
        if self.at not in ("measured", "predicted"):
            raise ValueError(f"backoff: at = {self.at!r}, allowed is 'measured' or 'predicted'")

    @property
    def grid(self) -> NDArray[np.float64]:
        return np.linspace(0.0, 1.0, self.nodes)

    @property
    def parameter(self) -> Parameter:
        return Parameter("backoff_V", self.lower_V, self.upper_V, 0.0, unit="V", size=self.nodes)

    def voltage(self, stage: Stage) -> Any:
        z = stage.now["soc"] if self.at == "measured" else stage.x["soc"]
        return natural_spline(z, self.grid, stage.theta["backoff_V"])


@dataclass(frozen=True)
class ResistanceRatio:
    """theta in the model f and h: the node values of R0 or R1 as ratio to the controller's (wrong) own, log scale."""

    of: Literal["R0", "R1"]
    lower: float = 0.1
    upper: float = 6.0

    def __post_init__(self) -> None:
        if self.of not in ("R0", "R1"):
            raise ValueError(f"resistance ratio: of = {self.of!r}, allowed is 'R0' or 'R1'")
        _check(f"resistance ratio of {self.of}: lower", self.lower, 0.001, 0.999, "")
        _check(f"resistance ratio of {self.of}: upper", self.upper, 1.001, 100.0, "")

    @property
    def name(self) -> str:
        return f"{self.of}_ratio"

    def parameter(self, nodes: int) -> Parameter:
        return Parameter(self.name, self.lower, self.upper, 1.0, scale="log", size=nodes)


@dataclass(frozen=True)
class ChargingProblem:
    """Data of one charging study; it pickles small and evaluates theta anywhere.

    plant_cell is the truth, ``mismatch_seed`` makes the controller's belief of it (None: the belief is the truth).
    ``overpotential``: "model" propagates U1 by the controller's own model, "exact" gives it the plant's.
    Objective of the paper: G = -sum_{k=0..K} c1 (z_d - z_k)^2 - sum_{k<K} max(0, V_k - v_max)^2, V_k the larger of the
    voltages at both ends of interval k. The constrained objective is the mean of -(z_d - z_k)^2 without c1; the
    voltage limits are scored on their own, the upper one also in ``soc_windows`` equal parts of the SOC.
    """

    plant_cell: Cell
    mismatch_seed: int | None = 0
    backoff: Backoff | None = None
    ratios: tuple[ResistanceRatio, ...] = ()
    sampling_time_s: float = 10.0
    horizon: int = 5
    steps: int = 360
    soc_start: float = 0.05
    soc_target: float = 1.0
    current_min_A: float = 0.0
    current_max_A: float | None = None
    voltage_max_V: float | None = None
    voltage_min_V: float | None = None
    overpotential: Literal["model", "exact"] = "model"
    penalty_per_V: float = 1e3
    c1: float = 1e-5
    tolerance_V: float = 5e-4
    soc_windows: int = 5
    sensors: Sensors = field(default_factory=Sensors)

    def __post_init__(self) -> None:
        cell = self.plant_cell
        for name in ("current_max_A", "voltage_max_V", "voltage_min_V"):
            if getattr(self, name) is None:
                object.__setattr__(self, name, getattr(cell, name))
        _check("sampling_time_s", self.sampling_time_s, 1e-3, 3600.0, "s")
        start = _check("soc_start", self.soc_start, 0.0, 1.0, "")
        target = _check("soc_target", self.soc_target, 0.0, 1.0, "")
        least = _check("current_min_A", self.current_min_A, -cell.current_max_A, cell.current_max_A, "A")
        most = _check("current_max_A", self.current_max_A, 0.0, cell.current_max_A, "A", open_low=True)
        highest = _check("voltage_max_V", self.voltage_max_V, cell.voltage_min_V, cell.voltage_max_V, "V", open_low=True)
        lowest = _check("voltage_min_V", self.voltage_min_V, cell.voltage_min_V, cell.voltage_max_V, "V")
        _check("penalty_per_V", self.penalty_per_V, 0.0, 1e9, "", open_low=True)
        _check("c1", self.c1, 0.0, 1.0, "", open_low=True)
        _check("tolerance_V", self.tolerance_V, 0.0, 0.1, "V")
        for name, low, high in (("steps", 1, 1_000_000), ("horizon", 1, 50), ("soc_windows", 1, 50)):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
                raise ValueError(f"{name} = {value!r}, allowed is an integer in [{low}, {high}]")
        seed = self.mismatch_seed
        if seed is not None and (isinstance(seed, bool) or not isinstance(seed, int) or seed < 0):
            raise ValueError(f"mismatch_seed = {seed!r}, allowed is an integer >= 0")
        if self.overpotential not in ("model", "exact"):
            raise ValueError(f"overpotential = {self.overpotential!r}, allowed is 'model' or 'exact'")
        tuned = [ratio.of for ratio in self.ratios]
        if len(set(tuned)) < len(tuned):
            raise ValueError(f"ratios = {tuned}, allowed is each resistance once")
        if least >= most:
            raise ValueError(f"current_min_A = {least:g} must be less than current_max_A = {most:g}")
        if lowest >= highest:
            raise ValueError(f"voltage_min_V = {lowest:g} must be less than voltage_max_V = {highest:g}")
        if target <= start:
            raise ValueError(f"soc_target = {target:g} must be more than soc_start = {start:g}")
        self._check_physics(start, highest)

    def _check_physics(self, start: float, highest: float) -> None:
        cell = self.plant_cell
        resting = float(np.interp(start, cell.ocv_soc, cell.ocv_V))
        if resting >= highest:
            raise ValueError(f"soc_start = {start:g}: the resting voltage {resting:.3f} V is not below voltage_max_V = {highest:g}")
        shortest, least = min(r * c for r, c in zip(cell.R1_ohm, cell.C1_F, strict=True)), self.sampling_time_s / 20
        if shortest < least:
            what = f"sampling_time_s = {self.sampling_time_s:g} s; allowed is at least a twentieth, {least:.3g} s"
            raise ValueError(f"the time constant R1 C1 = {shortest:.3g} s is far below {what}")
        if self.backoff is not None and highest - self.backoff.upper_V <= resting:
            allowed = f"allowed is less than {highest - resting:.3g} V"
            raise ValueError(f"backoff: upper_V = {self.backoff.upper_V:g} V forbids any charging from soc_start; {allowed}")

    @cached_property
    def controller_cell(self) -> Cell:
        """What the untuned controller believes of the cell."""
        return self.plant_cell if self.mismatch_seed is None else mismatched(self.plant_cell, self.mismatch_seed)

    @cached_property
    def space(self) -> ParameterSpace:
        nodes = len(self.plant_cell.soc)
        own = (self.backoff.parameter,) if self.backoff else ()
        return ParameterSpace((*own, *(ratio.parameter(nodes) for ratio in self.ratios)))

    @cached_property
    def controller(self) -> Controller:
        backoff, ratios, limit = self.backoff, self.ratios, self.voltage_max_V

        def cost(stage: Stage) -> Any:
            return (stage.x_d["soc"] - stage.x["soc"]) ** 2

        def highest(stage: Stage) -> Any:
            return limit - backoff.voltage(stage) if backoff else limit

        def believed(stage: Stage) -> dict[str, Any]:
            return {f"{r.of}_ohm": stage.p[f"{r.of}_ohm"] * stage.theta[r.name] for r in ratios}

        # Both models come from the same cell, so that the compiled problem is the same for every mismatch.
        belief = self.controller_cell
        model = ecm_model(self.plant_cell, self.sampling_time_s).with_parameters(
            R0_ohm=belief.R0_ohm, R1_ohm=belief.R1_ohm, C1_F=belief.C1_F
        )
        return Controller.build(
            model,
            self.space,
            horizon=self.horizon,
            stage_cost=cost,
            terminal_cost=cost,
            parameters=believed,
            input_lower={"current_A": self.current_min_A},
            input_upper={"current_A": self.current_max_A or 0.0},
            limits=[SoftLimit("voltage_V", lower=self.voltage_min_V, upper=highest, at="both", penalty=self.penalty_per_V, scale=0.1)],
            fallback={"current_A": max(self.current_min_A, 0.0)},
            setpoint={"soc": self.soc_target},
            start={"soc": self.soc_start},
            estimator=Propagated(("soc",)) if self.overpotential == "model" else ExactState(),
        )

    def __getstate__(self) -> dict[str, Any]:
        # What is derived is made anew where the problem arrives, so that it stays small on its way to a worker.
        return {f.name: getattr(self, f.name) for f in fields(self)}

    @property
    def plant(self) -> SimulatedPlant:
        """A new plant at its start."""
        return SimulatedPlant(ecm_model(self.plant_cell, self.sampling_time_s), {"soc": self.soc_start}, self.sensors)

    def episode(self, theta: ArrayLike | None = None, seed: int = 0) -> Episode:
        """One charge with the controller at theta (None: untuned)."""
        return self._episodes.run(theta, seed)

    @cached_property
    def _episodes(self) -> CompiledEpisode:
        return compiled_episode(self.controller, self.plant, self.steps)

    def score(self, episode: Episode) -> Score:
        """The verdict on what was measured. Raises ValueError when a measurement is not a number."""
        start, end = episode.signal("voltage_V")
        _, soc = episode.signal("soc")
        highest, lowest = np.maximum(start, end), np.minimum(start, end)
        above, below = highest - (self.voltage_max_V or 0.0), (self.voltage_min_V or 0.0) - lowest
        if not (len(soc) and all(np.all(np.isfinite(values)) for values in (start, end, soc))):
            raise ValueError("the episode has no score: a measured voltage or SOC is missing or not finite")
        deficit = (self.soc_target - np.concatenate([[self.soc_start], soc])) ** 2
        over = np.maximum(0.0, above) ** 2
        return Score(
            objective=-float(np.mean(deficit)),
            performance=-float(self.c1 * np.sum(deficit) + np.sum(over)),
            excess={"voltage_max_V": float(np.max(above)), "voltage_min_V": float(np.max(below))},
            tolerance={"voltage_max_V": self.tolerance_V, "voltage_min_V": self.tolerance_V},
            metrics=charging_metrics(episode, self.voltage_max_V or 0.0, self.soc_start),
            profile={"voltage_max_V": _by_window(soc, above, self.soc_windows)},
        )

    def __call__(self, theta: NDArray[np.float64], seed: int) -> tuple[Score | None, Episode, str]:
        """Evaluate theta: (score, episode, ending); no score when the episode did not come to its end."""
        episode = self.episode(theta, seed)
        if episode.ending is not Ending.DONE:
            return None, episode, f"{episode.ending.value}: {episode.message}"
        try:
            return self.score(episode), episode, episode.ending.value
        except ValueError as error:
            return None, episode, f"{Ending.SENSOR.value}: {error}"


def _by_window(soc: NDArray[np.float64], excess: NDArray[np.float64], windows: int) -> tuple[float | None, ...]:
    """The worst excess in each of ``windows`` equal parts of 0..1 in SOC; None where no interval ended."""
    index = np.clip((soc * windows).astype(int), 0, windows - 1)
    return tuple(float(np.max(excess[index == i])) if np.any(index == i) else None for i in range(windows))


def _check(name: str, value: float | None, low: float, high: float, unit: str, *, open_low: bool = False) -> float:
    ok = isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
    if not ok or value is None or not (low < value if open_low else low <= value) or value > high:
        bracket = "(" if open_low else "["
        raise ValueError(f"{name} = {value!r}, allowed is {bracket}{low:g}, {high:g}] {unit}".rstrip())
    return float(value)
