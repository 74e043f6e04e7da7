"""Every limit of a charge, judged again from the stored trace alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from chargetune.battery.charging.problem import ChargingProblem
from chargetune.battery.charging.verdict import judgement
from chargetune.episode.episode import Episode
from chargetune.episode.score import Score

__all__ = ["LimitCheck", "recheck"]

# Largest difference to the stored excess that is rounding, relative to the bound.
ROUNDING = 1e-9


@dataclass(frozen=True)
class LimitCheck:
    """One limit: the worst value reached and when, its excess beyond the bound (signed), and what the store says.

    ``judged`` says on what: the samples, or their moving mean. ``true_excess`` is that of the noise-free signal, where the plant
    was simulated. ``stored`` is the excess in the score, None for the input's bounds, which the score does not judge.
    """

    name: str
    bound: float
    tolerance: float
    reached: float
    at_s: float
    excess: float
    judged: str
    stored: float | None
    true_excess: float | None

    @property
    def kept(self) -> bool:
        return self.excess <= self.tolerance

    @property
    def agrees(self) -> bool:
        """Whether the stored score says the same."""
        return self.stored is None or abs(self.excess - self.stored) <= ROUNDING * max(1.0, abs(self.bound))


def recheck(problem: ChargingProblem, episode: Episode, score: Score | None) -> list[LimitCheck]:
    """Each limit over all samples, both ends of every interval, by a formula of its own. Empty for an episode without samples."""
    if not len(episode):
        return []
    current = episode.input[:, episode.input_names.index("current_A")]
    at_start = episode.time_s
    out = []
    for name, bound, upper in (("current_min_A", problem.limits.current_min_A, False), ("current_max_A", problem.current_max_A, True)):
        # What a held input cannot resolve is no excess.
        worst = int(np.argmax(current) if upper else np.argmin(current))
        excess = float(current[worst] - bound if upper else bound - current[worst])
        out.append(LimitCheck(name, bound, 1e-9, float(current[worst]), float(at_start[worst]), excess, "input", None, None))
    stored = {} if score is None else score.excess
    for limit in problem.limits_by_name.values():
        samples, tolerance = judgement(problem, limit)
        reached, at_s = _worst(episode, limit.signal, samples, upper=limit.upper, true=False)
        true, _ = _worst(episode, limit.signal, 1, upper=limit.upper, true=True) if episode.true_end is not None else (None, 0.0)
        judged = "samples" if samples == 1 else f"mean of {samples} intervals"
        sign = 1.0 if limit.upper else -1.0
        out.append(
            LimitCheck(
                limit.name,
                limit.bound,
                tolerance,
                reached,
                at_s,
                sign * (reached - limit.bound),
                judged,
                stored.get(limit.name),
                None if true is None else sign * (true - limit.bound),
            )
        )
    return out


def _worst(episode: Episode, signal: str, samples: int, *, upper: bool, true: bool) -> tuple[float, float]:
    """The extreme value of a signal among those measured, and its time in seconds; nan where none was."""
    best, when = np.nan, 0.0
    for shift, values in zip((0.0, episode.sampling_time_s), episode.signal(signal, true=true), strict=True):
        smooth = _means(values, samples)
        if np.all(np.isnan(smooth)):
            continue
        k = int(np.nanargmax(smooth) if upper else np.nanargmin(smooth))
        if np.isnan(best) or ((smooth[k] > best) if upper else (smooth[k] < best)):
            best, when = float(smooth[k]), float(episode.time_s[k] + shift)
    return best, when


def _means(values: NDArray[np.float64], samples: int) -> NDArray[np.float64]:
    """Centred means of what was measured, summed anew for each place: slower than a running sum, and with none of its rounding."""
    if samples == 1:
        return values
    before, after = samples // 2, (samples - 1) // 2
    parts = [values[max(0, k - before) : k + after + 1] for k in range(len(values))]
    return np.array([np.mean(part[np.isfinite(part)]) if np.isfinite(part).any() else np.nan for part in parts])
