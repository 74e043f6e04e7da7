"""The fast-charging problem: a cell as plant, a wrong model in the controller, limits, theta, objective."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from chargetune.battery.cell.cell import Cell, mismatched
from chargetune.battery.cell.equivalent_circuit import ecm_model, overpotentials, start_state
from chargetune.battery.charging.kalman import Kalman
from chargetune.battery.charging.limits import HARD_FACTOR, SIGNALS, Kind, Limit
from chargetune.battery.charging.metrics import charging_metrics, crossing_minutes
from chargetune.battery.charging.tunables import Backoff, CurrentLimit, LimitBackoff, MeasurementSpread, ResistanceRatio
from chargetune.battery.validation import check_count, check_number
from chargetune.control.control_step import compiled_act
from chargetune.control.controller import Controller, SoftLimit, Stage
from chargetune.control.estimators import Estimator, ExactState, Propagated
from chargetune.episode.compiled import CompiledEpisode, compiled_episode
from chargetune.episode.episode import Ending, Episode, Trip
from chargetune.episode.score import Score
from chargetune.episode.stepwise import run_episode
from chargetune.model.parameter_space import ParameterSpace
from chargetune.plants.plant import Plant
from chargetune.plants.sensors import Sensors
from chargetune.plants.simulated import SimulatedPlant

__all__ = ["Backoff", "ChargingProblem", "NotMeasuredError", "PlantModel", "ResistanceRatio", "stand_in"]

# A violation of a limit that is noticed, in its unit: the solver's tolerance is relative to it.
NOTICED = {"voltage": 0.1, "temperature": 1.0, "anode": 0.01}
# The largest of some hundred means is that many standard deviations above the truth.
NOISE_SD = 3.0


class NotMeasuredError(ValueError):
    """An episode has no verdict, because a measurement that it needs is missing or not finite."""


class PlantModel(Protocol):
    """Another plant than the cell's own circuit, as data."""

    def plant(self, soc_start: float, sampling_time_s: float, sensors: Sensors) -> Plant:
        """A new plant at its start; its outputs are among voltage_V, soc, temperature_K, anode_potential_V."""
        ...


@dataclass(frozen=True)
class ChargingProblem:
    """Data of one charging study; it pickles small and evaluates theta anywhere.

    plant_cell is the truth, ``mismatch_seed`` makes the controller's belief of it (None: the belief is the truth); with a
    ``plant_model`` that is the truth, and plant_cell what is known of it.
    ``overpotential``: "model" propagates the overpotentials by the controller's own model from a measured SOC, "exact"
    gives it the plant's; a ``kalman`` filter instead estimates SOC and overpotentials from voltage and current.
    ``soc_start_error`` is what the controller believes of the SOC at the start less the truth.
    Objective of the paper: G = -sum_{k=0..K} c1 (z_d - z_k)^2 - sum_{k<K} max(0, V_k - v_max)^2, V_k the larger of the
    voltages at both ends of interval k. The constrained objective is the mean of -(z_d - z_k)^2 without c1; with
    ``charge_time_to_soc`` z* it is -t/T instead, t the time to z* and T that of the episode, or -(1 + z* - z_K) where the charge
    ends at z_K below z*. Each limit is scored on its own, upper voltage, temperature and anode potential also in ``soc_windows``
    equal parts of the SOC, and as moving mean over ``verdict_samples`` intervals where the signal's sensor has noise: then three
    standard deviations of that mean belong to the tolerance, since they are no violation that was seen.
    ``abort_margin_V`` and ``abort_margin_K`` end an episode as soon as a measured voltage or temperature is so far beyond its
    upper limit: the plant is closed, its current is 0, the trial failed and its trace is kept.
    Limits that the controller's model predicts are kept by it softly; ``hard`` and ``scored_only`` name the exceptions.
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
    plant_model: PlantModel | None = None
    temperature_max_K: float | None = None
    anode_min_V: float | None = None
    tolerance_K: float = 0.05
    tolerance_anode_V: float = 5e-4
    hard: tuple[str, ...] = ()
    scored_only: tuple[str, ...] = ()
    verdict_samples: int = 1
    kalman: Kalman | None = None
    soc_start_error: float = 0.0
    current_limit: CurrentLimit | None = None
    limit_backoffs: tuple[LimitBackoff, ...] = ()
    voltage_spread: MeasurementSpread | None = None
    abort_margin_V: float | None = None
    abort_margin_K: float | None = None
    charge_time_to_soc: float | None = None

    def __post_init__(self) -> None:
        cell = self.plant_cell
        for name in ("current_max_A", "voltage_max_V", "voltage_min_V"):
            if getattr(self, name) is None:
                object.__setattr__(self, name, getattr(cell, name))
        check_number("sampling_time_s", self.sampling_time_s, 1e-3, 3600.0, "s")
        start = check_number("soc_start", self.soc_start, 0.0, 1.0, "")
        target = check_number("soc_target", self.soc_target, 0.0, 1.0, "")
        if self.charge_time_to_soc is not None:
            check_number("charge_time_to_soc", self.charge_time_to_soc, start, 1.0, "", open_low=True)
        least = check_number("current_min_A", self.current_min_A, -cell.current_max_A, cell.current_max_A, "A")
        most = check_number("current_max_A", self.current_max_A, 0.0, cell.current_max_A, "A", open_low=True)
        highest = check_number("voltage_max_V", self.voltage_max_V, cell.voltage_min_V, cell.voltage_max_V, "V", open_low=True)
        lowest = check_number("voltage_min_V", self.voltage_min_V, cell.voltage_min_V, cell.voltage_max_V, "V")
        check_number("penalty_per_V", self.penalty_per_V, 0.0, 1e9, "", open_low=True)
        check_number("c1", self.c1, 0.0, 1.0, "", open_low=True)
        check_number("tolerance_V", self.tolerance_V, 0.0, 0.1, "V")
        for name, largest, unit in (("abort_margin_V", 1.0, "V"), ("abort_margin_K", 50.0, "K")):
            if getattr(self, name) is not None:
                check_number(name, getattr(self, name), 0.0, largest, unit, open_low=True)
        for name, count in (("steps", 1_000_000), ("horizon", 50), ("soc_windows", 50), ("verdict_samples", 1000)):
            check_count(name, getattr(self, name), 1, count)
        seed = self.mismatch_seed
        if seed is not None and (isinstance(seed, bool) or not isinstance(seed, int) or seed < 0):
            raise ValueError(f"mismatch_seed = {seed!r}, allowed is an integer >= 0")
        if self.overpotential not in ("model", "exact"):
            raise ValueError(f"overpotential = {self.overpotential!r}, allowed is 'model' or 'exact'")
        self._check_theta()
        self._check_limits()
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

    def _check_theta(self) -> None:
        tuned, known = [ratio.of for ratio in self.ratios], ("R0", *(f"R{k}" for k in self.plant_cell.pairs))
        if len(set(tuned)) < len(tuned) or not set(tuned) <= set(known):
            raise ValueError(f"ratios = {tuned}, allowed is each resistance once, of {', '.join(known)}")
        of = [part.of for part in self.limit_backoffs]
        kept = {limit.of for limit in self.limits if limit.kind != "scored"}
        if len(set(of)) < len(of) or not set(of) <= kept:
            raise ValueError(f"limit_backoffs = {of}, allowed is each limit once that the controller's model predicts: {sorted(kept)}")
        if self.voltage_spread and not self.kalman:
            raise ValueError("voltage_spread is given without kalman: only a Kalman filter has a spread to tune")

    def _check_limits(self) -> None:
        if self.temperature_max_K is not None:
            check_number("temperature_max_K", self.temperature_max_K, 250.0, 400.0, "K (was it given in degC?)")
        if self.anode_min_V is not None:
            check_number("anode_min_V", self.anode_min_V, -0.5, 0.5, "V")
        check_number("tolerance_K", self.tolerance_K, 0.0, 10.0, "K")
        check_number("tolerance_anode_V", self.tolerance_anode_V, 0.0, 0.1, "V")
        check_number("soc_start_error", self.soc_start_error, -0.5, 0.5)
        check_number("believed SOC at the start (soc_start + soc_start_error)", self.soc_start + self.soc_start_error, 0.0, 1.0)
        names = [limit.name for limit in self.limits]
        for label in ("hard", "scored_only"):
            unknown = sorted(set(getattr(self, label)) - set(names))
            if unknown:
                raise ValueError(f"{label} names {unknown}, allowed are the limits that are set: {', '.join(names)}")
        if self.plant_model is None:
            known = {"voltage": True, "temperature": self.plant_cell.thermal is not None, "anode": self.plant_cell.anode is not None}
            missing = [limit.name for limit in self.limits if not known[limit.of]]
            if missing:
                raise ValueError(f"{missing} cannot be measured on this cell: it has no [thermal] or [anode] table")

    @cached_property
    def limits(self) -> tuple[Limit, ...]:
        """Every limit that is set, in the order of the score."""
        predicted = {"voltage": True, "temperature": self.plant_cell.thermal is not None, "anode": self.plant_cell.anode is not None}
        tolerance = {"voltage": self.tolerance_V, "temperature": self.tolerance_K, "anode": self.tolerance_anode_V}
        out = []
        for name in SIGNALS:
            bound, what = getattr(self, name), name.split("_", maxsplit=1)[0]
            unseen = name in self.scored_only or not predicted[what]
            kind: Kind = "scored" if unseen else "hard" if name in self.hard else "soft"
            if bound is not None:
                out.append(Limit(name, bound, tolerance[what], kind))
        return tuple(out)

    @cached_property
    def controller_cell(self) -> Cell:
        """What the untuned controller believes of the cell."""
        return self.plant_cell if self.mismatch_seed is None else mismatched(self.plant_cell, self.mismatch_seed)

    @cached_property
    def space(self) -> ParameterSpace:
        nodes = len(self.plant_cell.soc)
        parts = (self.backoff, *self.limit_backoffs, self.current_limit, self.voltage_spread)
        own = [part.parameter for part in parts if part]
        ratios = [ratio.parameter(nodes) for ratio in self.ratios]
        return ParameterSpace((*own[:1], *ratios, *own[1:]) if self.backoff else (*ratios, *own))

    @cached_property
    def controller(self) -> Controller:
        largest = self.current_max_A or 0.0

        def cost(stage: Stage) -> Any:
            return (stage.x_d["soc"] - stage.x["soc"]) ** 2

        def believed(stage: Stage) -> dict[str, Any]:
            changed = {f"{r.of}_ohm": stage.p[f"{r.of}_ohm"] * stage.theta[r.name] for r in self.ratios}
            return changed | ({"voltage_sd_V": stage.theta["voltage_sd_V"]} if self.voltage_spread else {})

        def most(stage: Stage) -> Any:
            return largest * self.current_limit.share(stage) if self.current_limit else largest

        # Both models come from the same cell, so that the compiled problem is the same for every mismatch.
        belief = self.controller_cell
        settings = {"voltage_sd_V": self.voltage_spread.default_V} if self.voltage_spread else {}
        model = ecm_model(self.plant_cell, self.sampling_time_s, settings).with_parameters(
            **{name: getattr(belief, name) for name in belief.tables}
        )
        return Controller.build(
            model,
            self.space,
            horizon=self.horizon,
            stage_cost=cost,
            terminal_cost=cost,
            parameters=believed,
            input_lower={"current_A": self.current_min_A},
            input_upper={"current_A": most},
            limits=self._soft_limits(),
            fallback={"current_A": max(self.current_min_A, 0.0)},
            setpoint={"soc": self.soc_target},
            start=start_state(self.plant_cell, self.soc_start + self.soc_start_error),
            estimator=self._estimator(),
        )

    def measured_rows(self, episode: Episode) -> NDArray[np.float64]:
        """By how much the rows of the controller's limits were exceeded on the plant, backoff left out, shape (K, 2, rows)."""
        rows = self._rows
        both = [np.stack(episode.signal(limit.signal), axis=1) for limit in rows]
        return np.stack(
            [values - limit.bound if limit.upper else limit.bound - values for limit, values in zip(rows, both, strict=True)], axis=2
        )

    @property
    def row_tolerances(self) -> NDArray[np.float64]:
        """The excess still called kept of each of these rows, shape (rows,)."""
        return np.array([limit.tolerance for limit in self._rows])

    @property
    def _rows(self) -> list[Limit]:
        """Limits that the controller keeps, in the order of its own; of one signal the upper before the lower."""
        by_signal: dict[str, list[Limit]] = {}
        for limit in self.limits:
            if limit.kind != "scored":
                by_signal.setdefault(limit.signal, []).append(limit)
        return [limit for group in by_signal.values() for limit in sorted(group, key=lambda one: not one.upper)]

    def _soft_limits(self) -> list[SoftLimit]:
        """The limits that the controller sees, upper and lower bound of the same output together."""
        margins: dict[str, Callable[[Stage], Any]] = {part.of: part.margin for part in self.limit_backoffs}
        if self.backoff:
            margins["voltage"] = self.backoff.voltage
        bounds: dict[str, dict[str, Any]] = {}
        for limit in self.limits:
            what = limit.of
            if limit.kind == "scored":
                continue

            def bound(stage: Stage, limit: Limit = limit, what: str = what) -> Any:
                # A backoff of the voltage belongs to its upper limit.
                margin = margins[what](stage) if what in margins and limit.name != "voltage_min_V" else 0.0
                return limit.bound - margin if limit.upper else limit.bound + margin

            simple = what not in margins or limit.name == "voltage_min_V"
            factor = HARD_FACTOR if limit.kind == "hard" else 1.0
            # One unit of any limit's noticed violation costs the same.
            penalty = factor * self.penalty_per_V * NOTICED["voltage"] / NOTICED[what]
            own = bounds.setdefault(limit.signal, {"at": "both", "scale": NOTICED[what], "penalty": penalty})
            own["penalty"] = max(own["penalty"], penalty)
            own["upper" if limit.upper else "lower"] = limit.bound if simple else bound
        return [SoftLimit(signal, **own) for signal, own in bounds.items()]

    def _estimator(self) -> Estimator:
        thermal = ("temperature_K",) if self.plant_cell.thermal else ()
        if self.kalman:
            return self.kalman.estimator(overpotentials(self.plant_cell), thermal=bool(thermal), tuned=self.voltage_spread is not None)
        return Propagated(("soc", *thermal)) if self.overpotential == "model" else ExactState()

    def __getstate__(self) -> dict[str, Any]:
        # What is derived is made anew where the problem arrives, so that it stays small on its way to a worker.
        return {f.name: getattr(self, f.name) for f in fields(self)}

    @property
    def plant(self) -> Plant:
        """A new plant at its start."""
        if self.plant_model is not None:
            return self.plant_model.plant(self.soc_start, self.sampling_time_s, self.sensors)
        cell = self.plant_cell
        return SimulatedPlant(ecm_model(cell, self.sampling_time_s), start_state(cell, self.soc_start), self.sensors)

    def episode(self, theta: ArrayLike | None = None, seed: int = 0) -> Episode:
        """One charge with the controller at theta (None: untuned)."""
        if self._episodes is not None:
            return self._episodes.run(theta, seed, self.trips)
        control = compiled_act(self.controller)
        return run_episode(self.controller, self.plant, steps=self.steps, theta=theta, seed=seed, trips=self.trips, control=control)

    @property
    def trips(self) -> tuple[Trip, ...]:
        """What ends an episode at once, whatever the controller does."""
        out = []
        for limit in self.limits:
            margin = {"voltage_max_V": self.abort_margin_V, "temperature_max_K": self.abort_margin_K}.get(limit.name)
            if margin is not None:
                out.append(Trip(limit.signal, upper=limit.bound + margin))
        return tuple(out)

    @cached_property
    def _episodes(self) -> CompiledEpisode | None:
        plant = self.plant
        return compiled_episode(self.controller, plant, self.steps) if isinstance(plant, SimulatedPlant) else None

    def score(self, episode: Episode, *, metrics: bool = True, soc_start: float | None = None) -> Score:
        """The verdict on what was measured, without figures for people where ``metrics`` is False.

        ``soc_start``: the SOC that the episode began at, where it is not the problem's own.

        Raises NotMeasuredError when a measurement is not a number.
        """
        _, soc = episode.signal("soc")
        measured = [values for limit in self.limits for values in episode.signal(limit.signal)]
        if not (len(soc) and all(np.all(np.isfinite(values)) for values in (*measured, soc))):
            names = ", ".join(dict.fromkeys([*(limit.signal for limit in self.limits), "soc"]))
            raise NotMeasuredError(f"the episode has no score: a measurement of {names} is missing or not finite")
        start = self.soc_start if soc_start is None else soc_start
        deficit = (self.soc_target - np.concatenate([[start], soc])) ** 2
        samples = self.samples(episode)
        over = np.maximum(0.0, self.limits[0].excess(episode)) ** 2
        return Score(
            objective=-float(np.mean(deficit)) if self.charge_time_to_soc is None else self._quickness(start, soc),
            performance=-float(self.c1 * np.sum(deficit) + np.sum(over)),
            excess={name: float(np.max(values)) for name, (values, _) in samples.items()},
            tolerance={limit.name: self.judged(limit)[1] for limit in self.limits},
            metrics=self._metrics(episode, start) if metrics else {},
            profile={name: _by_window(*pair, self.soc_windows) for name, pair in samples.items() if name != "voltage_min_V"},
        )

    def samples(self, episode: Episode) -> dict[str, tuple[NDArray[np.float64], NDArray[np.int_]]]:
        """By limit its excess in every interval, as judged, and the window of the SOC that the interval ends in; 0 without a profile."""
        _, soc = episode.signal("soc")
        window = np.clip((soc * self.soc_windows).astype(int), 0, self.soc_windows - 1)
        return {
            limit.name: (limit.excess(episode, self.judged(limit)[0]), np.zeros_like(window) if limit.name == "voltage_min_V" else window)
            for limit in self.limits
        }

    def _metrics(self, episode: Episode, start: float) -> dict[str, float | None]:
        metrics = charging_metrics(episode, self.voltage_max_V or 0.0, start)
        # The current is an input and bounded hard; that it was is told, but it is nothing to learn.
        metrics["violation_mVs"] = self.violation_mVs(episode)
        metrics["current_max_excess_A"] = float(np.max(episode.input[:, 0]) - (self.current_max_A or 0.0))
        for limit in self.limits[2:]:
            metrics |= limit.metrics(episode)
        return metrics

    def _quickness(self, start: float, soc: NDArray[np.float64]) -> float:
        wanted = self.charge_time_to_soc or 0.0
        time = np.arange(soc.size + 1) / soc.size
        reached = crossing_minutes(60 * time, np.concatenate([[start], soc]), wanted)
        return -float(reached if reached is not None else 1.0 + wanted - soc[-1])

    def charge_time(self, score: Score) -> tuple[str, float | None]:
        """(its name, minutes) of the charging time that is the objective, else of that to 95 % SOC; None where it was not reached."""
        mark = self.charge_time_to_soc or 0.95
        name = f"t{100 * mark:.3g}"
        if f"{name}_min" in score.metrics:
            return name, score.metrics[f"{name}_min"]
        share = -score.objective
        return name, share * self.steps * self.sampling_time_s / 60 if share <= 1.0 else None

    def judged(self, limit: Limit) -> tuple[int, float]:
        """(intervals of the moving mean, excess still called kept): of a noisy signal what `NOISE_SD` sd of that mean may be."""
        noise = self.sensors.noise_sd.get(limit.signal, 0.0)
        samples = self.verdict_samples if noise > 0 else 1
        return samples, limit.tolerance + NOISE_SD * noise / samples**0.5

    def violation_mVs(self, episode: Episode) -> float:
        """Excess of the upper voltage limit beyond its tolerance, in the moving mean of the verdict, over time, mV s.

        An interval of which no sample is left counts as those beside it do, by linear interpolation: a lost sample is no kept
        limit. 0 where nothing at all was measured.
        """
        limit = self.limits[0]
        samples, tolerance = self.judged(limit)
        excess = limit.excess(episode, samples)
        known = np.isfinite(excess)
        if not known.any():
            return 0.0
        at = np.arange(excess.size)
        beyond = np.maximum(0.0, np.interp(at, at[known], excess[known]) - tolerance)
        return float(1e3 * episode.sampling_time_s * np.sum(beyond))

    def __call__(self, theta: NDArray[np.float64], seed: int) -> tuple[Score | None, Episode, str]:
        """Evaluate theta: (score, episode, ending); no score when the episode did not come to its end.

        Raises KeyboardInterrupt when that is what ended it: a simulation says nothing about theta then, and can be run again.
        """
        episode = self.episode(theta, seed)
        if episode.ending is Ending.INTERRUPTED:
            raise KeyboardInterrupt(episode.message)
        if episode.ending is not Ending.DONE:
            return None, episode, f"{episode.ending.value}: {episode.message}"
        try:
            return self.score(episode), episode, episode.ending.value
        except NotMeasuredError as error:
            return None, episode, f"{Ending.SENSOR.value}: {error}"


def _by_window(excess: NDArray[np.float64], window: NDArray[np.int_], windows: int) -> tuple[float | None, ...]:
    """The worst excess in each of so many windows; None where no interval ended."""
    worst = np.full(windows, -np.inf)
    np.maximum.at(worst, window, excess)
    return tuple(None if value == -np.inf else float(value) for value in worst)


def stand_in(problem: ChargingProblem) -> ChargingProblem:
    """The problem on the cell's own circuit with exact sensors: a check runs hundreds of charges and never touches a real plant.

    Limits of signals that the circuit does not have are left out.
    """
    problem = replace(problem, abort_margin_V=None, abort_margin_K=None)
    if problem.plant_model is None:
        return replace(problem, sensors=Sensors(), verdict_samples=1)
    cell = problem.plant_cell
    anode = problem.anode_min_V if cell.anode else None
    warm = problem.temperature_max_K if cell.thermal else None
    absent = {name for name, known in (("anode_min_V", cell.anode), ("temperature_max_K", cell.thermal)) if known is None}
    return replace(
        problem,
        plant_model=None,
        sensors=Sensors(),
        verdict_samples=1,
        anode_min_V=anode,
        temperature_max_K=warm,
        hard=tuple(name for name in problem.hard if name not in absent),
        scored_only=tuple(name for name in problem.scored_only if name not in absent),
    )
