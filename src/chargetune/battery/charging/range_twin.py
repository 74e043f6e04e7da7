"""A charging problem whose cell is learnt from real charges, over its range of use."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from chargetune.battery.charging.charging_range import ChargingRange
from chargetune.battery.charging.controller import controller_of
from chargetune.battery.charging.evaluate import outcome, trips_of
from chargetune.battery.charging.problem import ChargingProblem, stand_in
from chargetune.battery.charging.twin_loop import ChargingTwin
from chargetune.battery.charging.verdict import violation_mVs
from chargetune.episode.episode import Episode
from chargetune.episode.lookup_table import LookupTable
from chargetune.episode.score import Score
from chargetune.plants.range_of_use import DrawnPlant, RangeOfUse
from chargetune.plants.variation import Normal, Variation

if TYPE_CHECKING:
    from chargetune.episode.compiled import CompiledEpisode
    from chargetune.learning.range_of_use.range_twin import Matched
    from chargetune.learning.twin.twin import Twin

__all__ = ["ChargingRangeTwin", "RangeCharge"]


@dataclass(frozen=True)
class ChargingRangeTwin:
    """The `RangeTwinLoop` of a charging problem: circuits of its range of use, of which the cell that is charged is one.

    What is of the cell (resistances, capacitances, capacity, age) is learnt from voltage, temperature and, where it is limited and
    measured, anode potential. The start of each charge is what its controller measured, or estimated, there. Limits that the circuit does
    not have are left out. ``spread``: a plant that is no circuit has none of this range exactly; every entry of every R and C table is
    known up to a factor besides, of which this is the standard deviation of the logarithm.
    """

    # A study's configuration is this problem already, so its identity does not hold it twice.
    problem: ChargingProblem = field(metadata={"identity": False})
    spread: float = 0.0

    def __post_init__(self) -> None:
        if self.problem.range is None:
            raise ValueError("range = None, allowed is a table [range] that says what differs")
        _ = self.use

    @cached_property
    def use(self) -> ChargingRange:
        """Charges of circuits of the whole range: which cell it is that is charged is not known."""
        settings = self.problem.range
        exact = stand_in(self.problem)
        # The controller of a circuit reads the sensors of the problem.
        return ChargingRange(replace(exact, sensors=self.problem.sensors, range=replace(settings, cell=None) if settings else None))

    @cached_property
    def range_of_use(self) -> RangeOfUse:
        """That of ``use``, with what the model is unsure of besides."""
        known = self.use.range_of_use
        if not self.spread:
            return known
        tables = dict.fromkeys(self.use.problem.cell.tables, 1.0)
        return replace(
            known, variations=(*known.variations, Variation("model", Normal(0.0, self.spread), parameters=tables, by_entry=True, log=True))
        )

    @cached_property
    def twin(self) -> Twin:
        from chargetune.learning.range_of_use.range_prior import range_twin

        known = ChargingTwin(self.problem)
        controller = controller_of(self.use.problem)
        read = controller.estimator.signals(controller.model)
        return range_twin(self.range_of_use, read, known.noise_sd, known.error_sd, known.error_at_rest)

    @property
    def features(self) -> Mapping[str, tuple[float, float]]:
        ranges, ambient = dict(ChargingTwin(self.problem).features), self.problem.range.ambient_K if self.problem.range else None
        if ambient and "temperature_K" in ranges:
            low, high = ranges["temperature_K"]
            ranges["temperature_K"] = (min(ambient[0], low), max(ambient[1], high))
        return ranges

    @property
    def largest_of(self) -> tuple[str, ...]:
        return self.use.largest_of

    def draw(self, count: int, seed: int, scores: NDArray[np.float64] | None = None, *, extreme: float | None = None) -> list[DrawnPlant]:
        return self.range_of_use.draw(count, seed, scores=scores, extreme=extreme)

    def simulate(self, thetas: Sequence[NDArray[np.float64]], plants: Sequence[DrawnPlant]) -> list[Episode | None]:
        from chargetune.learning.range_of_use.range_twin import run_drawn

        return run_drawn(self._loop, LookupTable.over(self.features, list(self.twin.noise_sd)), thetas, plants)

    def score(self, episode: Episode, *, metrics: bool = True) -> Score | None:
        return self.use.score(episode, metrics=metrics)

    def samples(self, episode: Episode) -> dict[str, tuple[NDArray[np.float64], NDArray[np.int_]]]:
        return self.use.samples(episode)

    def violation(self, episode: Episode) -> float:
        """Overshoot of the upper voltage limit beyond its tolerance, as judged, over time, mV s."""
        return violation_mVs(self.problem, episode)

    def matched(self, unknowns: NDArray[np.float64]) -> Matched | None:
        """Resistances and capacity in theta are those of the cell, as ratios to what the controller believes."""
        from chargetune.learning.range_of_use.range_twin import parameters_of

        theta, space, belief = self.problem.theta, self.problem.space, self.problem.controller_cell
        known = parameters_of(self.twin, unknowns)
        named: dict[str, NDArray[np.float64]] = {}
        for of, part in theta.ratios.items():
            ratio = known[f"{of}_ohm"] / np.array(getattr(belief, f"{of}_ohm"))
            value = np.exp(np.mean(np.log(ratio))) if part.scale else ratio
            named[part.name(of)] = np.clip(value, part.lower, part.upper)
        if theta.capacity:
            ratio = known["capacity_Ah"] / belief.capacity_Ah
            named["capacity_ratio"] = np.clip(ratio, theta.capacity.lower, theta.capacity.upper)
        if not named:
            return None
        mask, values = np.zeros(space.dimension, dtype=bool), space.default
        for name, value in named.items():
            mask[space.slices[name]], values[space.slices[name]] = True, value
        return values, mask

    @property
    def unpredicted(self) -> tuple[str, ...]:
        """Limits of the problem that the circuit does not predict."""
        return tuple(name for name in self.problem.limits_by_name if name not in self.use.problem.limits_by_name)

    def _loop(self, table: LookupTable | None) -> CompiledEpisode:
        from chargetune.episode.compiled import compiled_episode

        use = self.use
        return compiled_episode(controller_of(use.problem), use.range_of_use.plant, use.problem.episode.steps, lookup_table=table)


@dataclass(frozen=True)
class RangeCharge:
    """What a study of one cell of a range runs: one charge of that cell, in a condition that the trial's seed draws.

    Without ``range.cell`` it is the cell, or the electrochemical plant, as the study file has it.
    """

    problem: ChargingProblem

    def __call__(self, theta: NDArray[np.float64], seed: int) -> tuple[Score | None, Episode, str]:
        use = ChargingRange(self.problem)
        nominal = None if self.problem.range and self.problem.range.cell is not None else use.range_of_use.nominal_scores
        (drawn,) = use.draw(1, seed, nominal)
        (episode,) = use.run([theta], [drawn], trips_of(self.problem))
        return outcome(self.problem, episode, soc_start=drawn.plant.start["soc"])
