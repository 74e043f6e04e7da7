"""A charge cut into windows of the state of charge: how quickly it passed them, and how far it was from its limits there."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from chargetune.battery.charging.problem import ChargingProblem
from chargetune.battery.validation import check_count
from chargetune.episode.episode import Episode

if TYPE_CHECKING:
    from chargetune.learning.black_box.composite import WindowOutputs

__all__ = ["ChargingWindows", "smoothed"]

# Intervals and SOC to either side that a smoothed sample is regressed on, the larger number of intervals, and no more than MOST.
LEAST, REACH, MOST = 5, 0.025, 30
# Noise of a signal without stated noise, as a share of its limit's tolerance: the solver's.
EXACT = 0.2
# A last, unfinished window has a rate once so large a share of its width was passed, or so much time spent in it, s.
SHARE, STUCK_s = 0.2, 120.0
# A rounding error of the SOC's interpolation; two edges closer than this are one.
TINY = 1e-6


@dataclass(frozen=True)
class ChargingWindows:
    """``windows`` equal parts of the SOC from 0 to 1; parts that the charge does not pass are left out.

    A second costs (z_d - z)^2 with z the window's middle, or with ``charge_time_to_soc`` 1 below it and 0 above.
    """

    # A study's configuration is this problem already, so its identity does not hold it twice.
    problem: ChargingProblem = field(metadata={"identity": False})
    windows: int = 20

    def __post_init__(self) -> None:
        check_count("windows", self.windows, 2, 100)

    @cached_property
    def edges(self) -> NDArray[np.float64]:
        """SOC at the edges of the windows, from that at the start to 1; the SOC that the time is counted to is one of them."""
        start, wanted = self.problem.episode.soc_start, self.problem.objective.charge_time_to_soc
        edges = np.linspace(0.0, 1.0, self.windows + 1)
        edges = np.sort(np.concatenate([[start], edges[edges > start], [] if wanted is None else [wanted]]))
        return np.asarray(edges[np.concatenate([[True], np.diff(edges) > TINY])], dtype=np.float64)

    @property
    def widths(self) -> NDArray[np.float64]:
        return np.diff(self.edges)

    @property
    def costs(self) -> NDArray[np.float64]:
        middle, wanted = (self.edges[:-1] + self.edges[1:]) / 2, self.problem.objective.charge_time_to_soc
        return (self.problem.episode.soc_target - middle) ** 2 if wanted is None else np.where(middle < wanted, 1.0, 0.0)

    @property
    def duration_s(self) -> float:
        return self.problem.episode.steps * self.problem.controller.sampling_time_s

    @property
    def tolerances(self) -> NDArray[np.float64]:
        return np.array([limit.tolerance for limit in self.problem.limits_by_name.values()])

    def window_outputs(self, episode: Episode) -> WindowOutputs:
        # torch is needed from here on only.
        from chargetune.learning.black_box.composite import WindowOutputs

        _, soc = episode.signal("soc")
        passed = np.maximum.accumulate(np.concatenate([[self.problem.episode.soc_start], np.nan_to_num(soc, nan=0.0)]))
        index = np.clip(np.searchsorted(self.edges, passed[1:], side="right") - 1, 0, len(self.widths) - 1)
        excess, spread = [], []
        for limit in self.problem.limits_by_name.values():
            noise = self.problem.sensors.noise_sd.get(limit.signal, 0.0)
            ends = np.stack(episode.signal(limit.signal), axis=1)
            share = np.zeros_like(ends)
            if noise > 0:
                ends, share = smoothed(ends, episode.input[:, 0], passed[1:])
            beyond = ends - limit.bound if limit.upper else limit.bound - ends
            deviation = np.hypot(noise * share, EXACT * limit.tolerance)
            excess.append([_worst(beyond[index == b]) for b in range(len(self.widths))])
            spread.append([_worst(deviation[index == b]) for b in range(len(self.widths))])
        return WindowOutputs(self._rate(passed, episode.sampling_time_s), np.array(excess), np.array(spread))

    def _rate(self, soc: NDArray[np.float64], sampling_time_s: float) -> NDArray[np.float64]:
        """SOC per second in each window; soc (K+1,) does not decrease."""
        time, last = sampling_time_s * np.arange(soc.size), soc[-1]
        # Where the SOC stands still the crossing is at the end of the standstill.
        rising = np.concatenate([np.diff(soc) > 0, [True]])
        at = np.interp(self.edges, soc[rising], time[rising])
        out = np.full(len(self.widths), np.nan)
        for b, (low, high) in enumerate(zip(self.edges[:-1], self.edges[1:], strict=True)):
            if high <= last:
                out[b] = (high - low) / (at[b + 1] - at[b])
            elif low < last and (last - low >= SHARE * (high - low) or time[-1] - at[b] >= STUCK_s):
                out[b] = (last - low) / (time[-1] - at[b])
        return out


def _worst(values: NDArray[np.float64]) -> float:
    finite = values[np.isfinite(values)]
    return float(finite.max()) if finite.size else np.nan


def smoothed(
    ends: NDArray[np.float64], current: NDArray[np.float64], soc: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Both ends (K, 2) of a noisy output regressed locally, and the factors by which its noise shrinks, (K, 2).

    At each interval on 1, t, t^2, t^3 and the current, which is known without noise: so its kinks and jumps stay sharp in the output.
    """
    count = len(current)
    n = min(2 * MOST + 1, count)
    first = np.clip(np.arange(count) - MOST, 0, count - n)
    index = first[:, None] + np.arange(n)
    away = index - np.arange(count)[:, None]
    close = (np.abs(away) <= LEAST) | (np.abs(soc[index] - soc[:, None]) <= REACH)
    # Near the ends of the record there are neighbours to one side only: as many as elsewhere.
    close |= np.abs(away) <= 2 * LEAST - np.minimum(np.minimum(np.arange(count), count - 1 - np.arange(count)), LEAST)[:, None]
    current = current / (np.abs(current).max() or 1.0)

    def features(t: NDArray[np.float64], i: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.stack([np.ones_like(t), t, t**2, t**3, i], axis=-1)

    values = np.concatenate([ends[index, 0], ends[index, 1]], axis=1)
    weight = np.concatenate([close, close], axis=1) & np.isfinite(values)
    scale = np.abs(away * close).max(axis=1, initial=1)[:, None].astype(float)
    mean = np.sum(current[index] * close, axis=1) / close.sum(axis=1)
    own, others = current - mean, current[index] - mean[:, None]
    rows = np.concatenate([features(away / scale, others), features((away + 1) / scale, others)], axis=1)
    at = np.stack([features(np.zeros(count), own), features(1 / scale[:, 0], own)], axis=1)
    weighted = rows * weight[..., None]
    normal = np.swapaxes(weighted, 1, 2) @ rows
    # Where the current is constant its coefficient has no meaning and is 0.
    normal += 1e-9 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(5) + 1e-12 * np.eye(5)
    hat = at @ np.linalg.solve(normal, np.swapaxes(weighted, 1, 2))
    out = np.einsum("kij,kj->ki", hat, np.nan_to_num(values))
    return np.where(np.isfinite(ends), out, np.nan), np.asarray(np.sqrt((hat**2).sum(axis=-1)))
