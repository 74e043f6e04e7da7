"""A deterministic study in two parameters: a tuner that learns, an evaluation that violates, fails and leaves a trace.

What tests call in worker processes stands here too, and the study is imported only where it is opened: each process of a pool begins
with the import of this module.
"""

import multiprocessing
import os
import signal
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from chargetune.episode.score import Score
from chargetune.model.parameter_space import Parameter, ParameterSpace
from chargetune.plants.plant import SetUpError
from chargetune.study.evaluation import trial_seed

SPACE = ParameterSpace((Parameter("x", 0.0, 1.0, 0.5), Parameter("r", 0.1, 6.0, 1.0, scale="log")))
SEED = 11
CONFIG = {"plant": {"noise": 1e-3, "steps": 20}, "name": "toy"}


@dataclass(frozen=True)
class Halfway:
    """Half of the proposals fill the box by an additive recurrence, the others lie halfway to the best told trial."""

    seed: int = 0

    def ask(self, space, trials, n=1):
        best = max((t for t in trials if t.score is not None), key=lambda t: (t.score.performance, -t.number), default=None)
        shift = np.random.default_rng(self.seed).random(space.dimension)
        points = []
        for k in range(len(trials), len(trials) + n):
            point = (shift + (k + 1) * np.array([0.7548776662466927, 0.5698402909980532])[: space.dimension]) % 1.0
            if k % 2 and best is not None:
                point = 0.5 * (point + space.to_unit(best.theta))
            points.append(space.from_unit(point))
        return np.array(points)


@dataclass(frozen=True)
class ToyEpisode:
    voltage: np.ndarray

    def arrays(self):
        return {"time_s": np.arange(len(self.voltage)) * 10.0, "voltage": self.voltage}

    def meta(self):
        return {"units": {"voltage": "V"}, "sampling_time_s": 10.0}


@dataclass(frozen=True)
class Toy:
    """``pause_s`` makes it last; a third of the box violates its limit, a corner raises."""

    pause_s: float = 0.0

    def __call__(self, theta, seed):
        time.sleep(self.pause_s)
        noise = np.random.default_rng(seed).normal(0, 1e-3, 20)
        x, log_r = theta[0], np.log(theta[1])
        if x > 0.85:
            raise RuntimeError(f"the plant gave up at x = {x:.3f}")
        objective = -((x - 0.3) ** 2) - 0.1 * log_r**2 + noise[0]
        excess = x + 0.3 * log_r - 0.6
        score = Score(objective, objective - max(0.0, excess) ** 2, {"v": excess}, {"v": 0.0}, {"t80_min": None, "x_end": x})
        return score, ToyEpisode(4.0 + noise), "done"


@dataclass(frozen=True)
class Deadly:
    """The toy, but one trial of the toy's study ends the process without a word; with ``once`` only the first time."""

    number: int
    once: Path | None = None

    def __call__(self, theta, seed):
        if seed == trial_seed(SEED, self.number) and not (self.once and self.once.exists()):
            if self.once:
                self.once.touch()
            os._exit(7)
        return Toy()(theta, seed)


@dataclass(frozen=True)
class Waits:
    """The toy, but trial ``first`` of the toy's study ends only when trial ``later`` has begun, in whatever process."""

    first: int
    later: int
    begun: Path

    def __call__(self, theta, seed):
        if seed == trial_seed(SEED, self.later):
            self.begun.touch()
        if seed == trial_seed(SEED, self.first):
            until = time.monotonic() + 60
            while not self.begun.exists():
                if time.monotonic() > until:
                    raise RuntimeError(f"trial {self.later} does not begin beside trial {self.first}")
                time.sleep(0.01)
        return Toy()(theta, seed)


class OnlyHere:
    """Pickles, and cannot be unpickled."""

    def __reduce__(self):
        return not_here, ()

    def __call__(self, theta, seed):
        return Toy()(theta, seed)


def not_here():
    raise RuntimeError("not here")


def misspelt(theta, seed):
    return undefined_name(theta, seed)  # noqa: F821 - the error of a program that is tested


def refused(theta, seed):
    raise SetUpError("plant: parameters = 'none', allowed is one that there is")


def environment(_):
    time.sleep(0.2)
    return os.environ["OMP_NUM_THREADS"], signal.getsignal(signal.SIGINT), os.getpid()


def pid_after(pause_s):
    time.sleep(pause_s)
    return os.getpid()


def begin_and_wait(folder, number):
    try:
        # Within: it may be interrupted as soon as it is seen to have begun.
        (folder / str(number)).write_text(str(os.getpid()))
        time.sleep(600)
    finally:
        (folder / f"{number} left").touch()


def open_study(store, name="toy", **changes):
    from chargetune.study.study import Study

    arguments = {"config": CONFIG, "space": SPACE, "tuner": Halfway(3), "seed": SEED} | changes
    return Study.create_or_resume(store, name, **arguments)


def essence(trials):
    """What must not depend on interruptions: all of a trial but times and provenance."""
    return [(t.number, t.theta, t.status, t.score, t.ending, t.seed, t.trace_sha256) for t in trials]


def told_by_another_process(ask, *arguments):
    """What ``ask(*arguments, connection)`` sends from a process of its own."""
    fork = multiprocessing.get_context("fork")
    here, there = fork.Pipe()
    process = fork.Process(target=ask, args=(*arguments, there))
    process.start()
    answer = here.recv()
    process.join()
    return answer
