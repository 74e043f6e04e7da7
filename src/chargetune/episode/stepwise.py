"""One closed loop step by step, on any plant."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from chargetune.control.control_step import Act
from chargetune.control.controller import Controller
from chargetune.control.first_guess import act_of, first_memory
from chargetune.control.sqp import SolveStatus
from chargetune.episode.episode import BLIND_MAX, Ending, Episode, Trip, ending_at, tripped
from chargetune.model.given import Given, actual, checked_given, windows
from chargetune.plants.plant import Measurement, Plant, PlantError, SetUpError
from chargetune.runtime.counted import counted
from chargetune.runtime.numeric import is_integer

__all__ = ["check_run", "run_episode", "signal_indices"]


def run_episode(
    controller: Controller,
    plant: Plant,
    *,
    steps: int,
    theta: ArrayLike | None = None,
    seed: int = 0,
    trips: Sequence[Trip] = (),
    control: Act | None = None,
    given: Given | None = None,
) -> Episode:
    """Run one closed loop step by step on any plant. It always returns: a failure is the episode's ending.

    ``control`` is the control step, by default that of the controller's ``solver``; `ipopt_act` is the reference. ``given`` has
    the given signals of the controller and of the plant by name (`model.given.checked_given`): numbers, sequences of at least
    ``steps`` values, or forecasts.

    The plant is closed at the end, whatever happened, and before anything else is done with the result. What the plant
    raises ends the episode as PLANT, what the controller raises as SOLVER; the intervals until then are kept. A plant
    that is outside a trip at rest gets no input. Raises ValueError, before the plant is touched, when controller,
    plant, theta, steps, seed and trips do not fit.
    """
    values = controller.theta_vector(theta)
    indices = signal_indices(controller, plant)
    check_run(plant, steps, seed, trips)
    seen, plant = _told(controller, plant, given, steps)
    step = control or act_of(controller)
    records: list[tuple[NDArray[np.float64], Measurement, SolveStatus, float, int, NDArray[np.float64]]] = []
    ending, message = Ending.DONE, ""
    first: Measurement | None = None
    blind = broken = 0
    try:
        first = _asked(plant, partial(plant.reset, seed))
        memory, measurement = first_memory(controller, values, seen[0] if controller.given else None), first
        message = tripped(plant, first, trips)
        ending = Ending.LIMIT if message else Ending.DONE
        for k in range(0 if message else steps):
            # A control step for controllers without given signals need not know of them.
            known = (seen[k],) if controller.given else ()
            u, memory, info = step(controller, measurement.received[indices], values, memory, *known)
            _refuse_unusable(u, len(plant.inputs))
            measurement = _asked(plant, partial(plant.step, u))
            records.append((u, measurement, info.status, info.kkt, info.iterations, info.estimate))
            blind = blind + 1 if not np.all(np.isfinite(measurement.end)) else 0
            broken = broken + 1 if info.status == SolveStatus.FALLBACK else 0
            if blind >= BLIND_MAX or broken >= BLIND_MAX or tripped(plant, measurement, trips):
                break
    except SetUpError:
        # No interval of it could ever run, so there is no episode to tell of.
        raise
    except PlantError as error:
        ending, message = Ending.PLANT, str(error)
    except KeyboardInterrupt:
        ending, message = Ending.INTERRUPTED, "interrupted by the user"
    except Exception as error:  # noqa: BLE001 - whatever a controller raises, the plant has to be left safe and the trace kept
        ending, message = Ending.SOLVER, f"the controller raised {type(error).__name__}: {error}"
    finally:
        unsafe = _closed(plant)
    episode = _assemble(controller, plant, first, records, ending, message)
    episode = ending_at(episode, trips) if ending is Ending.DONE else episode
    if unsafe:
        return replace(episode, ending=Ending.PLANT, message="; ".join(filter(None, (unsafe, episode.message))))
    return episode


def _told(controller: Controller, plant: Plant, given: Given | None, steps: int) -> tuple[NDArray[np.float64], Plant]:
    """(what the controller sees of the given signals in each interval, the plant that follows its own)."""
    read = tuple(getattr(plant, "given", ()))
    values = checked_given(tuple(dict.fromkeys((*controller.given_names, *read))), given, steps, controller.horizon)
    seen = windows([values[name] for name in controller.given_names], steps, controller.horizon)
    if not read:
        return seen, plant
    follower: Any = plant
    return seen, follower.following(actual([values[name] for name in read], steps))


def _asked(plant: Plant, call: Callable[[], Measurement]) -> Measurement:
    """What the plant answers; anything it raises, and an answer of the wrong shape, is a `PlantError`."""
    try:
        measurement = call()
    except (PlantError, SetUpError):
        raise
    except Exception as error:
        raise PlantError(f"the plant raised {type(error).__name__}: {error}") from error
    expected = (len(plant.outputs),)
    for name in ("start", "end", "received"):
        shape = np.shape(getattr(measurement, name))
        if shape != expected:
            raise PlantError(f"the plant's measurement {name} has shape {shape}, expected {expected}")
    return measurement


def _refuse_unusable(u: NDArray[np.float64], count: int) -> None:
    # `act` never gives such an input; another control step may, and a plant must not get it.
    if np.shape(u) != (count,) or not np.all(np.isfinite(u)):
        raise ValueError(f"input = {np.asarray(u).tolist()}, allowed: {counted(count, 'finite number')}")


def _closed(plant: Plant) -> str:
    """Close the plant; why that failed, or nothing."""
    try:
        plant.close()
    except Exception as error:  # noqa: BLE001 - a plant that cannot be closed is the news that must not be lost
        return f"the plant could not be closed: {type(error).__name__}: {error}"
    return ""


def _assemble(
    controller: Controller, plant: Plant, first: Measurement | None, records: Sequence[Any], ending: Ending, message: str
) -> Episode:
    ny, nu, nx = len(plant.outputs), len(plant.inputs), len(controller.model.states)
    count = len(records)

    def stack(values: list[Any], width: int) -> NDArray[np.float64]:
        return np.array(values, dtype=float).reshape(count, width)

    measured = [r[1] for r in records]
    states = [m.state for m in (*([first] if first else []), *measured)]
    known = bool(states) and all(m.true_start is not None for m in (*([first] if first else []), *measured))
    return Episode(
        sampling_time_s=plant.sampling_time_s,
        input_names=tuple(s.name for s in plant.inputs),
        output_names=tuple(s.name for s in plant.outputs),
        input_units=tuple(s.unit for s in plant.inputs),
        output_units=tuple(s.unit for s in plant.outputs),
        estimate_names=controller.model.state_names,
        time_s=np.arange(count, dtype=np.float64) * plant.sampling_time_s,
        input=stack([r[0] for r in records], nu),
        output_start=stack([m.start for m in measured], ny),
        output_end=stack([m.end for m in measured], ny),
        estimate=stack([r[5] for r in records], nx),
        status=np.array([r[2] for r in records], dtype=np.int64),
        kkt=np.array([r[3] for r in records], dtype=float),
        iterations=np.array([r[4] for r in records], dtype=np.int64),
        ending=ending,
        message=message,
        true_start=stack([m.true_start for m in measured], ny) if known else None,
        true_end=stack([m.true_end for m in measured], ny) if known else None,
        state=np.array(states, dtype=float) if states and all(s is not None for s in states) else None,
    )


def signal_indices(controller: Controller, plant: Plant) -> list[int]:
    """Where the signals that the estimator reads stand among the plant's outputs; ValueError when the two do not fit."""
    names = [s.name for s in plant.outputs]
    needed = controller.estimator.signals(controller.model)
    missing = [n for n in needed if n not in names]
    if missing:
        raise ValueError(f"the estimator reads {missing}, which the plant does not measure; it has {', '.join(names)}")
    inputs = [s.name for s in plant.inputs]
    if inputs != list(controller.model.input_names):
        raise ValueError(f"the plant's inputs {inputs} are not the controller's {list(controller.model.input_names)}")
    ours, theirs = controller.model.sampling_time_s, plant.sampling_time_s
    if theirs != ours:
        raise ValueError(f"sampling_time_s: plant {theirs}, controller {ours}; they must be equal")
    return [names.index(n) for n in needed]


def check_run(plant: Plant, steps: int, seed: int, trips: Sequence[Trip]) -> None:
    """Raises ValueError when an episode cannot be run with these: field, value and what is allowed."""
    for name, value, least in (("steps", steps, 1), ("seed", seed, 0)):
        if not is_integer(value) or value < least:
            raise ValueError(f"{name} = {value!r}, allowed is an integer >= {least}")
    names = [s.name for s in plant.outputs]
    unknown = sorted({trip.signal for trip in trips} - set(names))
    if unknown:
        raise ValueError(f"trip of unknown {unknown}, allowed are {', '.join(names)}")
