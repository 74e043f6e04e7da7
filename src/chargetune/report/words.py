"""What the numbers of any study are called: of a charge by its settings, of another system by its own names and its traces' units."""

from __future__ import annotations

from dataclasses import dataclass, replace

from chargetune.battery.charging.wording import LimitWords, ObjectiveWords, limit_words, metric_words, objective_words
from chargetune.report.study_view import StudyView

__all__ = ["MetricWords", "limits_of_study", "metrics_of_study", "objective_of_study"]


@dataclass(frozen=True)
class MetricWords:
    """How a figure of merit is told: ``factor`` times what is stored, in ``unit``."""

    label: str
    unit: str
    factor: float = 1.0


def limits_of_study(view: StudyView) -> list[LimitWords]:
    """Every limit that the scores have, in their order, with the tolerance that the trials were judged by."""
    scores = [t.score for t in view.trials if t.score is not None]
    names = dict.fromkeys(name for score in scores for name in score.excess)
    problem = view.judged
    if problem is not None and not names:
        names = dict.fromkeys(problem.limits_by_name)
    out = []
    for name in names:
        if problem is not None and name in problem.limits_by_name:
            one = limit_words(problem, problem.limits_by_name[name])
        else:
            unit = view.units.get(name, "")
            unit = "" if unit == "1" else unit
            one = LimitWords(name, f"{name} beyond its limit", f"{name}\n{f'({unit})' if unit else ''}".strip(), unit, 1.0, None)
        allowed = {score.tolerance.get(name, 0.0) for score in scores}
        if scores:
            one = replace(one, tolerance=one.factor * allowed.pop() if len(allowed) == 1 else None)
        out.append(one)
    return out


def objective_of_study(view: StudyView) -> ObjectiveWords:
    """What the tuner of this study makes small, in its own words and unit."""
    if view.problem is not None:
        return objective_words(view.problem, view.tuner)
    return ObjectiveWords("-G", "-G") if view.tuner == "ei" else ObjectiveWords("objective (larger is better)", "objective", factor=-1.0)


def metrics_of_study(view: StudyView) -> dict[str, MetricWords]:
    """Every figure of merit that some trial has a number for; the others, such as a time that none reached, would be rows of dashes."""
    told = dict.fromkeys(n for t in view.trials if t.score is not None for n, value in t.score.metrics.items() if value is not None)
    out = {name: MetricWords(*metric_words(name)) for name in told}
    if "objective_worst" in out:
        # An objective as it is stored, which is told as the mean over the plants is.
        words = objective_of_study(view)
        out["objective_worst"] = MetricWords(f"{words.short}, worst plant", words.unit, -words.factor)
    return out
