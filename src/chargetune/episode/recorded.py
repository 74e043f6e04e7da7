"""An episode of what a device logged: the record of a charge that this program did not run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from chargetune.control.sqp import SolveStatus
from chargetune.episode.episode import Ending, Episode
from chargetune.model.model import Signal

__all__ = ["recorded_episode"]


def recorded_episode(
    time_s: ArrayLike,
    signals: Mapping[str, ArrayLike],
    *,
    inputs: Sequence[Signal],
    outputs: Sequence[Signal],
    sampling_time_s: float,
    ending: Ending = Ending.DONE,
    message: str = "",
) -> Episode:
    """The intervals of a log with samples at ``time_s`` (n,), s, increasing; ``signals`` has the n values of each input and output.

    As cyclers log, a sample's input has flowed since the sample before. With the first sample at t_0 and T = ``sampling_time_s``,
    interval k is (t_0 + k T, t_0 + (k + 1) T]; its input is the mean over it, so that no charge is lost,

        u_k = (Q(t_0 + (k + 1) T) - Q(t_0 + k T)) / T,   Q(t_i) = sum_{j <= i} u(t_j) (t_j - t_{j-1}), linear in between,

    and its outputs are the first and the last sample in it, NaN where there is none. What is left after the last whole interval is
    left out. ``inputs`` and ``outputs`` are those of the controller's model. A log says nothing of estimates and solves: there are
    no estimates, and every step counts as solved. Raises ValueError for a signal that is missing or of another length, for numbers
    that are not finite, for a time that does not increase, and for less than one interval.
    """
    time = np.asarray(time_s, dtype=np.float64)
    if time.ndim != 1 or time.size < 2 or not np.all(np.isfinite(time)):
        raise ValueError(f"time_s of shape {time.shape}, allowed are two or more finite numbers")
    if not np.all(np.diff(time) > 0):
        k = int(np.argmax(np.diff(time) <= 0))
        raise ValueError(f"time_s[{k + 1}] = {time[k + 1]:g} after {time[k]:g}, allowed is an increasing time")
    step, time = float(sampling_time_s), time - time[0]
    # A clock that rounds may end just before the last interval does.
    count = int((time[-1] + 1e-6 * step) // step) if np.isfinite(step) and step > 0 else 0
    if not count:
        raise ValueError(f"sampling_time_s = {sampling_time_s:g}, allowed is more than 0 and at most the {time[-1]:g} s of the log")
    edges = step * np.arange(count + 1, dtype=np.float64)
    given = np.column_stack([_values(signals, signal.name, time.size) for signal in inputs])
    passed = np.cumsum(given * np.diff(time, prepend=time[0])[:, None], axis=0)
    applied = np.column_stack([np.diff(np.interp(edges, time, column)) for column in passed.T]) / step
    seen = np.column_stack([_values(signals, signal.name, time.size) for signal in outputs])
    # The samples after each edge, up to the next one.
    places = np.searchsorted(time, edges + 1e-6 * step, side="right")
    first, last = places[:-1], places[1:] - 1
    empty = (last < first)[:, None]
    return Episode(
        step,
        tuple(s.name for s in inputs),
        tuple(s.name for s in outputs),
        tuple(s.unit for s in inputs),
        tuple(s.unit for s in outputs),
        (),
        edges[:-1],
        applied,
        np.where(empty, np.nan, seen[np.minimum(first, time.size - 1)]),
        np.where(empty, np.nan, seen[last]),
        np.zeros((count, 0)),
        np.full(count, int(SolveStatus.CONVERGED)),
        np.zeros(count),
        np.zeros(count, dtype=np.int64),
        ending,
        message,
    )


def _values(signals: Mapping[str, ArrayLike], name: str, count: int) -> NDArray[np.float64]:
    if name not in signals:
        raise ValueError(f"signals: {name} is missing, given are {', '.join(signals) or '(none)'}")
    values = np.asarray(signals[name], dtype=np.float64)
    if values.shape != (count,) or not np.all(np.isfinite(values)):
        raise ValueError(f"signals: {name} of shape {values.shape}, allowed are finite numbers, one for each of {count} times")
    return values
