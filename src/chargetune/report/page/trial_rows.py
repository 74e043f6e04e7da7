"""A study as plain data for JSON: what it is about, and one row a trial."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from typing import Any

from numpy.typing import NDArray

from chargetune.episode.episode import Episode
from chargetune.episode.score import Score
from chargetune.report.best_possible import best_possible
from chargetune.report.figures.convergence import drawn_limits, linear_within, loss
from chargetune.report.study_view import StudyView
from chargetune.report.words import MetricWords, limits_of_study, metrics_of_study, objective_of_study
from chargetune.study.trial import Trial, TrialStatus

__all__ = ["objective_text", "study_head", "study_summary", "theta_document", "trace_csv", "trial_rows"]


def study_head(view: StudyView) -> dict[str, Any]:
    """What does not change from trial to trial: names, limits, the entries of theta with unit and bounds, tuner, provenance.

    ``objective`` says what the ``value`` of a row is, ``excesses`` what its excesses are, each in its unit and with its tolerance.
    """
    record, problem, space = view.record, view.problem, view.space
    words, drawn = objective_of_study(view), {limit.name for limit in drawn_limits(view)}
    possible = best_possible(view)
    units = [p.unit for p in space.parameters for _ in range(p.size)]
    scales = [p.scale for p in space.parameters for _ in range(p.size)]
    return {
        "id": None if record is None else record.id,
        "name": view.name,
        "created_at": "" if record is None else record.created_at,
        "tuner": view.tuner,
        "cell": "" if problem is None else problem.cell.title,
        "remark": view.remark,
        "objective": {
            "label": words.axis,
            "short": f"{words.short} ({words.unit})" if words.unit else words.short,
            "most": words.most,
            "larger": words.factor < 0,
            "comparable": view.comparable,
            "possible": None if possible is None else _finite(words.factor * possible),
        },
        "excesses": [
            {
                "name": limit.name,
                "label": limit.label,
                "unit": limit.unit,
                "tolerance": limit.tolerance,
                "judged": limit.judged if limit.samples > 1 else "",
                "drawn": limit.name in drawn,
                "within": linear_within(view, limit),
            }
            for limit in limits_of_study(view)
        ],
        "metrics": {name: [metric.label, metric.unit] for name, metric in metrics_of_study(view).items()},
        "limits": limits_of(view),
        "theta": [
            {
                "entry": entry,
                "unit": "" if u == "1" else u,
                "lower": float(low),
                "upper": float(high),
                "untuned": float(start),
                "scale": scale,
            }
            for entry, u, low, high, start, scale in zip(space.entries, units, space.lower, space.upper, space.default, scales, strict=True)
        ],
    }


def limits_of(view: StudyView) -> list[dict[str, Any]]:
    """Every limit of a charge: name, bound, unit, tolerance, and how the controller treats it; empty for another system."""
    problem = view.problem
    if problem is None:
        return []
    bounds = [("current_min_A", problem.limits.current_min_A), ("current_max_A", problem.current_max_A)]
    inputs = [{"name": n, "bound": b, "unit": "A", "tolerance": 0.0, "kind": "bound of the input"} for n, b in bounds if b is not None]
    kinds = {"soft": "kept by a penalty", "hard": "kept at any price", "scored": "not seen by the controller, scored"}
    outputs = [
        {"name": limit.name, "bound": limit.bound, "unit": limit.unit, "tolerance": limit.tolerance, "kind": kinds[limit.kind]}
        for limit in problem.limits_by_name.values()
    ]
    return inputs + outputs


def trial_rows(view: StudyView, trials: Sequence[Trial]) -> list[dict[str, Any]]:
    """One row a trial. ``value`` is what it was worth and ``excesses`` are its excesses, in the words and units of the head.

    Both are None without a score. ``counted``: it may be the incumbent, being within the limits, or for the tuner "ei" scored.
    """
    words, limits, metrics = objective_of_study(view), limits_of_study(view), metrics_of_study(view)
    return [
        {
            "number": trial.number,
            "status": trial.status.value,
            "ending": trial.ending or "",
            "feasible": None if trial.score is None else trial.feasible,
            "counted": trial.score is not None and (view.tuner == "ei" or trial.feasible),
            "value": _finite(words.factor * loss(view, trial)),
            "excesses": {
                limit.name: None if trial.score is None else _finite(limit.factor * trial.score.excess.get(limit.name, math.nan))
                for limit in limits
            },
            "metrics": {} if trial.score is None else _told(metrics, trial.score),
            "theta": [_finite(v) for v in trial.theta],
            "asked_at": trial.asked_at,
            "told_at": trial.told_at or "",
            "trace": trial.trace_sha256 is not None,
        }
        for trial in trials
    ]


def _told(metrics: Mapping[str, MetricWords], score: Score) -> dict[str, float | None]:
    found = {name: score.metrics.get(name) for name in metrics}
    return {name: None if value is None else _finite(metrics[name].factor * value) for name, value in found.items()}


def objective_text(view: StudyView, trial: Trial | None) -> str:
    """What a trial was worth, in the words of its study: "t80 24.33 min"; empty without a score."""
    if trial is None or trial.score is None:
        return ""
    words = objective_of_study(view)
    return f"{words.short} {words.text(loss(view, trial))} {words.unit}".rstrip()


def study_summary(view: StudyView) -> dict[str, Any]:
    """One line of a list of studies."""
    best = view.tuned
    return {
        "id": None if view.record is None else view.record.id,
        "name": view.name,
        "created_at": "" if view.record is None else view.record.created_at,
        "tuner": view.tuner,
        "done": sum(t.status is TrialStatus.DONE for t in view.trials),
        "running": sum(t.status is TrialStatus.RUNNING for t in view.trials),
        "failed": sum(t.status is TrialStatus.FAILED for t in view.trials),
        "violating": sum(t.score is not None and not t.score.feasible for t in view.trials),
        "best": None if best is None or not best.feasible else best.number,
        "result": view.result.facts(),
        "best_objective": objective_text(view, best) if best is not None and best.feasible else "",
        "told_at": max((t.told_at or "" for t in view.trials), default=""),
    }


def theta_document(view: StudyView, trial: Trial) -> dict[str, Any]:
    """theta of one trial to take along: ``theta`` is what `chargetune simulate --theta` and `ParameterSpace.from_dict` accept."""
    parts = view.space.slices
    return {
        "study": view.name,
        "trial": trial.number,
        "status": trial.status.value,
        "limits_kept": None if trial.score is None else trial.score.feasible,
        "theta": {p.name: list(trial.theta[parts[p.name]]) if p.size > 1 else trial.theta[parts[p.name]][0] for p in view.space.parameters},
        "units": {p.name: p.unit for p in view.space.parameters},
        "provenance": dict(trial.provenance),
    }


def trace_csv(episode: Episode) -> str:
    """A trace as CSV: one row an interval, units in the headings, every number to the last bit.

    Outputs have two columns, ``name`` at the start of the interval and ``name end``; ``true`` ones follow where they are known.
    """
    columns: dict[str, NDArray[Any]] = {"time_s": episode.time_s}
    for i, (name, unit) in enumerate(zip(episode.input_names, episode.input_units, strict=True)):
        columns[_heading(name, unit)] = episode.input[:, i]
    pairs = [("", episode.output_start, episode.output_end)]
    if episode.true_start is not None and episode.true_end is not None:
        pairs.append(("true ", episode.true_start, episode.true_end))
    for before, starts, ends in pairs:
        for i, (name, unit) in enumerate(zip(episode.output_names, episode.output_units, strict=True)):
            columns[f"{before}{_heading(name, unit)}"] = starts[:, i]
            columns[f"{before}{_heading(name, unit)} end"] = ends[:, i]
    columns |= {f"estimated {name}": episode.estimate[:, i] for i, name in enumerate(episode.estimate_names)}
    columns |= {"solver status": episode.status, "solver residual": episode.kkt, "solver iterations": episode.iterations}
    text = io.StringIO()
    writer = csv.writer(text)
    writer.writerow(columns)
    writer.writerows(zip(*(values.tolist() for values in columns.values()), strict=True))
    return text.getvalue()


def _heading(name: str, unit: str) -> str:
    return name if unit == "1" or name.endswith(f"_{unit}") else f"{name} [{unit}]"


def _finite(value: float | None) -> float | None:
    return float(f"{value:.8g}") if value is not None and math.isfinite(value) else None
