"""Figures of merit of one charge."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from chargetune.episode.episode import Episode

__all__ = ["SOC_MARKS", "charging_metrics", "crossing_minutes"]

SOC_MARKS = (0.80, 0.90, 0.95, 0.99)


def crossing_minutes(time_s: NDArray[np.float64], soc: NDArray[np.float64], mark: float) -> float | None:
    """When the SOC first reaches ``mark``, in minutes, by linear interpolation; None when it never does."""
    reached = np.flatnonzero(soc >= mark)
    if not reached.size:
        return None
    k = int(reached[0])
    if k == 0:
        return float(time_s[0] / 60)
    share = (mark - soc[k - 1]) / (soc[k] - soc[k - 1])
    return float((time_s[k - 1] + share * (time_s[k] - time_s[k - 1])) / 60)


def charging_metrics(episode: Episode, voltage_max_V: float, soc_start: float) -> dict[str, float | None]:
    """t80, t90, t95, t99 in minutes; worst overshoot in mV (signed) and its integral in mV s; CC-CV switch; failures.

    The integral takes the mean of the overshoot at both ends of an interval. ``switch_min`` is when the current first
    falls below 99 % of its largest value.
    """
    start, end = episode.signal("voltage_V")
    _, soc = episode.signal("soc")
    step = episode.sampling_time_s
    time = np.concatenate([[0.0], episode.time_s + step])
    charge = np.concatenate([[soc_start], soc])
    over = np.maximum(0.0, np.stack([start, end]) - voltage_max_V)
    current = episode.input[:, episode.input_names.index("current_A")]
    below = np.flatnonzero(current < 0.99 * np.max(current))
    out: dict[str, float | None] = {f"t{round(100 * m)}_min": crossing_minutes(time, charge, m) for m in SOC_MARKS}
    out["overshoot_mV"] = float(1e3 * (np.max(np.stack([start, end])) - voltage_max_V))
    out["overshoot_mVs"] = float(1e3 * step * np.sum(over.mean(axis=0)))
    out["switch_min"] = float(episode.time_s[below[0]] / 60) if below.size else None
    out["soc_end"] = float(soc[-1])
    out["solver_failures"] = float(episode.failures)
    return out
