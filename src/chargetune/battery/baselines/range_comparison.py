"""The tuned controller beside what people do today, over a range of use: every way charges the same drawn plants."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, as_completed
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from chargetune.battery.baselines.charging_protocols import CurrentLaw, charge, constant_current, multi_step
from chargetune.battery.baselines.comparison import (
    CCCV,
    FEEDBACK,
    STEP_SHARES,
    ConstantBackoffs,
    chosen_rows,
    largest_share,
    smallest_that_keep,
)
from chargetune.battery.charging.charging_range import ChargingRange
from chargetune.battery.charging.controller import controller_of
from chargetune.battery.charging.limits import Limit
from chargetune.battery.charging.problem import ChargingProblem, knowing_the_plant, with_feedback
from chargetune.battery.charging.tunables import Tunables
from chargetune.battery.plants.steppable import as_steppable
from chargetune.episode.compiled import compiled_episode
from chargetune.episode.episode import Ending, Episode
from chargetune.episode.score import Score
from chargetune.plants.range_of_use import DrawnPlant

__all__ = ["DRAWS", "ORACLE", "STEPS", "RangeRow", "compare_range", "range_row_names"]

# Plants that are charged in every way: means of a time over so many are sure to a per cent, and the oracle takes seconds for each.
DRAWS = 40
ORACLE = "plant oracle"
STEPS = "multi-step CC that keeps all limits"


@dataclass(frozen=True)
class RangeRow:
    """One way of charging: the verdict on each drawn plant, None where the charge did not come to its end.

    ``setting``: what was chosen for this range, such as the rate of CC-CV; empty where nothing was.
    """

    name: str
    scores: tuple[Score | None, ...]
    setting: str = ""

    @property
    def violations(self) -> int:
        """Plants on which a limit was broken by more than its tolerance, or the charge did not come to its end."""
        return sum(score is None or not score.feasible for score in self.scores)

    @property
    def breaks_limit(self) -> bool:
        return self.violations > 0

    def breaks(self, limit: str) -> bool:
        """Whether this limit was broken on a plant, or a charge did not come to its end."""
        return any(score is None or score.excess[limit] > score.tolerance[limit] for score in self.scores)

    def worst_excess(self, limit: str) -> float | None:
        """The largest excess of a limit over the plants."""
        return max((score.excess[limit] for score in self.scores if score is not None), default=None)

    def mean(self, metric: str) -> float | None:
        """Mean of a time over the plants; None where it was not reached on each, since the slow ones would be left out."""
        values = [None if score is None else score.metrics.get(metric) for score in self.scores]
        known = [value for value in values if value is not None]
        return float(np.mean(known)) if known and len(known) == len(values) else None


def range_row_names(problem: ChargingProblem, theta: Sequence[float] | None) -> list[str]:
    """What can be compared over the range, in the order of the table."""
    feedback = [] if problem.estimator.follows_offset else [FEEDBACK]
    names = [CCCV, STEPS, "nominal MPC", *feedback, "best constant backoff", *(["tuned"] if theta is not None else [])]
    return [*names, *(["MPC that knows each plant"] if problem.plant_cell else []), ORACLE]


def compare_range(
    problem: ChargingProblem,
    theta: Sequence[float] | None = None,
    *,
    rows: Sequence[str] = (),
    draws: int = DRAWS,
    seed: int = 0,
    executor: Executor | None = None,
) -> Iterator[RangeRow]:
    """Run every row of `range_row_names`, or the named ones, on the same plants of the range of use, in the order in which they are done.

    CC-CV and the steps, currents in the proportions `STEP_SHARES` in five equal SOC windows, have the fastest rate, and the constant
    backoffs the smallest values, with which every limit is kept on all of the plants; where none does, the most cautious one. CC-CV and
    the steps keep the voltage exactly, the oracle every limit: it knows each plant. Controllers see the problem's sensors with noise; all
    are judged by the true outputs. Raises ValueError without a range, or for an unknown row.
    """
    names = chosen_rows(range_row_names(problem, theta), rows)
    drawn = _Drawn(problem, draws, seed)
    if executor is None:
        yield from (drawn.row(name, theta) for name in names)
        return
    yield from (task.result() for task in as_completed([executor.submit(drawn.row, name, theta) for name in names]))


@dataclass(frozen=True)
class _Drawn:
    """The plants that all rows charge; data, so that a worker process can have it and draws them again."""

    problem: ChargingProblem
    draws: int
    seed: int

    def __post_init__(self) -> None:
        ChargingRange(self.problem)

    @cached_property
    def use(self) -> ChargingRange:
        return ChargingRange(self.problem)

    @cached_property
    def plants(self) -> list[DrawnPlant]:
        """Other ones than those of a tuner, a trial or a certificate."""
        own = np.random.SeedSequence(self.seed, spawn_key=(0, 3)).generate_state(1, np.uint64)
        return self.use.draw(self.draws, int(own[0]) >> 11)

    def row(self, name: str, theta: Sequence[float] | None) -> RangeRow:
        problem = self.problem
        every = list(problem.limits_by_name.values())
        plain, largest = replace(problem, theta=Tunables()), problem.current_max_A
        table: dict[str, Callable[[], RangeRow]] = {
            CCCV: lambda: self._fastest(name, (largest,)),
            STEPS: lambda: self._fastest(name, [share * largest for share in STEP_SHARES]),
            "nominal MPC": lambda: self._controlled(name, problem, problem.space.default),
            FEEDBACK: lambda: self._controlled(name, with_feedback(problem), []),
            "best constant backoff": lambda: self._backoff(name, plain),
            "tuned": lambda: self._controlled(name, problem, np.array(theta)),
            "MPC that knows each plant": lambda: RangeRow(
                name, tuple(self._score(_knowing(knowing_the_plant(plain), one)) for one in self.plants)
            ),
            ORACLE: lambda: RangeRow(name, tuple(self._stepped(one, constant_current(largest), every) for one in self.plants)),
        }
        return table[name]()

    def _score(self, episode: Episode) -> Score | None:
        return self.use.score(episode.noise_free()) if episode.ending is Ending.DONE else None

    def _controlled(self, name: str, problem: ChargingProblem, theta: ArrayLike, setting: str = "") -> RangeRow:
        episodes = ChargingRange(problem).run([np.asarray(theta, dtype=float)] * len(self.plants), self.plants)
        return RangeRow(name, tuple(map(self._score, episodes)), setting)

    def _backoff(self, name: str, plain: ChargingProblem) -> RangeRow:
        backoffs = ConstantBackoffs(plain)

        def run(values: Sequence[float]) -> RangeRow:
            return self._controlled(name, backoffs.problem, backoffs.theta(values), backoffs.setting(values))

        return smallest_that_keep(run, backoffs.limits, backoffs.largest, backoffs.tolerances)

    def _fastest(self, name: str, currents_A: Sequence[float]) -> RangeRow:
        """Constant currents in as many SOC windows, times the largest share with which every limit is kept on all plants, by bisection."""
        voltage = [self.problem.limits_by_name["voltage_max_V"]]
        known: dict[tuple[float, int], Score | None] = {}
        order = list(range(len(self.plants)))

        def score(share: float, i: int) -> Score | None:
            if (share, i) not in known:
                known[share, i] = self._stepped(self.plants[i], multi_step([share * one for one in currents_A]), voltage)
            return known[share, i]

        def kept(share: float) -> bool:
            """The plant that broke a limit last is tried first, since it most likely does so again."""
            for i in list(order):
                found = score(share, i)
                if found is None or not found.feasible:
                    order.remove(i)
                    order.insert(0, i)
                    return False
            return True

        share = largest_share(kept)
        ends = dict.fromkeys((f"{share * currents_A[0]:.3g}", f"{share * currents_A[-1]:.3g}"))
        return RangeRow(name, tuple(score(share, i) for i in range(len(self.plants))), f"{' to '.join(ends)} A")

    def _stepped(self, one: DrawnPlant, law: CurrentLaw, limits: Sequence[Limit]) -> Score | None:
        problem, stepped = self.problem, as_steppable(self.use.plant_of(one))
        if stepped is None:
            raise ValueError("the next interval of this plant cannot be tried")
        steps, target = problem.episode.steps, problem.episode.soc_target
        return self._score(charge(stepped, law, limits, steps=steps, soc_target=target, current_max_A=problem.current_max_A))


def _knowing(plain: ChargingProblem, one: DrawnPlant) -> Episode:
    """The charge of an untuned controller whose model is the drawn cell, from its true start."""
    controller = controller_of(plain)
    start = tuple(one.plant.start.get(name, 0.0) for name in controller.model.state_names)
    knowing = replace(controller, model=controller.model.with_parameters(**dict(one.plant.model.parameters)), start=start)
    return compiled_episode(knowing, one.plant, plain.episode.steps).run(None, one.seed)
