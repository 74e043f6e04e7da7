"""Given signals: references, prices, measured disturbances and their forecasts, as sequences that are told at run time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from chargetune.runtime.counted import counted

__all__ = ["Given", "actual", "checked_given", "windows"]

# By name: a number, a sequence with a value for each interval, or a forecast for each interval, shape (steps, N + 1).
Given = Mapping[str, ArrayLike]


def checked_given(names: Sequence[str], given: Given | None, steps: int, horizon: int) -> dict[str, NDArray[np.float64]]:
    """The signals of these names as arrays (K,) with K >= ``steps``, or (K, horizon + 1).

    A number is a constant signal. A sequence may be longer than the episode: the horizon sees what comes after its end, and
    beyond the end of the sequence its last value. A forecast has a row an interval: what is believed then of this interval
    and of the ``horizon`` next ones. Raises ValueError for unknown, missing, too short and not finite ones.
    """
    told = dict(given or {})
    unknown, missing = sorted(set(told) - set(names)), sorted(set(names) - set(told))
    if unknown:
        raise ValueError(f"given: unknown {unknown}, allowed are {', '.join(names) or '(none)'}")
    if missing:
        raise ValueError(f"given: missing {missing}, expected a sequence for each of {', '.join(names)}")
    out = {}
    for name in names:
        try:
            values = np.asarray(told[name], dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise ValueError(f"given: {name} = {told[name]!r}, allowed are numbers") from error
        if values.ndim == 0:
            values = np.full(steps, values)
        if values.ndim > 2 or (values.ndim == 2 and values.shape[1] != horizon + 1):
            raise ValueError(f"given: {name} has shape {values.shape}, allowed is (steps,) or a forecast (steps, {horizon + 1})")
        if len(values) < steps:
            raise ValueError(f"given: {name} has {counted(len(values), 'interval')}, allowed are at least the {steps} of the episode")
        if not np.all(np.isfinite(values)):
            where = np.argwhere(~np.isfinite(values))[0].tolist()
            raise ValueError(f"given: {name}{where} = {values[tuple(where)]}, allowed are finite numbers")
        out[name] = values
    return out


def windows(values: Sequence[NDArray[np.float64]], steps: int, horizon: int) -> NDArray[np.float64]:
    """What a controller sees of the signals at each interval, shape (steps, (horizon + 2) signals).

    Row k holds g_{k-1}, g_k, .., g_{k+N}, the signals of one instant next to each other; before the first interval they are as in it.
    """
    if not values:
        return np.zeros((steps, 0))
    at = np.arange(steps)
    parts = []
    for one in values:
        if one.ndim == 1:
            parts.append(one[np.clip(at[:, None] + np.arange(-1, horizon + 1), 0, len(one) - 1)])
        else:
            parts.append(np.hstack([one[np.maximum(at - 1, 0), :1], one[:steps]]))
    return np.stack(parts, axis=2).reshape(steps, -1)


def actual(values: Sequence[NDArray[np.float64]], steps: int) -> NDArray[np.float64]:
    """What the signals are in each interval, shape (steps, signals): of a forecast what it says of its own interval."""
    return np.stack([one[:steps] if one.ndim == 1 else one[:steps, 0] for one in values], axis=1) if values else np.zeros((steps, 0))
