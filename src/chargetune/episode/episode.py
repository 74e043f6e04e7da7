"""Episode: the arrays of one closed loop, and what ends it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chargetune.control.sqp import SolveStatus
from chargetune.episode.html_repr import curves, facts
from chargetune.plants.plant import Measurement, Plant

__all__ = ["BLIND_MAX", "Ending", "Episode", "Trip", "ending_at", "tripped"]


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

    def noise_free(self) -> Episode:
        """The same episode with the true outputs as measured ones, where they are known."""
        if self.true_start is None or self.true_end is None:
            return self
        return replace(self, output_start=self.true_start, output_end=self.true_end)

    @property
    def failures(self) -> int:
        """Control steps that were not solved to tolerance."""
        return int(np.sum(self.status != SolveStatus.CONVERGED))

    @property
    def unsolved_share(self) -> float:
        """The share of control steps that were not solved to tolerance, 0 .. 1; 0 of an episode without any."""
        return self.failures / len(self) if len(self) else 0.0

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Every array by name, for the store."""
        return {name: getattr(self, name) for name in ARRAYS if getattr(self, name) is not None}

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
        """The inverse of `arrays` and `meta`; arrays of other names are left out."""
        names = ("input_names", "output_names", "input_units", "output_units", "estimate_names")
        values: dict[str, Any] = {name: arrays[name] for name in ARRAYS if name in arrays}
        values |= {name: tuple(meta[name]) for name in names}
        return cls(sampling_time_s=float(meta["sampling_time_s"]), ending=Ending(meta["ending"]), message=str(meta["message"]), **values)

    def _repr_html_(self) -> str:
        head: dict[str, str | float] = {
            "ending": f"{self.ending.value} {self.message}".strip(),
            "intervals": f"{len(self)} of {self.sampling_time_s:g} s",
            "steps not solved": f"{self.failures} ({100 * self.unsolved_share:.3g} %)",
        }
        inputs = {f"{n} ({u})": self.input[:, i] for i, (n, u) in enumerate(zip(self.input_names, self.input_units, strict=True))}
        outputs = {f"{n} ({u})": self.output_end[:, i] for i, (n, u) in enumerate(zip(self.output_names, self.output_units, strict=True))}
        return facts("Episode", head) + curves(self.time_s / 60.0, {**inputs, **outputs})

    def cut(self, length: int, ending: Ending, message: str) -> Episode:
        """The first ``length`` intervals, with another ending."""
        short = {name: value[: length + 1 if name == "state" else length] for name, value in self.arrays().items()}
        return replace(self, **short, ending=ending, message=message)  # type: ignore[arg-type]


ARRAYS = ("time_s", "input", "output_start", "output_end", "estimate", "status", "kkt", "iterations", "true_start", "true_end", "state")

# A controller that is blind or broken this many intervals in a row is not charging a battery any more.
BLIND_MAX = 3


def tripped(plant: Plant, measurement: Measurement, trips: Sequence[Trip]) -> str:
    """Which trip a measurement sets off, in words; empty when it sets off none."""
    names = [s.name for s in plant.outputs]
    for trip in trips:
        for values in (measurement.start, measurement.end):
            value = values[names.index(trip.signal)]
            if value < trip.lower or value > trip.upper:
                return _left(trip, value)
    return ""


def ending_at(episode: Episode, trips: Sequence[Trip]) -> Episode:
    """The episode up to the first interval that has to end it; the same rule for both ways of running."""
    first: dict[int, tuple[Ending, str]] = {}

    def mark(bad: NDArray[np.bool_], ending: Ending, message: str) -> None:
        if bad.any():
            first.setdefault(int(np.argmax(bad)), (ending, message))

    blind = ~np.all(np.isfinite(episode.output_end), axis=1)
    mark(_run_of(blind, BLIND_MAX), Ending.SENSOR, f"no finite measurement in {BLIND_MAX} intervals in a row")
    for trip in trips:
        for values in episode.signal(trip.signal):
            outside = (values < trip.lower) | (values > trip.upper)
            mark(outside, Ending.LIMIT, _left(trip, values[np.argmax(outside)]) if outside.any() else "")
    broken = episode.status == SolveStatus.FALLBACK
    mark(_run_of(broken, BLIND_MAX), Ending.SOLVER, f"the solver gave no finite input in {BLIND_MAX} intervals in a row")
    if not first:
        return episode
    at = min(first)
    return episode.cut(at + 1, *first[at])


def _left(trip: Trip, value: float) -> str:
    return f"{trip.signal} = {value:.6g} left [{trip.lower:g}, {trip.upper:g}]"


def _run_of(bad: NDArray[np.bool_], count: int) -> NDArray[np.bool_]:
    """True where the last ``count`` entries are all true."""
    out = np.zeros_like(bad)
    if len(bad) >= count and bad.any():
        out[count - 1 :] = np.all(np.lib.stride_tricks.sliding_window_view(bad, count), axis=1)
    return out
