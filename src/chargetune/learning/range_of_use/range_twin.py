"""A range of use that is learnt from: what a twin needs of its loop beside the draws."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from chargetune.control.controller import Controller
from chargetune.episode.compiled import CompiledEpisode, compiled_episode
from chargetune.episode.episode import Ending, Episode
from chargetune.episode.lookup_table import LookupTable
from chargetune.episode.score import Score
from chargetune.episode.score_limits import violation
from chargetune.learning.range_of_use.range_loop import RangeLoop, SimulatedRange
from chargetune.learning.range_of_use.range_prior import range_twin
from chargetune.learning.twin.rollout import parameters
from chargetune.learning.twin.simulated_twin import default_features, default_floor
from chargetune.learning.twin.twin import Twin
from chargetune.learning.twin.twin_loop import ModelledLoop
from chargetune.plants.range_of_use import DrawnPlant, RangeOfUse

__all__ = ["Matched", "RangeTwinLoop", "SimulatedRangeTwin", "parameters_of", "run_drawn"]

Matched = tuple[NDArray[np.float64], NDArray[np.bool_]]
"""A theta, and which of its entries say what the controller's model is."""


class RangeTwinLoop(RangeLoop, ModelledLoop, Protocol):
    """A `RangeLoop` whose plants are those of a `Twin` with the range as its prior (`range_twin`).

    What is of the plant is learnt, what is of the episode is drawn anew.
    """

    def draw(
        self, count: int, seed: int, scores: NDArray[np.float64] | None = None, *, extreme: float | None = None
    ) -> Sequence[DrawnPlant]:
        """As `RangeLoop.draw`; ``scores`` are what is of each plant (`RangeOfUse.draw`)."""
        ...

    def matched(self, unknowns: NDArray[np.float64]) -> Matched | None:
        """The theta with which the controller's model is the plant of these unknowns; None where theta holds nothing of the model."""
        ...

    def violation(self, episode: Episode) -> float:
        """What a measured episode spent of a budget of violation, >= 0."""
        ...


def run_drawn(
    loop: Callable[[LookupTable | None], CompiledEpisode],
    table: LookupTable,
    thetas: Sequence[NDArray[np.float64]],
    plants: Sequence[DrawnPlant],
) -> list[Episode | None]:
    """Each theta on the plant of the same place, with its true outputs; None where it did not come to its end.

    What a plant's ``error`` says of its model is part of what its sensors read, and of its true outputs.
    """
    off = any(one.error is not None for one in plants)
    nothing = np.zeros((len(table.outputs), table.size))
    errors = [(nothing if one.error is None else one.error) for one in plants] if off else [None] * len(plants)
    run = loop(table if off else None)
    episodes = run.run_each(list(thetas), [one.plant for one in plants], [one.seed for one in plants], errors)
    return [table.true_outputs(e, error) if e.ending is Ending.DONE else None for e, error in zip(episodes, errors, strict=True)]


@dataclass(frozen=True)
class SimulatedRangeTwin:
    """The `RangeTwinLoop` of a `SimulatedRange`: what is of the plant is learnt from the outputs whose sensors have noise.

    noise_sd
        Of each measured output that is learnt from, a number > 0; None: those of the plant's sensors.
    features, discrepancy_sd_floor
        As in `SimulatedTwin.build`.
    model_entries
        (parameters of the plant's model by name) -> theta by name, with which the controller's model has them; None: theta holds nothing
        of the model.

    Raises ValueError where nothing is of the plant, no output has noise, or controller or plant have given signals.
    """

    range: SimulatedRange
    noise_sd: Mapping[str, float] | None = None
    features_in: Mapping[str, tuple[float, float]] | None = None
    discrepancy_sd_floor: Mapping[str, float] | None = None
    model_entries: Callable[[Mapping[str, NDArray[np.float64]]], Mapping[str, float | Sequence[float]]] | None = None

    def __post_init__(self) -> None:
        told = (*self.range.controller.given_names, *self.range.range_of_use.plant.given)
        if told:
            raise ValueError(
                f"range twin: given = {', '.join(dict.fromkeys(told))}, allowed is a controller and a plant without given signals"
            )
        _ = self.twin

    @cached_property
    def twin(self) -> Twin:
        use, limits = self.range.range_of_use, self.range.limits
        if not isinstance(use, RangeOfUse):
            raise ValueError("range twin: range_of_use = OwnDraws, allowed is a RangeOfUse, which says what is of the plant")
        sensors = use.plant.sensors.noise_sd
        noise = {name: sd for name, sd in sensors.items() if sd > 0} if self.noise_sd is None else dict(self.noise_sd)
        floor = default_floor(noise, limits, self.features_in) | dict(self.discrepancy_sd_floor or {})
        controller = self.range.controller
        return range_twin(use, controller.estimator.signals(controller.model), noise, floor, 1.0)

    @property
    def features(self) -> Mapping[str, tuple[float, float]]:
        return self.features_in or default_features(self.range.controller, self.range.limits)

    @property
    def controller(self) -> Controller:
        return self.range.controller

    @property
    def largest_of(self) -> tuple[str, ...]:
        return self.range.largest_of

    def draw(self, count: int, seed: int, scores: NDArray[np.float64] | None = None, *, extreme: float | None = None) -> list[DrawnPlant]:
        return self.range.draw(count, seed, scores, extreme=extreme)

    def simulate(self, thetas: Sequence[NDArray[np.float64]], plants: Sequence[DrawnPlant]) -> list[Episode | None]:
        return run_drawn(self._loop, self._table, thetas, plants)

    def score(self, episode: Episode, *, metrics: bool = True) -> Score | None:
        return self.range.score(episode, metrics=metrics)

    def samples(self, episode: Episode) -> dict[str, tuple[NDArray[np.float64], NDArray[np.int_]]]:
        return self.range.samples(episode)

    def violation(self, episode: Episode) -> float:
        """Of all limits the excess beyond the tolerance over time, in tolerances times s."""
        return sum(violation(episode, limit) / (limit.tolerance or 1.0) for limit in self.range.limits)

    def matched(self, unknowns: NDArray[np.float64]) -> Matched | None:
        if self.model_entries is None:
            return None
        space = self.controller.theta
        named = self.model_entries(parameters_of(self.twin, unknowns))
        held = [name for name in space.slices if name in named]
        mask = np.zeros(space.dimension, dtype=bool)
        for name in held:
            mask[space.slices[name]] = True
        return space.from_dict(dict(named)), mask

    @cached_property
    def _table(self) -> LookupTable:
        return LookupTable.over(self.features, list(self.twin.noise_sd))

    def _loop(self, table: LookupTable | None) -> CompiledEpisode:
        return compiled_episode(self.controller, self.range.range_of_use.plant, self.range.steps, lookup_table=table)


def parameters_of(twin: Twin, unknowns: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
    """Parameters of the twin's model at unknowns m, by name."""
    sizes = twin.model.parameter_blocks
    return dict(zip(sizes, np.split(parameters(twin, unknowns), np.cumsum(list(sizes.values()))[:-1]), strict=True))
