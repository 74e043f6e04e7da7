"""Single samples of a voltage that are off: a lost contact, a range that switched."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from chargetune.battery.identification.record import JUMP_SHARE

__all__ = ["LONGEST", "spikes"]

# A spike is so many times as far off as its neighbours are from each other, which no relaxation is.
TIMES = 5.0
# Longest spike in samples.
LONGEST = 2


def spikes(voltage_V: NDArray[np.float64], current_A: NDArray[np.float64], least_V: float) -> NDArray[np.bool_]:
    """Whether each sample is off the line between the samples around it by at least ``least_V``, under a steady current. Shape (n,)."""
    found = np.zeros(voltage_V.size, dtype=bool)
    steady = np.abs(np.diff(current_A)) <= JUMP_SHARE * np.max(np.abs(current_A), initial=0.0)
    for length in range(1, LONGEST + 1):
        if voltage_V.size < length + 2:
            break
        count = voltage_V.size - length - 1
        first, last = voltage_V[:count], voltage_V[length + 1 :]
        inside = np.stack([voltage_V[k : count + k] - first - k / (length + 1) * (last - first) for k in range(1, length + 1)])
        off = np.min(np.abs(inside), axis=0) * (np.abs(np.sum(np.sign(inside), axis=0)) == length)
        even = np.all([steady[k : count + k] for k in range(length + 1)], axis=0)
        starts = np.flatnonzero(even & (off > least_V + TIMES * np.abs(last - first)))
        for k in range(1, length + 1):
            found[starts + k] = True
    return found
