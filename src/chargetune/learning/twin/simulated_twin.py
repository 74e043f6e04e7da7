"""Closed loops of a controller on a twin of its plant, for a system of any kind."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from chargetune.control.controller import Controller
from chargetune.episode.compiled import CompiledEpisode, compiled_episode
from chargetune.episode.episode import Ending, Episode
from chargetune.episode.lookup_table import LookupTable
from chargetune.episode.score import Score
from chargetune.episode.score_limits import ScoredLimit, Windows, limit_samples, score_limits, violation
from chargetune.episode.stepwise import check_run, signal_indices
from chargetune.learning.twin.discrepancy import DiscrepancySample, NoDiscrepancy
from chargetune.learning.twin.rollout import parameters, start_state
from chargetune.learning.twin.twin import Twin, Uncertain
from chargetune.learning.twin.twin_loop import Member
from chargetune.model.given import Given, actual, checked_given
from chargetune.model.model import Model
from chargetune.plants.sensors import Sensors
from chargetune.plants.simulated import SimulatedPlant

__all__ = ["DISCREPANCY_SHARE", "SimulatedTwin", "TwinSimulator", "default_features", "default_floor"]

# Plants that are remembered: those that thetas are chosen by, and those that the chosen one is judged by.
PLANTS_KEPT = 256
# By how much a model of a plant is off where it was not measured, as a share of the range of an output: a rule of thumb.
DISCREPANCY_SHARE = 0.01


@dataclass(frozen=True)
class TwinSimulator:
    """Episodes of ``steps`` intervals of ``controller`` on members of ``twin``, as one compiled function.

    ``features``: outputs or inputs, one to three, with their ranges, that the discrepancy is a table over. ``given``: what the controller
    is told, the same in each of them; the plant follows ``twin.given``. ``sensors``: what the estimator reads. An observer follows their
    noise, and with it goes the plant: a limit that is kept without noise may be broken with it. The noise of a member depends on its
    unknowns alone, so that thetas are compared under the same one; only a drawn plant has it (`Member`).
    """

    controller: Controller
    twin: Twin
    features: Mapping[str, tuple[float, float]]
    steps: int
    given: Given | None = None
    sensors: Sensors = field(default_factory=Sensors)

    def __post_init__(self) -> None:
        model, plant = self.twin.model, self._nominal
        names = tuple(dict.fromkeys((*self.controller.given_names, *self.twin.given)))
        told = checked_given(names, self._told, self.steps, self.controller.horizon)
        for name, values in self.twin.given.items():
            if not np.array_equal(actual([told[name]], self.steps).ravel(), np.asarray(values)[: self.steps]):
                raise ValueError(
                    f"twin: given of {name} is not what the plant follows, allowed is one sequence, or forecasts that begin with it"
                )
        check_run(plant, self.steps, 0, ())
        signal_indices(self.controller, plant)
        names = (*model.output_names, *model.input_names)
        for name, (low, high) in self.features.items():
            if name not in names:
                raise ValueError(f"twin: features name {name!r}, allowed are {', '.join(names)}")
            if not -np.inf < low < high < np.inf:
                raise ValueError(f"twin: range of {name} = [{low!r}, {high!r}], allowed are finite numbers, the first one less")
        LookupTable.over(self.features, ())

    def simulate(self, members: Sequence[Member]) -> list[Episode | None]:
        """An episode of each member with its true outputs, None where it did not come to its end.

        The discrepancy and the biases of the unknowns are added to the model's outputs, and so to what the estimator reads.
        """
        noisy = [bool(self._noise) and discrepancy is not None and discrepancy.drawn for _, _, discrepancy in members]
        plants = [self.plant(m, noisy=own) for (_, m, _), own in zip(members, noisy, strict=True)]
        tables = [self._table(unknowns, discrepancy) for _, unknowns, discrepancy in members]
        seeds = [zlib.crc32(unknowns.tobytes()) for _, unknowns, _ in members]
        episodes = self._loop.run_each([theta for theta, _, _ in members], plants, seeds, tables, given=self._told)
        true, rounded = self._lookup_table.true_outputs, any(self.sensors.resolution.values())
        out = (true(e, table) if own or rounded else e for e, table, own in zip(episodes, tables, noisy, strict=True))
        return [episode if episode.ending is Ending.DONE else None for episode in out]

    def plant(self, unknowns: NDArray[np.float64], *, noisy: bool = False) -> SimulatedPlant:
        """The twin's model with the parameters and the start of these unknowns (d,)."""
        # An ensemble goes through many thetas: its plants are made once.
        key = unknowns.tobytes(), noisy
        if key not in self._plants:
            while len(self._plants) >= PLANTS_KEPT:
                self._plants.pop(next(iter(self._plants)))
            model = self.twin.model
            sizes = model.parameter_blocks
            values = np.split(parameters(self.twin, unknowns), np.cumsum(list(sizes.values()))[:-1])
            start = dict(zip(model.state_names, (float(v) for v in start_state(self.twin, unknowns)), strict=True))
            own = model.with_parameters(**dict(zip(sizes, values, strict=True)))
            sensors = replace(self.sensors, noise_sd=self._noise if noisy else {})
            self._plants[key] = replace(self._nominal, model=own, start=start, sensors=sensors)
        return self._plants[key]

    @property
    def _told(self) -> dict[str, ArrayLike]:
        return dict(self.twin.given) | dict(self.given or {})

    @cached_property
    def _plants(self) -> dict[tuple[bytes, bool], SimulatedPlant]:
        return {}

    @cached_property
    def _noise(self) -> dict[str, float]:
        """That of what the estimator reads; of all else it would change nothing."""
        read = self.controller.estimator.signals(self.controller.model)
        return {name: sd for name, sd in self.sensors.noise_sd.items() if name in read and sd > 0}

    @cached_property
    def _nominal(self) -> SimulatedPlant:
        return SimulatedPlant(self.twin.model, self.twin.start, replace(self.sensors, noise_sd={}), given=tuple(self.twin.given))

    @cached_property
    def _loop(self) -> CompiledEpisode:
        return compiled_episode(self.controller, self._nominal, self.steps, lookup_table=self._lookup_table)

    @cached_property
    def _lookup_table(self) -> LookupTable:
        return LookupTable.over(self.features, list(self.twin.noise_sd))

    def _table(self, unknowns: NDArray[np.float64], discrepancy: DiscrepancySample | NoDiscrepancy | None) -> NDArray[np.float64]:
        biases = self.twin.biases(unknowns)
        constants = np.array([biases.get(name, 0.0) for name in self._lookup_table.outputs])[:, None]
        return np.tile(constants, self._lookup_table.size) + (0.0 if discrepancy is None else discrepancy.table)


@dataclass(frozen=True)
class SimulatedTwin:
    """The `TwinLoop` of a controller, a model of its plant and limits: all that `TwinTuner` needs to learn on a system of one's own.

    The verdict is that of `score_limits` with ``limits``, ``objective`` and ``windows``; only the objective is learnt from, so a
    penalty plays no part. Make one with `build`, or with a `Twin` where its numbers are known. ``given``: what the controller is told in
    every trial (prices, references, forecasts), as for `simulate`.
    """

    controller: Controller
    twin: Twin
    features: Mapping[str, tuple[float, float]]
    steps: int
    limits: tuple[ScoredLimit, ...]
    objective: Callable[[Episode], float]
    windows: Windows | None = None
    given: Given | None = None

    def __post_init__(self) -> None:
        outputs = self.twin.model.output_names
        for signal in (*(limit.signal for limit in self.limits), *([self.windows.signal] if self.windows else [])):
            if signal not in outputs:
                raise ValueError(f"twin: a limit or the windows of {signal!r}, allowed are {', '.join(outputs)}")
        TwinSimulator(self.controller, self.twin, self.features, self.steps, self.given)

    @classmethod
    def build(
        cls,
        controller: Controller,
        plant: Model,
        unknowns: Sequence[Uncertain],
        *,
        noise_sd: Mapping[str, float],
        steps: int,
        limits: Sequence[ScoredLimit],
        objective: Callable[[Episode], float],
        features: Mapping[str, tuple[float, float]] | None = None,
        windows: Windows | None = None,
        start: Mapping[str, float] | None = None,
        discrepancy_sd_floor: Mapping[str, float] | None = None,
        given: Given | None = None,
        plant_given: Sequence[str] = (),
    ) -> SimulatedTwin:
        """Make one from a ``plant`` model with its nominal numbers.

        unknowns
            What of these numbers is not known, and how far it may be off. Where it is off by more than that, no margin holds.
        noise_sd
            Of each measured output that is learnt from: a number > 0; what a sensor resolves, where it has no noise.
        features
            What the discrepancy depends on, with ranges. By default the outputs that are limited on both sides, then the inputs, with
            their limits as ranges, the first three of them.
        discrepancy_sd_floor
            By default 1 % of the range of an output, between its two limits or in ``features``, where it has one, and not less than
            its noise; else 3 sd of its noise. A rule of thumb to begin with: the scale of the discrepancy is learnt from how well each
            trial was predicted, from a tenth to ten times of what is stated. State less where the model is the plant but for its
            unknowns, more where physics was left out; with too much, safe mode finds no theta safe, with too little it is too sure.
        given, plant_given
            Given signals of every trial, and the scalar parameters of ``plant`` that follow those of their name, as in `SimulatedPlant`.

        Raises ValueError for what the model does not have, and where there is no range for a feature.
        """
        ranges = dict(features) if features is not None else default_features(controller, limits)
        floor = default_floor(noise_sd, limits, ranges) | dict(discrepancy_sd_floor or {})
        told = checked_given(tuple(dict.fromkeys((*controller.given_names, *plant_given))), given, steps, controller.horizon)
        followed = {name: actual([told[name]], steps).ravel().tolist() for name in plant_given}
        # What is missing in the dynamics goes on when the input is back at 0.
        twin = Twin(plant, tuple(unknowns), dict(noise_sd), dict(start or {}), floor, floor_at_zero_input=1.0, given=followed)
        return cls(controller, twin, ranges, steps, tuple(limits), objective, windows, given)

    def simulate(self, members: Sequence[Member]) -> list[Episode | None]:
        return self._simulator.simulate(members)

    @cached_property
    def _simulator(self) -> TwinSimulator:
        return TwinSimulator(self.controller, self.twin, self.features, self.steps, self.given, Sensors(self.twin.noise_sd))

    def score(self, episode: Episode) -> Score | None:
        return score_limits(episode, self.limits, objective=self.objective, windows=self.windows).score

    def samples(self, episode: Episode) -> dict[str, tuple[NDArray[np.float64], NDArray[np.int_]]]:
        return limit_samples(episode, self.limits, self.windows)

    def violation(self, episode: Episode) -> float:
        """Of all limits the excess beyond the tolerance over time, in tolerances times s, so that different units can be added."""
        return sum(violation(episode, limit) / (limit.tolerance or 1.0) for limit in self.limits)


def default_floor(
    noise_sd: Mapping[str, float], limits: Sequence[ScoredLimit], ranges: Mapping[str, tuple[float, float]] | None
) -> dict[str, float]:
    """By how much an output may be off, as `SimulatedTwin.build` states it."""
    widths = {name: high - low for name, (low, high) in (_two_sided(limits) | dict(ranges or {})).items()}
    return {n: max(sd, DISCREPANCY_SHARE * widths[n]) if n in widths else 3.0 * sd for n, sd in noise_sd.items()}


def default_features(controller: Controller, limits: Sequence[ScoredLimit]) -> dict[str, tuple[float, float]]:
    """Signals that a discrepancy depends on, as `SimulatedTwin.build` states it."""
    ranges = _two_sided(limits) | _input_ranges(controller)
    if not ranges:
        raise ValueError("twin: features = None, allowed is that only where an output is limited on both sides or an input is bounded")
    return dict(list(ranges.items())[:3])


def _two_sided(limits: Sequence[ScoredLimit]) -> dict[str, tuple[float, float]]:
    return {one.signal: (one.lower, one.upper) for one in limits if one.lower is not None and one.upper is not None}


def _input_ranges(controller: Controller) -> dict[str, tuple[float, float]]:
    """The controller's bounds of its inputs, as they are with theta_0 at the start."""
    signals = np.zeros(len(controller.given))
    arguments = controller.theta.default, controller.model.nominal, np.array(controller.start), signals
    low, high = (np.asarray(bound(*arguments), dtype=float).ravel() for bound in (controller.input_lower, controller.input_upper))
    names = controller.model.input_names
    return {n: (float(a), float(b)) for n, a, b in zip(names, low, high, strict=True) if a < b and np.isfinite([a, b]).all()}
