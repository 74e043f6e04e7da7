"""The verdict on an episode by limits of its measured outputs."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from chargetune.episode.episode import Ending, Episode
from chargetune.episode.score import Score, in_tolerances
from chargetune.runtime.numeric import is_finite, is_integer

__all__ = ["Evaluation", "ScoredLimit", "Windows", "limit_samples", "moving_mean", "score_limits", "violation", "worst_by_window"]


@dataclass(frozen=True)
class ScoredLimit:
    """lower <= signal <= upper at both ends of every interval, as measured; the excess is max(signal - upper, lower - signal).

    signal
        An output of the plant.
    tolerance
        The excess still called kept, in the unit of the signal (measurement resolution, solver tolerance).
    name
        Of the limit in the score; by default that of the signal. Two limits of one signal need two names.
    samples
        Of a noisy signal the moving mean of so many intervals is judged (`moving_mean`): the largest of many noisy samples is no excess.
    by_window
        False leaves this limit out of the profile.
    """

    signal: str
    lower: float | None = None
    upper: float | None = None
    tolerance: float = 0.0
    name: str = ""
    samples: int = 1
    by_window: bool = True

    def __post_init__(self) -> None:
        if not self.name:
            object.__setattr__(self, "name", self.signal)
        if self.lower is None and self.upper is None:
            raise ValueError(f"limit {self.name}: neither lower nor upper is given")
        for field in ("lower", "upper", "tolerance"):
            value = getattr(self, field)
            if value is not None and not is_finite(value):
                raise ValueError(f"limit {self.name}: {field} = {value!r}, allowed is a finite number")
        if self.lower is not None and self.upper is not None and self.lower >= self.upper:
            raise ValueError(f"limit {self.name}: lower = {self.lower} must be less than upper = {self.upper}")
        if self.tolerance < 0:
            raise ValueError(f"limit {self.name}: tolerance = {self.tolerance!r}, allowed is >= 0")
        if not is_integer(self.samples) or self.samples < 1:
            raise ValueError(f"limit {self.name}: samples = {self.samples!r}, allowed is an integer >= 1")

    def excess(self, episode: Episode) -> NDArray[np.float64]:
        """By how much each interval is beyond the limit, the worse of its two ends, shape (K,).

        A lost sample (no finite number) is left out; nan where nothing is known of an interval. Where the true output of a simulation is
        no finite number, nothing was lost: the limit is not kept, and the interval is not known.
        """
        start, end = self.excess_at_ends(episode)
        worse = np.fmax(start, end)
        if episode.true_start is not None and not np.isfinite(np.sum(episode.signal(self.signal, true=True))):
            invalid = ~np.all(np.isfinite(episode.signal(self.signal, true=True)), axis=0)
            worse = np.where(invalid, np.nan, worse)
        return np.asarray(worse, dtype=np.float64)

    def excess_at_ends(self, episode: Episode) -> NDArray[np.float64]:
        """The excess at both ends of each interval, shape (2, K); nan where it is not known."""
        values = _known(np.stack(episode.signal(self.signal)))
        if self.samples > 1:
            values = np.stack([moving_mean(v, self.samples) for v in values])
        # One side costs no maximum: safe mode judges a thousand episodes for a proposal.
        above = None if self.upper is None else values - self.upper
        below = None if self.lower is None else self.lower - values
        if above is None or below is None:
            return np.asarray(below if above is None else above, dtype=np.float64)
        return np.asarray(np.maximum(above, below), dtype=np.float64)


@dataclass(frozen=True)
class Windows:
    """``count`` equal parts of [lower, upper] of an output, by its value at the end of an interval; the outer ones have no end."""

    signal: str
    lower: float
    upper: float
    count: int

    def __post_init__(self) -> None:
        if not (is_finite(self.lower) and is_finite(self.upper) and self.lower < self.upper):
            raise ValueError(f"windows of {self.signal}: [{self.lower!r}, {self.upper!r}], allowed are finite numbers, the first one less")
        if not is_integer(self.count) or self.count < 1:
            raise ValueError(f"windows of {self.signal}: count = {self.count!r}, allowed is an integer >= 1")

    def of(self, episode: Episode) -> NDArray[np.int_]:
        """The window of each interval, shape (K,), from 0 on. Where the signal was lost it is what lies between its neighbours."""
        _, values = episode.signal(self.signal)
        known = np.isfinite(values)
        if not known.any():
            return np.zeros(values.size, dtype=np.int_)
        if not known.all():
            at = np.arange(values.size)
            values = np.interp(at, at[known], values[known])
        share = (values - self.lower) / (self.upper - self.lower)
        return np.clip(np.floor(share * self.count).astype(np.int_), 0, self.count - 1)


class Evaluation(NamedTuple):
    """What `Study.run` wants of an evaluation: the score or None, the episode, and how it ended, or why it has no score."""

    score: Score | None
    episode: Episode
    ending: str


def score_limits(
    episode: Episode,
    limits: Sequence[ScoredLimit],
    *,
    objective: Callable[[Episode], float],
    performance: Callable[[Episode], float] | None = None,
    penalty: float = 1.0,
    windows: Windows | None = None,
    metrics: Callable[[Episode], Mapping[str, float | None]] | None = None,
) -> Evaluation:
    """The verdict on an episode; it is what an evaluation of `Study.run` returns.

    An episode that did not come to its end (`Ending.DONE`) has no score: over fewer intervals less is summed, and so it would look
    better. Nor has one with an interval of which nothing is known of a limited signal, nor one whose objective or performance is no
    finite number. ``ending`` then says why, and the functions are called for none but an episode that was DONE.

    objective
        Episode -> the number to be maximised, without penalties.
    performance
        Episode -> G, penalties included. By default, with e_l the excess of limit l and t_l its tolerance,

            G = objective - penalty sum_l max(0, (e_l - t_l) / t_l)

        so that ``penalty`` is what a violation of one more tolerance costs, in the unit of the objective.
    windows
        With them the score has the profile of the limits.
    metrics
        Episode -> figures for people; ``unsolved_percent``, the share of control steps that were not solved, is always one of them.

    Raises ValueError for unknown signals and for two limits of one name.
    """
    names = [limit.name for limit in limits]
    if len(set(names)) < len(names):
        raise ValueError(f"limits are named {names}, allowed are different names")
    if episode.ending is not Ending.DONE or not len(episode):
        return Evaluation(None, episode, ": ".join(filter(None, (episode.ending.value, episode.message))))
    samples = limit_samples(episode, limits, windows)
    lost = [limit.signal for limit in limits if not np.all(np.isfinite(samples[limit.name][0]))]
    if lost:
        return Evaluation(None, episode, f"{Ending.SENSOR.value}: of {', '.join(dict.fromkeys(lost))} not every interval was measured")
    excess = {name: float(np.max(values)) for name, (values, _) in samples.items()}
    worth = float(objective(episode))
    if performance is None:
        beyond = [float(in_tolerances(excess[limit.name], limit.tolerance)) for limit in limits]
        total = worth - penalty * sum(max(0.0, value) for value in beyond)
    else:
        total = float(performance(episode))
    for name, value in (("objective", worth), ("performance", total)):
        if not math.isfinite(value):
            return Evaluation(None, episode, f"not scored: {name} = {value}")
    score = Score(
        objective=worth,
        performance=total,
        excess=excess,
        tolerance={limit.name: limit.tolerance for limit in limits},
        metrics={"unsolved_percent": 100 * episode.unsolved_share, **({} if metrics is None else metrics(episode))},
        profile={}
        if windows is None
        else {limit.name: worst_by_window(*samples[limit.name], windows.count) for limit in limits if limit.by_window},
    )
    return Evaluation(score, episode, episode.ending.value)


def limit_samples(
    episode: Episode, limits: Sequence[ScoredLimit], windows: Windows | None = None
) -> dict[str, tuple[NDArray[np.float64], NDArray[np.int_]]]:
    """By limit its excess in every interval, and the window of the profile that the interval counts in, 0 without one; shapes (K,)."""
    first = np.zeros(len(episode), dtype=np.int_)
    window = first if windows is None else windows.of(episode)
    return {limit.name: (limit.excess(episode), window if limit.by_window else first) for limit in limits}


def worst_by_window(excess: NDArray[np.float64], window: NDArray[np.int_], count: int) -> tuple[float | None, ...]:
    """The worst excess in each of so many windows; None where no interval ended."""
    worst = np.full(count, -np.inf)
    np.maximum.at(worst, window, excess)
    return tuple(None if value == -np.inf else float(value) for value in worst)


def violation(episode: Episode, limit: ScoredLimit) -> float:
    """sum_k max(0, e_k - tolerance) dt, in the unit of the signal times s, >= 0.

    An interval of which nothing is known counts as those beside it do, by linear interpolation: a lost sample is no kept limit.
    0 where nothing at all was measured.
    """
    excess = limit.excess(episode)
    known, at = np.isfinite(excess), np.arange(excess.size)
    if not known.any():
        return 0.0
    beyond = np.maximum(0.0, np.interp(at, at[known], excess[known]) - limit.tolerance)
    return float(episode.sampling_time_s * np.sum(beyond))


def moving_mean(values: NDArray[np.float64], samples: int) -> NDArray[np.float64]:
    """Centred mean of ``samples`` neighbours, fewer at the ends, shape unchanged.

    A value that is no finite number is a lost one: the mean is that of the others, and nan where all are lost.
    """
    if samples == 1:
        return values
    known = np.isfinite(values)
    total, count = (np.concatenate([[0.0], np.cumsum(v)]) for v in (np.where(known, values, 0.0), known))
    at = np.arange(values.size)
    first = np.maximum(at - samples // 2, 0)
    beyond = np.minimum(at + (samples - 1) // 2 + 1, values.size)
    counted = count[beyond] - count[first]
    mean = (total[beyond] - total[first]) / np.maximum(counted, 1.0)
    return np.asarray(np.where(counted > 0, mean, np.nan), dtype=np.float64)


def _known(values: NDArray[np.float64]) -> NDArray[np.float64]:
    finite = np.isfinite(values)
    return values if finite.all() else np.asarray(np.where(finite, values, np.nan), dtype=np.float64)
