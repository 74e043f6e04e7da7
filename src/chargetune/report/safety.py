"""What safe mode promised of each trial, and what the trials spent of its budget."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from chargetune.battery.charging.verdict import violation_mVs
from chargetune.battery.studies.open_study import make_tuner
from chargetune.battery.studies.study_file import TwinTable
from chargetune.episode.episode import Episode
from chargetune.episode.score import Score
from chargetune.report.study_view import StudyView
from chargetune.study.trial import Trial, TrialStatus

__all__ = ["Promise", "predicted_probabilities", "spent_mVs"]


@dataclass(frozen=True)
class _Told:
    """A trial with a reader of its episode, as a tuner reads it."""

    number: int
    theta: Sequence[float]
    status: str
    score: Score | None
    kept: Episode | None

    def episode(self) -> Episode | None:
        return self.kept


@dataclass(frozen=True)
class Promise:
    """A trial of safe mode and what was predicted of it.

    ``probability`` of keeping every limit is that of the twin of the trials before it, None for a start that was declared.
    ``spent`` is what the trial was beyond the limit, ``total`` that of all up to it, mV s.
    """

    trial: Trial
    probability: float | None
    spent: float
    total: float


def spent_mVs(view: StudyView) -> dict[int, float]:
    """By number what each trial was beyond limit and tolerance of the voltage, over time; one that was ended counts by its trace."""
    problem = view.problem
    if problem is None:
        return {}
    spent = {}
    for trial in view.trials:
        if trial.score is not None:
            spent[trial.number] = float(trial.score.metrics.get("violation_mVs") or 0.0)
        elif trial.status is TrialStatus.FAILED:
            episode = next((r.episode for r in view.readings([trial])), None)
            spent[trial.number] = violation_mVs(problem, episode) if episode is not None and len(episode) else 0.0
    return spent


def predicted_probabilities(view: StudyView) -> list[Promise]:
    """Of a safe study each told trial with its promise, told again by the twin; empty for another study.

    A trial is predicted from those before it alone, on plants that the search for it did not see (`Proposal.fresh`): the twin of a study
    is a function of its trials.
    """
    problem, record = view.problem, view.record
    if problem is None or problem.safety is None or record is None:
        return []
    from chargetune.learning.candidates import Proposal
    from chargetune.learning.twin.ensemble import condition
    from chargetune.learning.twin_tuner import TwinTuner

    unknown = record.identity["config"].get("twin")
    tuner = make_tuner("twin", int(record.identity["seed"]), problem, TwinTable(**unknown) if unknown else None)
    if not isinstance(tuner, TwinTuner) or tuner.safety is None:
        return []
    spent, total = spent_mVs(view), 0.0
    out: list[Promise] = []
    before: list[_Told] = []
    for reading in view.readings(t for t in view.trials if t.status is not TrialStatus.RUNNING and t.number >= 0):
        trial, chance = reading.trial, None
        if before or tuner.safety.start is None:
            ensemble = condition(tuner.loop, before, tuner.settings)
            seed = tuner.seed if ensemble.discrepancy is None else tuner.seed + 7919 * len(before)
            fresh = Proposal(view.space, ensemble, before, tuner.safety.probability, seed).fresh(np.array(trial.theta))
            chance = fresh.probability()
        total += spent.get(trial.number, 0.0)
        out.append(Promise(trial, chance, spent.get(trial.number, 0.0), total))
        before.append(_Told(trial.number, trial.theta, trial.status.value, trial.score, reading.episode))
    return out
