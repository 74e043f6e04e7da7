"""The one result of a study: which trial it is, and why. Every command and page reads it here."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any

from chargetune.episode.score import Score, in_tolerances
from chargetune.study.changes import change_note, inside
from chargetune.study.serialization import canonical_json, sha256, space_from_json
from chargetune.study.store.rows import StudyRecord
from chargetune.study.store.store import Store
from chargetune.study.trial import Trial, TrialStatus, best_feasible, best_performance

__all__ = ["Reason", "StudyResult", "allowed", "by_newest", "by_performance", "made_from", "measured_result", "read_result", "with_belief"]


class Reason(StrEnum):
    """Why a trial is the result."""

    BELIEVED = "believed"
    MEASURED = "measured"
    CLEAR = "clear"
    CLOSEST = "closest"
    PERFORMANCE = "performance"
    NEWEST = "newest"
    NONE = "none"


SENTENCES = {
    Reason.BELIEVED: "the tuner believes it best from all traces",
    Reason.MEASURED: "it is the best that was measured to keep every limit",
    Reason.CLEAR: "it kept every limit by more than the tolerance, and was measured better than the trial that the tuner believes best",
    Reason.CLOSEST: "no trial kept every limit, and it came closest, in tolerances",
    Reason.PERFORMANCE: "it has the best performance G, which weighs violations",
    Reason.NEWEST: "it is the newest that kept every limit; objectives of trials from other conditions do not compare",
    Reason.NONE: "no trial has a score",
}


@dataclass(frozen=True)
class StudyResult:
    """The trial that is the result of a study, None only where no trial has a score.

    ``asked`` says whether the tuner had its say on exactly these trials. Where it is False the verdicts measured alone decide: the
    study is running, was interrupted, is of an older program, or only some of its trials are looked at. ``note`` says which trials
    are set apart or were judged again since the study was changed.
    """

    trial: Trial | None
    reason: Reason
    asked: bool = True
    note: str = ""

    @property
    def sentence(self) -> str:
        """Why, for people: one clause without a capital and a stop."""
        aside = "" if self.asked else " (by the verdicts alone; the tuner was not asked about these trials)"
        return SENTENCES[self.reason] + aside + (f"; {self.note}" if self.note else "")

    @property
    def kept(self) -> Trial | None:
        """The trial where it was measured to keep every limit, else None."""
        return self.trial if self.trial is not None and self.trial.feasible else None

    def facts(self) -> dict[str, Any]:
        """As plain data: ``trial``, ``reason``, ``asked``, ``sentence``."""
        number = None if self.trial is None else self.trial.number
        return {"trial": number, "reason": self.reason.value, "asked": self.asked, "sentence": self.sentence}


def measured_result(trials: Sequence[Trial], *, by_performance: bool = False, newest: bool = False, asked: bool = True) -> StudyResult:
    """The result by what was measured alone.

    The largest objective of those that kept every limit; where none did the least `Score.worst`; with ``by_performance`` the
    largest performance G. The earlier one of equals. ``newest``: each trial was under a condition of its own, so that a good objective is
    no merit of its theta, and the newest one that kept every limit is the result.
    """
    scored = [t for t in trials if t.score is not None]
    if not scored:
        # There is nothing that a tuner could be asked.
        return StudyResult(None, Reason.NONE)
    if by_performance:
        return StudyResult(best_performance(scored), Reason.PERFORMANCE, asked)
    best = max((t for t in scored if t.feasible), key=lambda t: t.number, default=None) if newest else best_feasible(scored)
    if best is not None:
        return StudyResult(best, Reason.NEWEST if newest else Reason.MEASURED, asked)
    closest = min(scored, key=lambda t: (t.score.worst if t.score else 0.0, t.number))
    return StudyResult(closest, Reason.CLOSEST, asked)


def with_belief(trials: Sequence[Trial], best: Callable[[], Trial | None], *, by_performance: bool, newest: bool = False) -> StudyResult:
    """The result where the tuner is asked, too: ``best`` gives the trial that it believes best from all traces.

    A single noisy verdict does not decide; neither does a belief against what was measured beyond doubt. So it counts only for
    a trial that was measured to keep every limit, and not where another one has a better objective and kept every limit by more
    than its tolerance, which is what noise and rounding explain: of that one there is nothing to believe. With ``newest`` objectives do
    not compare (`measured_result`), and a belief in the newest one stands.
    """
    measured = measured_result(trials, by_performance=by_performance, newest=newest)
    if measured.reason is Reason.NEWEST:
        return StudyResult(measured.trial, Reason.BELIEVED) if best() == measured.trial else measured
    if measured.reason is not Reason.MEASURED:
        return measured
    believed = best()
    if believed is None or believed.score is None or not believed.feasible:
        return measured
    clear = best_feasible(t for t in trials if t.score is not None and _clearly_kept(t.score))
    if clear is not None and clear.score is not None and clear.score.objective > believed.score.objective:
        # The best of all that were measured to keep the limits may be one that only noise lets pass.
        return StudyResult(clear, Reason.MEASURED if clear == measured.trial else Reason.CLEAR)
    return StudyResult(believed, Reason.BELIEVED)


def read_result(store: Store, record: StudyRecord, trials: Sequence[Trial] | None = None) -> StudyResult:
    """The result of a study from the store alone, which may be open for reading only; ``trials`` are those looked at, else all.

    The stored one holds for exactly the told trials that it was made from, and for the study as it was then. For others, and where
    none is stored, it is what was measured, with ``asked`` False.
    """
    trials = store.trials(record.id) if trials is None else trials
    return replace(_read(store, record, trials), note=change_note(trials))


def _read(store: Store, record: StudyRecord, trials: Sequence[Trial]) -> StudyResult:
    stored = store.result(record.id)
    if stored is not None and stored.made_from == made_from(record, trials):
        trial = next((t for t in trials if t.number == stored.number), None)
        if (trial is None) == (stored.number is None) and stored.reason in set(Reason):
            return StudyResult(trial, Reason(stored.reason))
    own, newest = by_performance(record.identity), by_newest(record.identity)
    return measured_result(allowed(record, trials), by_performance=own, newest=newest, asked=False)


def allowed(record: StudyRecord, trials: Sequence[Trial]) -> list[Trial]:
    """The trials that the study as it is now could have asked for: none that is set apart, and none outside its bounds."""
    space = space_from_json(record.identity.get("space", []))
    return [t for t in trials if t.status is not TrialStatus.APART and (not space.dimension or inside(space, t.theta))]


def _clearly_kept(score: Score) -> bool:
    return all(in_tolerances(value, score.tolerance.get(name, 0.0), -1.0) <= 0 for name, value in score.excess.items())


def made_from(record: StudyRecord, trials: Sequence[Trial]) -> str:
    """SHA-256 of what a result depends on: the study's identity, and which trials are told; what was told does not change."""
    told = [t.number for t in trials if t.status is not TrialStatus.RUNNING]
    return sha256(canonical_json({"study": record.identity_sha256, "told": told}, "result"))


def by_performance(identity: Mapping[str, Any]) -> bool:
    """Whether a study is of the paper's method, whose incumbent is the best performance G."""
    config, tuner = identity.get("config"), identity.get("tuner")
    named = config.get("study") if isinstance(config, Mapping) else None
    name = named.get("tuner") if isinstance(named, Mapping) else None
    return name == "ei" or (isinstance(tuner, Mapping) and tuner.get("type") == "ExpectedImprovement")


def by_newest(identity: Mapping[str, Any]) -> bool:
    """Whether each trial of a study is under a condition of its own: a twin that learns one plant of a range of use."""
    tuner = identity.get("tuner")
    return isinstance(tuner, Mapping) and tuner.get("type") == "RangeTwinTuner"
