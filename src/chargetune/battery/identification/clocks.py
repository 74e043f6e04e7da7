"""One increasing time from what cyclers log: a clock of the test, of each step, of the day, with rows that are damaged."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from chargetune.battery.identification.record import JUMP_SHARE
from chargetune.runtime.counted import counted

__all__ = ["DAY_S", "Clock", "elapsed"]

DAY_S = 86400.0
# A clock of the whole test that restarts begins at most here, s, or at most at this share of the time before.
RESTART_S, RESTART_SHARE, RESTART_MAX_S = 1.0, 0.1, 60.0
# Steps end and begin with two samples at one time; more of them are damage.
STANDS_SHARE = 0.05
# A row whose time alone is wrong leaves a gap of two logging intervals; this many are allowed for an uneven logging.
GLITCH_INTERVALS = 3.5
# The first time of a step is one logging interval; equal within this share.
SAME_INTERVAL = 0.05


@dataclass(frozen=True)
class Clock:
    """Times as logged (s), current (A), the number of the step of each sample (None: not in the file), and whether hours run to 24."""

    time_s: NDArray[np.float64]
    current_A: NDArray[np.float64]
    step: NDArray[np.int64] | None
    of_steps: bool = False
    of_day: bool = False

    def part(self, keep: NDArray[np.bool_]) -> Clock:
        step = None if self.step is None else self.step[keep]
        return Clock(self.time_s[keep], self.current_A[keep], step, self.of_steps, self.of_day)

    @property
    def changes(self) -> NDArray[np.bool_]:
        """Whether a step may begin with each sample after the first: its number changes or, without one, the current jumps."""
        if self.step is not None:
            return np.asarray(np.diff(self.step) != 0)
        return np.asarray(np.abs(np.diff(self.current_A)) > JUMP_SHARE * np.max(np.abs(self.current_A)))


def elapsed(name: str, clock: Clock, remarks: list[str]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """(time from 0 that does not fall, which samples it has). Raises ValueError that names file, sample and times."""
    keep = _without_glitches(clock, remarks)
    used, at = clock.part(keep), np.flatnonzero(keep)
    time, changes = used.time_s, used.changes
    steps = np.diff(time)
    falls = np.flatnonzero(steps < 0)
    of_steps = _counts_steps(used, falls)
    for k in falls.tolist():
        if used.of_day and _midnight(time, k):
            steps[k] += DAY_S
            falls = falls[falls != k]
            continue
        # Of a step's clock every fall is a step's begin; another clock begins near zero again, or it is damaged.
        allowed = time[k] if of_steps else max(RESTART_S, min(RESTART_SHARE * time[k], RESTART_MAX_S))
        if not 0 <= time[k + 1] <= allowed:
            raise ValueError(f"{name}, sample {at[k + 1] + 1}: time = {time[k + 1]:g} s after {time[k]:g} s, allowed is an increasing time")
        steps[k] = time[k + 1]
    begins = falls
    if of_steps:
        quiet = np.flatnonzero(changes & (steps >= 0) & (np.diff(time) >= 0))
        begins = np.union1d(falls, [k for k in quiet.tolist() if _begins(name, used, k, at)]).astype(np.int64)
        steps[begins] = time[begins + 1]
    if falls.size:
        kind = "once a step" if of_steps else f"first at sample {at[falls[0] + 1] + 1}"
        remarks.append(f"the clock restarts {counted(begins.size, 'time')} ({kind}); the steps were strung together")
    stands = steps == 0
    stands[begins] = False
    if np.mean(stands) > STANDS_SHARE:
        k = int(np.argmax(stands))
        raise ValueError(
            f"{name}, sample {k + 2}: time stands at {time[k]:g} s in {counted(np.sum(stands), 'sample')}, allowed is an increasing time"
        )
    return np.asarray(np.concatenate([[0.0], np.cumsum(steps)]), dtype=np.float64), keep


def _without_glitches(clock: Clock, remarks: list[str]) -> NDArray[np.bool_]:
    """Samples whose time fits; one whose time alone is wrong, between two that fit each other, is left out and told."""
    time, changes = clock.time_s, clock.changes
    keep = np.ones(time.size, dtype=bool)
    for k in np.flatnonzero(np.diff(time) < 0).tolist():
        # Sample k + 1 is too early, or sample k too late.
        for wrong in (k + 1, k):
            if not 2 <= wrong < time.size - 1 or changes[wrong - 1] or changes[wrong]:
                continue
            before, across = time[wrong - 1] - time[wrong - 2], time[wrong + 1] - time[wrong - 1]
            if 0 < across <= GLITCH_INTERVALS * before:
                keep[wrong] = False
                remarks.append(
                    f"sample {wrong + 1} was left out: its time is {time[wrong]:g} s, between {time[wrong - 1]:g} s and "
                    f"{time[wrong + 1]:g} s"
                )
                break
    return keep


def _counts_steps(clock: Clock, falls: NDArray[np.int64]) -> bool:
    """Whether the clock restarts with each step: by its name, or as it falls where steps begin and nowhere else."""
    if not falls.size:
        return False
    changes = np.flatnonzero(clock.changes)
    at_changes = np.isin(falls, changes).mean()
    if clock.of_steps:
        return True
    return bool(falls.size >= 2 and at_changes == 1.0 and falls.size >= 0.5 * changes.size)


def _midnight(time: NDArray[np.float64], k: int) -> bool:
    interval = max(time[k] - time[k - 1] if k else 0.0, time[k + 2] - time[k + 1] if k + 2 < time.size else 0.0)
    return bool(time.max() < DAY_S and time[k + 1] + DAY_S - time[k] <= GLITCH_INTERVALS * max(interval, 1.0))


def _begins(name: str, clock: Clock, k: int, at: NDArray[np.int64]) -> bool:
    """Whether a step begins between samples k and k + 1 of a step's clock that does not fall there.

    Its number says so; without one, a step's first time is one logging interval, and within a step the interval goes on.
    """
    if clock.step is not None:
        return True
    time = clock.time_s
    after = time[k + 2] - time[k + 1] if k + 2 < time.size else np.nan
    before = time[k] - time[k - 1] if k else np.nan

    def same(value: float, interval: float) -> bool:
        return bool(abs(value - interval) <= SAME_INTERVAL * interval)

    new, on = same(time[k + 1], after), same(time[k + 1] - time[k], before) or same(time[k + 1] - time[k], after)
    if new == on:
        raise ValueError(
            f"{name}, sample {at[k + 1] + 1}: the clock counts each step and shows {time[k + 1]:g} s after {time[k]:g} s where the "
            "current changes; whether a step begins there cannot be told. Needed is a column with the step's number or the test's time"
        )
    return new
