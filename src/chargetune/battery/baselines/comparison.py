"""The tuned controller beside what people do today, on the same plant."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future, as_completed
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Protocol, TypeVar

import numpy as np

from chargetune.battery.baselines.charging_protocols import ATTIA_RATES, CurrentLaw, charge, constant_current, four_step, multi_step
from chargetune.battery.charging.evaluate import plant_of, run_charge
from chargetune.battery.charging.problem import ChargingProblem, knowing_the_plant, with_feedback
from chargetune.battery.charging.tunables import Backoff, LimitBackoff, Tunables
from chargetune.battery.charging.verdict import score_episode
from chargetune.battery.plants.steppable import as_steppable
from chargetune.episode.episode import Ending, Episode
from chargetune.episode.score import Score

__all__ = [
    "CCCV",
    "FEEDBACK",
    "STEP_SHARES",
    "ConstantBackoffs",
    "Row",
    "Verdict",
    "chosen_rows",
    "compare",
    "largest_share",
    "plant_oracle",
    "row_names",
    "smallest_that_keep",
]

# CC-CV at the fastest rate with which every limit is kept.
CCCV = "CC-CV that keeps all limits"
# The controller that reads the voltage, before it has learnt anything: what it does is no merit of learning.
FEEDBACK = "nominal offset-free MPC"
# That rate is found to this share of the largest current.
RATE_TOLERANCE = 1 / 64

# Shares of the largest current: of CC-CV, and of five steps in five equal SOC windows.
CCCV_SHARES = (0.25, 0.5, 1.0)
STEP_SHARES = (1.0, 2.5 / 3, 2 / 3, 0.5, 1 / 3)
# By what is limited: the largest constant backoff that is tried, and to what the smallest one is found, both in the unit of the limit.
BACKOFFS = {"voltage": (0.3, 5e-4), "temperature": (5.0, 0.05), "anode": (0.1, 5e-4)}


@dataclass(frozen=True)
class Row:
    """One way of charging: its episode without sensor noise, and the verdict on that. No score where it did not come to its end.

    ``setting``: what was chosen for this plant, such as the rate of CC-CV; empty where nothing was.
    """

    name: str
    episode: Episode
    score: Score | None
    noise: Mapping[str, float]
    setting: str = ""

    @property
    def worst_excess(self) -> dict[str, float | None]:
        """voltage_mV, anode_mV, temperature_K: the worst signed excess of each limit that is set, else None."""
        found = self.score.excess if self.score else {}
        scaled = {"voltage_mV": ("voltage_max_V", 1e3), "anode_mV": ("anode_min_V", 1e3), "temperature_K": ("temperature_max_K", 1.0)}
        return {key: factor * found[name] if name in found else None for key, (name, factor) in scaled.items()}

    @property
    def breaks_limit(self) -> bool:
        """Whether a limit was broken by more than its tolerance and noise, or the charge did not come to its end.

        Noise is one standard deviation of the sensor: a controller that was tuned on noisy measurements knows no better.
        """
        return self.score is None or any(map(self.breaks, self.score.excess))

    def breaks(self, limit: str) -> bool:
        """The same of one limit."""
        return self.score is None or self.score.excess[limit] > self.score.tolerance[limit] + self.noise.get(limit, 0.0)


def row_names(problem: ChargingProblem, theta: Sequence[float] | None) -> list[str]:
    """What can be compared on this plant, in the order of the table."""
    largest = problem.current_max_A
    names = [f"CC-CV {share * largest:.3g} A" for share in CCCV_SHARES]
    names += [CCCV, "multi-step CC", "four-step CC (Attia)", "plant oracle"]
    if as_steppable(plant_of(problem)) is None:
        names = []
    names += ["nominal MPC"]
    if not problem.estimator.follows_offset:
        names.append(FEEDBACK)
    names.append("best constant backoff")
    if problem.plant_cell is not None:
        names.append("MPC with the true model")
    return [*names, *(["tuned"] if theta is not None else [])]


def chosen_rows(names: Sequence[str], wanted: Sequence[str]) -> list[str]:
    """Those of ``names`` that are wanted, in their own order; all where none is named. Raises ValueError for another name."""
    for name in wanted:
        if name not in names:
            raise ValueError(f"--row {name!r}, allowed are {', '.join(map(repr, names))}")
    return [name for name in names if not wanted or name in wanted]


def compare(
    problem: ChargingProblem,
    theta: Sequence[float] | None = None,
    *,
    rows: Sequence[str] = (),
    seed: int = 0,
    executor: Executor | None = None,
) -> Iterator[Row]:
    """Run every row of `row_names`, or the named ones, in the order in which they are done. Raises ValueError for an unknown row.

    CC-CV, step charging and the oracle keep their limits exactly, without sensors: CC-CV and the steps the voltage, the
    oracle every limit. Controllers see the problem's sensors with noise of ``seed``; all are judged without noise.
    """
    names = chosen_rows(row_names(problem, theta), rows)
    if executor is None:
        yield from (_row(problem, name, theta, seed) for name in names)
        return
    tasks: list[Future[Row]] = [executor.submit(_row, problem, name, theta, seed) for name in names]
    yield from (task.result() for task in as_completed(tasks))


def plant_oracle(problem: ChargingProblem) -> Row | None:
    """The charge at the largest current that keeps every limit in each interval; None where an interval of the plant cannot be tried."""
    return _row(problem, "plant oracle", None, 0) if as_steppable(plant_of(problem)) is not None else None


def _row(problem: ChargingProblem, name: str, theta: Sequence[float] | None, seed: int) -> Row:
    largest = problem.current_max_A
    voltage = [problem.limits_by_name["voltage_max_V"]]
    if name == CCCV:
        return _fastest(problem, name, voltage)
    if name.startswith("CC-CV"):
        share = CCCV_SHARES[row_names(problem, theta).index(name)]
        return _stepped(problem, name, constant_current(share * largest), voltage)
    plain = replace(problem, theta=Tunables())
    table: dict[str, Callable[[], Row]] = {
        "multi-step CC": lambda: _stepped(problem, name, multi_step([s * largest for s in STEP_SHARES]), voltage),
        "four-step CC (Attia)": lambda: _stepped(
            problem, name, four_step([s * largest for s in ATTIA_RATES], min(largest, problem.cell.capacity_Ah)), voltage
        ),
        "plant oracle": lambda: _stepped(problem, name, constant_current(largest), list(problem.limits_by_name.values())),
        FEEDBACK: lambda: _judged(plain, name, run_charge(with_feedback(plain), None, seed)),
        "nominal MPC": lambda: _judged(problem, name, run_charge(problem, problem.space.default, seed)),
        "best constant backoff": lambda: _best_backoff(plain, name, seed),
        "MPC with the true model": lambda: _judged(plain, name, run_charge(knowing_the_plant(plain), None, seed)),
        "tuned": lambda: _judged(problem, name, run_charge(problem, theta, seed)),
    }
    return table[name]()


def _fastest(problem: ChargingProblem, name: str, limits: Sequence[object]) -> Row:
    largest = problem.current_max_A

    @cache
    def row(share: float) -> Row:
        return _stepped(problem, name, constant_current(share * largest), limits, f"{share * largest:.3g} A")

    return row(largest_share(lambda share: not row(share).breaks_limit))


def _stepped(problem: ChargingProblem, name: str, law: CurrentLaw, limits: Sequence[object], setting: str = "") -> Row:
    stepped = as_steppable(plant_of(problem))
    if stepped is None:
        raise ValueError(f"{name}: the next interval of this plant cannot be tried")
    episode = charge(
        stepped,
        law,
        limits,  # type: ignore[arg-type]
        steps=problem.episode.steps,
        soc_target=problem.episode.soc_target,
        current_max_A=problem.current_max_A,
    )
    return _judged(problem, name, episode, setting)


def _judged(problem: ChargingProblem, name: str, episode: Episode, setting: str = "") -> Row:
    true = episode.noise_free()
    exact = replace(problem, objective=replace(problem.objective, verdict_samples=1))
    noise = {limit.name: problem.sensors.noise_sd.get(limit.signal, 0.0) for limit in problem.limits_by_name.values()}
    return Row(name, true, score_episode(exact, true) if true.ending is Ending.DONE else None, noise, setting)


def _best_backoff(plain: ChargingProblem, name: str, seed: int) -> Row:
    backoffs = ConstantBackoffs(plain)

    def run(values: Sequence[float]) -> Row:
        return _judged(plain, name, run_charge(backoffs.problem, backoffs.theta(values), seed), backoffs.setting(values))

    return smallest_that_keep(run, backoffs.limits, backoffs.largest, backoffs.tolerances)


@dataclass(frozen=True)
class ConstantBackoffs:
    """A constant backoff of each upper or anode limit that the controller keeps, of the problem without any other theta."""

    plain: ChargingProblem

    @cached_property
    def limits(self) -> tuple[str, ...]:
        """Their names: voltage_max_V, and where they are limits that the controller sees temperature_max_K and anode_min_V."""
        kept = self.plain.limits_by_name
        return tuple(name for name in ("voltage_max_V", "temperature_max_K", "anode_min_V") if name in kept and kept[name].kind != "scored")

    @cached_property
    def of(self) -> tuple[str, ...]:
        """What each is of: voltage, temperature, anode."""
        return tuple(self.plain.limits_by_name[name].of for name in self.limits)

    @property
    def tolerances(self) -> list[float]:
        """To what each is found, in the unit of its limit."""
        return [BACKOFFS[of][1] for of in self.of]

    @property
    def largest(self) -> list[float]:
        """The largest of each; that of the voltage still lets the cell charge."""
        plain = self.plain
        room = plain.voltage_max_V - float(np.interp(plain.episode.soc_start, plain.cell.ocv_soc, plain.cell.ocv_V))
        return [min(BACKOFFS[of][0], 0.9 * room) if of == "voltage" else BACKOFFS[of][0] for of in self.of]

    @cached_property
    def problem(self) -> ChargingProblem:
        """The problem whose theta they are."""
        most = dict(zip(self.of, self.largest, strict=True))

        def margin(of: str) -> LimitBackoff | None:
            return LimitBackoff(0.0, most[of]) if of in most else None

        return replace(
            self.plain,
            theta=Tunables(
                backoff=Backoff(nodes=2, lower_V=0.0, upper_V=most["voltage"]) if "voltage" in most else None,
                temperature_backoff=margin("temperature"),
                anode_backoff=margin("anode"),
            ),
        )

    def theta(self, values: Sequence[float]) -> list[float]:
        """theta of `problem` for one value of each; the voltage's has two nodes."""
        return [value for of, value in zip(self.of, values, strict=True) for _ in range(2 if of == "voltage" else 1)]

    def setting(self, values: Sequence[float]) -> str:
        """The values with their units, for a table."""
        texts = [f"{value:.2f} K" if of == "temperature" else f"{1e3 * value:.1f} mV" for of, value in zip(self.of, values, strict=True)]
        return texts[0] if len(texts) == 1 else ", ".join(f"{of} {text}" for of, text in zip(self.of, texts, strict=True))


class Verdict(Protocol):
    """What is known of a way of charging."""

    @property
    def breaks_limit(self) -> bool: ...

    def breaks(self, limit: str) -> bool: ...


T = TypeVar("T", bound=Verdict)


def largest_share(kept: Callable[[float], bool]) -> float:
    """The largest share in (0, 1] that is kept, by bisection to `RATE_TOLERANCE`; the smallest one tried where none is."""
    low, high = (1.0, 1.0) if kept(1.0) else (0.0, 1.0)
    while high - low > RATE_TOLERANCE:
        middle = (low + high) / 2
        low, high = (middle, high) if kept(middle) else (low, middle)
    return low or high


def smallest_that_keep(
    run: Callable[[Sequence[float]], T], limits: Sequence[str], largest: Sequence[float], tolerances: Sequence[float]
) -> T:
    """The run with the smallest backoff of each limit with which it is kept; with the largest of all where these do not keep every limit.

    Each is the smallest in [0, largest] with which its own limit is kept, to its tolerance, by bisection, the others at 0: they only
    make the charge more careful. Together they have to keep every limit.
    """
    none = run([0.0] * len(limits))
    if not none.breaks_limit:
        return none
    values = [0.0] * len(limits)
    for i, (name, most, tolerance) in enumerate(zip(limits, largest, tolerances, strict=True)):
        if not none.breaks(name):
            continue
        low, high = 0.0, most
        while high - low > tolerance:
            values[i] = (low + high) / 2
            alone = [value if k == i else 0.0 for k, value in enumerate(values)]
            low, high = (values[i], high) if run(alone).breaks(name) else (low, values[i])
        values[i] = high
    best = run(values)
    return run(largest) if best.breaks_limit else best
