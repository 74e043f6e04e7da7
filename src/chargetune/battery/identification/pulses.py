"""Finding pulses and rests in a measurement."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from chargetune.battery.identification.record import Record, segments
from chargetune.runtime.counted import counted

__all__ = ["PULSE_MAX_S", "REST_MIN_S", "PulseSet", "find_pulse_sets", "groups", "rest_level", "set_temperatures", "unused_pulses"]

# A rest at least this long leaves the cell relaxed, s.
REST_MIN_S = 600.0
# A current at most this long is a pulse, s; a longer one moves the SOC.
PULSE_MAX_S = 120.0
# Rests between pulses belong to the set up to this length, s.
PAUSE_MAX_S = 300.0
# Lengths as logged differ from the nominal ones by up to this share.
LENGTH_SHARE = 0.05
# A current of up to so many times the length of a pulse, after a long rest, may have been meant as one.
LONG_PULSE, LONG_PULSES = 3.0, 3
# Samples at the end of a rest that tell its noise, mV, and what it is where they are too few.
REST_SAMPLES, NOISE_MIN_MV, NOISE_UNKNOWN_MV = 8, 0.1, 1.0
# The last sample of a rest is an outlier if it is off the others by so many sd of their noise, and at least so many mV.
NOISE_SD, OFF_MIN_MV = 5.0, 5.0
# Sets whose temperatures are this far apart, K, are of two temperatures.
TEMPERATURES_APART_K = 5.0
ZERO_CELSIUS_K = 273.15
# Sets within this SOC of each other are at one SOC, as where pulses of several currents follow each other.
SAME_SOC = 0.02


@dataclass(frozen=True)
class PulseSet:
    """Pulses after one rest: sample indices ``first`` (the last one at rest) .. ``last`` (not included) of a record."""

    first: int
    last: int

    def of(self, record: Record) -> Record:
        return record.part(self.first, self.last)


def find_pulse_sets(record: Record) -> list[PulseSet]:
    """Every set of short pulses that begins after a long rest, in order of time."""
    parts = segments(record)
    sets = []
    for k, (first, last, sign) in enumerate(parts[:-1]):
        if sign != 0 or _seconds(record, first, last) < (1 - LENGTH_SHARE) * REST_MIN_S:
            continue
        end = last
        for start, stop, kind in parts[k + 1 :]:
            if _seconds(record, start, stop) > (1 + LENGTH_SHARE) * (PULSE_MAX_S if kind else PAUSE_MAX_S):
                break
            end = stop
        if end > last:
            sets.append(PulseSet(last - 1, end))
    return sets


def unused_pulses(record: Record, sets: list[PulseSet], soc: NDArray[np.float64]) -> list[str]:
    """What each short current in no set lacks: the rest before it is too short, or the current is too long."""
    rest_s = 0.0
    short: list[tuple[float, float]] = []
    long: list[tuple[float, float]] = []
    for first, last, kind in segments(record):
        seconds = _seconds(record, first, last)
        if not kind:
            rest_s = seconds
            continue
        inside = any(part.first < first < part.last for part in sets)
        if not inside and seconds <= (1 + LENGTH_SHARE) * PULSE_MAX_S:
            short.append((float(soc[first]), rest_s))
        elif not inside and seconds <= LONG_PULSE * PULSE_MAX_S and rest_s >= REST_MIN_S:
            long.append((float(soc[first]), seconds))
        rest_s = 0.0
    notes = []
    # Pulses that follow each other at one SOC are told once.
    while short:
        of = [pair for pair in short if abs(pair[0] - short[0][0]) <= SAME_SOC]
        short = [pair for pair in short if pair not in of]
        notes.append(
            f"{len(of)} pulse{'s' if len(of) > 1 else ''} at SOC {of[0][0]:.2f} left out: the rest before lasted {of[0][1]:.0f} s, "
            f"needed are {REST_MIN_S:g} s"
        )
    # One of them may be a move to the next SOC.
    if len(long) >= LONG_PULSES:
        at = ", ".join(f"{z:.2f}" for z, _ in long)
        notes.append(
            f"{counted(len(long), 'current')} of up to {max(s for _, s in long):.0f} s (SOC {at}) are no pulses, "
            f"which last {PULSE_MAX_S:g} s at most"
        )
    return notes


def set_temperatures(record: Record, sets: list[PulseSet]) -> list[tuple[float, list[int]]]:
    """(median temperature in degree Celsius, indices of its sets), coldest first; empty where the record has no temperature."""
    if record.temperature_K is None or not sets:
        return []
    each = np.array([float(np.median(record.temperature_K[part.first : part.last])) - ZERO_CELSIUS_K for part in sets])
    order = np.argsort(each, kind="stable")
    parts = np.split(order, np.flatnonzero(np.diff(each[order]) > TEMPERATURES_APART_K) + 1)
    return [(round(float(np.median(each[part])), 1), sorted(part.tolist())) for part in parts]


def rest_level(record: Record, first: int) -> tuple[float, float]:
    """(voltage before the pulses in V, its noise in mV) from the last samples of the rest, of which the last may be an outlier."""
    start = max(first - REST_SAMPLES, 0)
    resting = np.abs(record.current_A[start : first + 1]) <= record.rest_A
    start += int(np.flatnonzero(~resting)[-1]) + 1 if not resting.all() else 0
    # The first samples of a rest still relax; its course to the end is a line.
    t, v = record.time_s[start : first + 1], record.voltage_V[start : first + 1]
    if t.size < 5 or not np.all(np.diff(t[:-1]) > 0):
        return float(v[-1]), NOISE_UNKNOWN_MV
    line = np.polyfit(t[:-1] - t[-1], v[:-1], 1)
    off = v[:-1] - np.polyval(line, t[:-1] - t[-1])
    noise = max(1e3 * float(np.std(off)) * (t.size - 1) ** 0.5 / (t.size - 3) ** 0.5, NOISE_MIN_MV)
    last = float(v[-1])
    if abs(1e3 * (last - line[1])) > max(NOISE_SD * noise, OFF_MIN_MV):
        last = float(line[1])
    return last, noise


def groups(soc: NDArray[np.float64]) -> list[NDArray[np.int64]]:
    """Indices of the values, which must not fall, in groups whose values lie within 0.02 of the group's first."""
    starts = [0]
    for i, z in enumerate(soc):
        if z > soc[starts[-1]] + SAME_SOC:
            starts.append(i)
    return np.split(np.arange(len(soc)), starts[1:])


def _seconds(record: Record, first: int, last: int) -> float:
    return float(record.time_s[last - 1] - record.time_s[max(first - 1, 0)])
