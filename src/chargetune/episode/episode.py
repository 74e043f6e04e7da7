"""Episode: one closed loop, step by step on any plant."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from chargetune.control.controller import Controller
from chargetune.control.mpc import act, begin
from chargetune.control.sqp import SolveStatus
from chargetune.plants.plant import Measurement, Plant, PlantError

__all__ = ["Ending", "Episode", "Trip", "run_episode", "signal_indices"]


class Ending(StrEnum):
    """Why an episode ended."""

    DONE = "done"
    LIMIT = "limit trip"
    SOLVER = "solver"
    SENSOR = "sensor"
    PLANT = "plant"
    INTERRUPTED = "interrupted"


@dataclass(frozen=True)
class Trip:
    """Ends the episode once a measured output leaves [lower, upper], independently of the controller."""

    signal: str
    lower: float = -np.inf
    upper: float = np.inf

    def __post_init__(self) -> None:
        if not self.lower < self.upper:
            raise ValueError(f"trip of {self.signal}: lower = {self.lower} must be less than upper = {self.upper}")


@dataclass(frozen=True)
class Episode:
    """Arrays of K intervals. Outputs have two samples in each: just after the input jumped and just before it jumps again.

    time_s (K,): start of the interval; input (K, nu); output_start, output_end (K, ny): as measured;
    true_start, true_end (K, ny) and state (K+1, nx): for simulations; estimate (K, nx of the controller's model);
    status (K,): `SolveStatus`; kkt (K,): residual of the solve; iterations (K,).
    """

    sampling_time_s: float
    input_names: tuple[str, ...]
    output_names: tuple[str, ...]
    input_units: tuple[str, ...]
    output_units: tuple[str, ...]
    estimate_names: tuple[str, ...]
    time_s: NDArray[np.float64]
    input: NDArray[np.float64]
    output_start: NDArray[np.float64]
    output_end: NDArray[np.float64]
    estimate: NDArray[np.float64]
    status: NDArray[np.int64]
    kkt: NDArray[np.float64]
    iterations: NDArray[np.int64]
    ending: Ending
    message: str = ""
    true_start: NDArray[np.float64] | None = None
    true_end: NDArray[np.float64] | None = None
    state: NDArray[np.float64] | None = None

    def __len__(self) -> int:
        return len(self.time_s)

    def signal(self, name: str, *, true: bool = False) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(start, end) samples of one output, each (K,); ``true`` takes the noise-free ones where they are known."""
        if name not in self.output_names:
            raise ValueError(f"episode: unknown output {name!r}, allowed are {', '.join(self.output_names)}")
        index = self.output_names.index(name)
        if true and self.true_start is not None and self.true_end is not None:
            return self.true_start[:, index], self.true_end[:, index]
        return self.output_start[:, index], self.output_end[:, index]

    @property
    def failures(self) -> int:
        """Control steps that were not solved to tolerance."""
        return int(np.sum(self.status != SolveStatus.CONVERGED))

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Every array by name, for the store."""
        names = ("time_s", "input", "output_start", "output_end", "estimate", "status", "kkt", "iterations", "true_start", "true_end", "state")
        return {name: getattr(self, name) for name in names if getattr(self, name) is not None}

    def meta(self) -> dict[str, Any]:
        """Everything that is not an array, JSON-able."""
        return {
            "sampling_time_s": self.sampling_time_s,
            "input_names": list(self.input_names),
            "output_names": list(self.output_names),
            "input_units": list(self.input_units),
            "output_units": list(self.output_units),
            "estimate_names": list(self.estimate_names),
            "ending": self.ending.value,
            "message": self.message,
        }

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]], meta: Mapping[str, Any]) -> Episode:
        """The inverse of `arrays` and `meta`."""
        names = {key: tuple(meta[key]) for key in ("input_names", "output_names", "input_units", "output_units", "estimate_names")}
        return cls(
            sampling_time_s=float(meta["sampling_time_s"]), **names, **dict(arrays), ending=Ending(meta["ending"]), message=str(meta["message"])
        )

    def cut(self, length: int, ending: Ending, message: str) -> Episode:
        """The first ``length`` intervals, with another ending."""
        short = {name: value[: length + 1 if name == "state" else length] for name, value in self.arrays().items()}
        return replace(self, **short, ending=ending, message=message)  # type: ignore[arg-type]


# A controller that is blind or broken this many intervals in a row is not charging a battery any more.
BLIND_MAX = 3


def signal_indices(controller: Controller, plant: Plant) -> list[int]:
    """Where the signals that the estimator reads stand among the plant's outputs; ValueError when the two do not fit."""
    names = [s.name for s in plant.outputs]
    needed = controller.estimator.signals(controller.model)
    missing = [n for n in needed if n not in names]
    if missing:
        raise ValueError(f"the estimator reads {missing}, which the plant does not measure; it has {', '.join(names)}")
    if tuple(s.name for s in plant.inputs) != controller.model.input_names:
        raise ValueError(f"the plant's inputs {[s.name for s in plant.inputs]} are not the controller's {list(controller.model.input_names)}")
    if plant.sampling_time_s != controller.model.sampling_time_s:
        raise ValueError(f"sampling_time_s: plant {plant.sampling_time_s}, controller {controller.model.sampling_time_s}; they must be equal")
    return [names.index(n) for n in needed]


def ending_at(episode: Episode, trips: Sequence[Trip]) -> Episode:
    """The episode up to the first interval that has to end it; the same rule for both ways of running."""
    tripped = np.zeros(len(episode), dtype=bool)
    first: dict[int, tuple[Ending, str]] = {}

    def mark(bad: NDArray[np.bool_], ending: Ending, message: str) -> None:
        if bad.any():
            first.setdefault(int(np.argmax(bad)), (ending, message))
            tripped[np.argmax(bad)] = True

    # An interval with any sample that is not finite is blind. A reading of NaN is not within any limit.
    blind = ~np.all(np.isfinite(episode.output_end), axis=1)
    mark(_run_of(blind, BLIND_MAX), Ending.SENSOR, f"no finite measurement in {BLIND_MAX} intervals in a row")
    for trip in trips:
        start, end = episode.signal(trip.signal)
        for values in (start, end):
            outside = (values < trip.lower) | (values > trip.upper)
            if outside.any():
                worst = values[np.argmax(outside)]
                mark(outside, Ending.LIMIT, f"{trip.signal} = {worst:.6g} left [{trip.lower:g}, {trip.upper:g}]")
    broken = episode.status == SolveStatus.FALLBACK
    mark(_run_of(broken, BLIND_MAX), Ending.SOLVER, f"the solver gave no finite input in {BLIND_MAX} intervals in a row")
    if not first:
        return episode
    at = min(first)
    return episode.cut(at + 1, *first[at])


def _run_of(bad: NDArray[np.bool_], count: int) -> NDArray[np.bool_]:
    """True where the last ``count`` entries are all true."""
    out = np.zeros_like(bad)
    if len(bad) >= count:
        out[count - 1 :] = np.all(np.lib.stride_tricks.sliding_window_view(bad, count), axis=1)
    return out


def run_episode(
    controller: Controller,
    plant: Plant,
    *,
    steps: int,
    theta: ArrayLike | None = None,
    seed: int = 0,
    trips: Sequence[Trip] = (),
) -> Episode:
    """Run one closed loop step by step on any plant. It always returns: a failure is the episode's ending.

    The plant is closed at the end, whatever happened. Raises ValueError when controller, plant and theta do not fit.
    """
    values = controller.theta_vector(theta)
    indices = signal_indices(controller, plant)
    records: list[tuple[NDArray[np.float64], Measurement, SolveStatus, float, int, NDArray[np.float64]]] = []
    ending, message = Ending.DONE, ""
    first: Measurement | None = None
    blind = broken = 0
    try:
        first = plant.reset(seed)
        memory, measurement = begin(controller), first
        for _ in range(steps):
            u, memory, info = act(controller, measurement.received[indices], values, memory)
            measurement = plant.step(u)
            records.append((u, measurement, info.status, info.kkt, info.iterations, info.estimate))
            blind = blind + 1 if not np.all(np.isfinite(measurement.end)) else 0
            broken = broken + 1 if info.status == SolveStatus.FALLBACK else 0
            if blind >= BLIND_MAX or broken >= BLIND_MAX or _outside(plant, measurement, trips):
                break
    except PlantError as error:
        ending, message = Ending.PLANT, str(error)
    except KeyboardInterrupt:
        ending, message = Ending.INTERRUPTED, "interrupted by the user"
    finally:
        plant.close()
    episode = _assemble(controller, plant, first, records, ending, message)
    return ending_at(episode, trips) if ending is Ending.DONE else episode


def _outside(plant: Plant, measurement: Measurement, trips: Sequence[Trip]) -> bool:
    names = [s.name for s in plant.outputs]
    for trip in trips:
        i = names.index(trip.signal)
        if any(v < trip.lower or v > trip.upper for v in (measurement.start[i], measurement.end[i])):
            return True
    return False


def _assemble(controller: Controller, plant: Plant, first: Measurement | None, records: Sequence[Any], ending: Ending, message: str) -> Episode:
    ny, nu, nx = len(plant.outputs), len(plant.inputs), len(controller.model.states)
    count = len(records)

    def stack(values: list[Any], width: int) -> NDArray[np.float64]:
        return np.array(values, dtype=float).reshape(count, width)

    simulated = first is not None and first.state is not None
    states = [first.state, *(r[1].state for r in records)] if simulated and first is not None else None
    return Episode(
        sampling_time_s=plant.sampling_time_s,
        input_names=tuple(s.name for s in plant.inputs),
        output_names=tuple(s.name for s in plant.outputs),
        input_units=tuple(s.unit for s in plant.inputs),
        output_units=tuple(s.unit for s in plant.outputs),
        estimate_names=controller.model.state_names,
        time_s=np.arange(count) * plant.sampling_time_s,
        input=stack([r[0] for r in records], nu),
        output_start=stack([r[1].start for r in records], ny),
        output_end=stack([r[1].end for r in records], ny),
        estimate=stack([r[5] for r in records], nx),
        status=np.array([r[2] for r in records], dtype=np.int64),
        kkt=np.array([r[3] for r in records], dtype=float),
        iterations=np.array([r[4] for r in records], dtype=np.int64),
        ending=ending,
        message=message,
        true_start=stack([r[1].true_start for r in records], ny) if simulated else None,
        true_end=stack([r[1].true_end for r in records], ny) if simulated else None,
        state=np.array(states, dtype=float) if states is not None else None,
    )
