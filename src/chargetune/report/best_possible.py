"""The best that a controller could reach on the plant of a study: a reference for its figures."""

from __future__ import annotations

from chargetune.battery.baselines.comparison import plant_oracle
from chargetune.battery.charging.problem import ChargingProblem, judged_exactly
from chargetune.report.study_view import StudyView
from chargetune.runtime.cache import built_once

__all__ = ["best_possible"]


def best_possible(view: StudyView) -> float | None:
    """The loss of the plant oracle, in what the tuner makes small; None where it is not known.

    It is found where the plant is a circuit, on which it takes about a second. An electrochemical plant would take
    minutes; on the drawn plants of a range of use there is one for each.
    """
    if view.problem is None or view.problem.plant_cell is None or view.over_range:
        return None
    return _loss(judged_exactly(view.problem), by_performance=view.tuner == "ei")


@built_once(16)
def _loss(problem: ChargingProblem, *, by_performance: bool) -> float | None:
    found = plant_oracle(problem)
    if found is None or found.score is None:
        return None
    return -(found.score.performance if by_performance else found.score.objective)
