"""The verdict on a charge: what it is worth, by how much each limit was exceeded, and figures of merit."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from chargetune.battery.charging.limits import Limit
from chargetune.battery.charging.metrics import charging_metrics, crossing_minutes
from chargetune.battery.charging.problem import ChargingProblem
from chargetune.episode.episode import Episode
from chargetune.episode.score import Score
from chargetune.episode.score_limits import ScoredLimit, Windows, limit_samples, score_limits, violation

__all__ = ["NotMeasuredError", "charge_samples", "charge_time", "judgement", "score_episode", "violation_mVs"]

# The largest of some hundred means is that many standard deviations above the truth.
NOISE_SD = 3.0


class NotMeasuredError(ValueError):
    """An episode has no verdict, because a measurement that it needs is missing or not finite."""


def score_episode(problem: ChargingProblem, episode: Episode, *, metrics: bool = True, soc_start: float | None = None) -> Score:
    """The verdict on what was measured, without figures for people where ``metrics`` is False.

    Objective of the paper: G = -sum_{k=0..K} c1 (z_d - z_k)^2 - sum_{k<K} max(0, V_k - v_max)^2, V_k the larger of the voltages at
    both ends of interval k. The constrained objective is the mean of -(z_d - z_k)^2 without c1; with ``charge_time_to_soc`` z* it is
    -t/T instead, t the time to z* and T that of the episode, or -(1 + z* - z_K) where the charge ends at z_K below z*. Each limit is
    scored on its own, upper voltage, temperature and anode potential also in ``soc_windows`` equal parts of the SOC, and as moving
    mean over ``verdict_samples`` intervals where the signal's sensor has noise: then three standard deviations of that mean belong
    to the tolerance, since they are no violation that was seen.
    ``soc_start``: the SOC that the episode began at, where it is not the problem's own.

    Raises NotMeasuredError when a measurement is not a number.
    """
    limits, objective, settings = problem.limits_by_name, problem.objective, problem.episode
    _, soc = episode.signal("soc")
    measured = [values for limit in limits.values() for values in episode.signal(limit.signal)]
    if not (len(soc) and all(np.all(np.isfinite(values)) for values in (*measured, soc))):
        names = ", ".join(dict.fromkeys([*(limit.signal for limit in limits.values()), "soc"]))
        raise NotMeasuredError(f"the episode has no score: a measurement of {names} is missing or not finite")
    start = settings.soc_start if soc_start is None else soc_start
    deficit = (settings.soc_target - np.concatenate([[start], soc])) ** 2
    wanted = objective.charge_time_to_soc
    over = np.maximum(0.0, limits["voltage_max_V"].excess(episode)) ** 2
    evaluation = score_limits(
        episode,
        _scored(problem),
        objective=lambda _: -float(np.mean(deficit)) if wanted is None else _quickness(wanted, start, soc),
        performance=lambda _: -float(objective.c1 * np.sum(deficit) + np.sum(over)),
        windows=_windows(problem),
        metrics=lambda _: _metrics(problem, episode, start) if metrics else {},
    )
    if evaluation.score is None:
        raise NotMeasuredError(f"the episode has no score: {evaluation.ending}")
    return evaluation.score


def charge_samples(problem: ChargingProblem, episode: Episode) -> dict[str, tuple[NDArray[np.float64], NDArray[np.int_]]]:
    """By limit its excess in every interval, as judged, and the window of the SOC that the interval ends in; 0 without a profile."""
    return limit_samples(episode, _scored(problem), _windows(problem))


def _scored(problem: ChargingProblem) -> list[ScoredLimit]:
    return [limit.scored(*judgement(problem, limit)) for limit in problem.limits_by_name.values()]


def _windows(problem: ChargingProblem) -> Windows:
    return Windows("soc", 0.0, 1.0, problem.objective.soc_windows)


def judgement(problem: ChargingProblem, limit: Limit) -> tuple[int, float]:
    """(intervals of the moving mean, excess still called kept): of a noisy signal what `NOISE_SD` sd of that mean may be."""
    noise = problem.sensors.noise_sd.get(limit.signal, 0.0)
    count = problem.objective.verdict_samples if noise > 0 else 1
    return count, limit.tolerance + NOISE_SD * noise / count**0.5


def charge_time(problem: ChargingProblem, score: Score) -> tuple[str, float | None]:
    """(its name, minutes) of the charging time that is the objective, else of that to 95 % SOC; None where it was not reached."""
    mark = problem.objective.charge_time_to_soc or 0.95
    name = f"t{100 * mark:.3g}"
    if f"{name}_min" in score.metrics:
        return name, score.metrics[f"{name}_min"]
    share = -score.objective
    return name, share * problem.episode.steps * problem.controller.sampling_time_s / 60 if share <= 1.0 else None


def violation_mVs(problem: ChargingProblem, episode: Episode) -> float:
    """Excess of the upper voltage limit beyond its tolerance, in the moving mean of the verdict, over time, mV s.

    An interval of which no sample is left counts as those beside it do, by linear interpolation: a lost sample is no kept
    limit. 0 where nothing at all was measured.
    """
    limit = problem.limits_by_name["voltage_max_V"]
    return 1e3 * violation(episode, limit.scored(*judgement(problem, limit)))


def _metrics(problem: ChargingProblem, episode: Episode, start: float) -> dict[str, float | None]:
    metrics = charging_metrics(episode, problem.voltage_max_V, start)
    # The current is an input and bounded hard; that it was is told, but it is nothing to learn.
    metrics["violation_mVs"] = violation_mVs(problem, episode)
    metrics["current_max_excess_A"] = float(np.max(episode.input[:, 0]) - problem.current_max_A)
    for limit in problem.limits_by_name.values():
        if limit.of != "voltage":
            metrics |= limit.metrics(episode)
    return metrics


def _quickness(wanted: float, start: float, soc: NDArray[np.float64]) -> float:
    time = np.arange(soc.size + 1) / soc.size
    reached = crossing_minutes(60 * time, np.concatenate([[start], soc]), wanted)
    return -float(reached if reached is not None else 1.0 + wanted - soc[-1])
