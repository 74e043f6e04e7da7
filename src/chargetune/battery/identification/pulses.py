"""Finding pulses and rests in a measurement."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from chargetune.battery.identification.record import Record, segments

__all__ = ["PULSE_MAX_S", "REST_MIN_S", "PulseSet", "find_pulse_sets", "groups"]

# A rest at least this long leaves the cell relaxed, s.
REST_MIN_S = 600.0
# A current at most this long is a pulse, s; a longer one moves the SOC.
PULSE_MAX_S = 120.0
# Rests between pulses belong to the set up to this length, s.
PAUSE_MAX_S = 300.0
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
        if sign != 0 or _seconds(record, first, last) < REST_MIN_S:
            continue
        end = last
        for start, stop, kind in parts[k + 1 :]:
            if _seconds(record, start, stop) > (PULSE_MAX_S if kind else PAUSE_MAX_S):
                break
            end = stop
        if end > last:
            sets.append(PulseSet(last - 1, end))
    return sets


def groups(soc: NDArray[np.float64]) -> list[NDArray[np.int64]]:
    """Indices of the values, which must not fall, in groups whose values lie within 0.02 of the group's first."""
    starts = [0]
    for i, z in enumerate(soc):
        if z > soc[starts[-1]] + SAME_SOC:
            starts.append(i)
    return np.split(np.arange(len(soc)), starts[1:])


def _seconds(record: Record, first: int, last: int) -> float:
    return float(record.time_s[last - 1] - record.time_s[max(first - 1, 0)])
