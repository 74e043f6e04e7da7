"""A study that was changed: which of its trials still count, and as what.

A trial was told under the study as it was then. What is comparable with the study as it is now stays; where only the judgement
has changed the verdict is made again from the stored trace; everything else is set apart: kept, shown, and no part of any result.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

from chargetune.episode.episode import Episode
from chargetune.episode.score import Score
from chargetune.model.parameter_space import ParameterSpace
from chargetune.study.serialization import score_from_json, score_to_json
from chargetune.study.trial import Trial, TrialStatus

__all__ = ["Carry", "carried_over", "change_note", "inside"]

BOUNDS = "theta is outside the bounds"
# The tuner's transform to the unit cube and back rounds.
SLACK = 1e-9


class Carry(Protocol):
    """What is known of a study's configuration: what of it makes the closed loop, and what only judges it."""

    def other_loop(self, old: Mapping[str, Any], new: Mapping[str, Any]) -> str:
        """What makes the closed loops of two configurations different ones, in a few words; empty where nothing does."""
        ...

    def other_verdict(self, old: Mapping[str, Any], new: Mapping[str, Any]) -> str:
        """What makes their verdicts on one trace different ones; empty where nothing does."""
        ...

    def judge(self, episode: Episode) -> Score:
        """The verdict as it is now. Raises ValueError or KeyError where a trace does not hold what it takes."""
        ...


@dataclass(frozen=True)
class _Change:
    sha256: str
    loop: str
    verdict: str
    space: ParameterSpace
    carry: Carry | None
    episode: Callable[[int], Episode | None]


def carried_over(
    trials: Sequence[Trial],
    *,
    old: Mapping[str, Any],
    new: Mapping[str, Any],
    new_sha256: str,
    space: ParameterSpace,
    carry: Carry | None,
    episode: Callable[[int], Episode | None],
) -> list[Trial]:
    """The told trials that are others now than they were: set apart, judged again, or back as they were told.

    ``old`` and ``new`` are identities, ``space`` is that of the new one, ``episode`` reads a trial's trace. Without ``carry`` nothing
    is known of the configuration: who accepts the change says that the trials are comparable, and only the bounds are looked at.
    """
    loop = "" if carry is None else carry.other_loop(old["config"], new["config"])
    verdict = "" if carry is None else carry.other_verdict(old["config"], new["config"])
    change = _Change(new_sha256, loop, verdict, space, carry, episode)
    told = [t for t in trials if t.number >= 0 and t.status is not TrialStatus.RUNNING]
    return [now for trial in told if (now := _now(trial, change)) != trial]


def inside(space: ParameterSpace, theta: Sequence[float]) -> bool:
    """Whether theta lies in the bounds, up to rounding."""
    slack = SLACK * (space.upper - space.lower)
    return bool(((space.lower - slack <= theta) & (theta <= space.upper + slack)).all())


def change_note(trials: Iterable[Trial]) -> str:
    """How many trials of a study that was changed are set apart or were judged again, and why; empty where none is."""
    apart: Counter[str] = Counter()
    again: Counter[str] = Counter()
    for trial in trials:
        if trial.status is TrialStatus.APART:
            apart[str(trial.provenance.get("apart", {}).get("reason", BOUNDS))] += 1
        elif "judged" in trial.provenance:
            again[str(trial.provenance["judged"]["reason"])] += 1
    parts = [f"{_trials(count)} set apart ({reason})" for reason, count in apart.items()]
    parts += [f"{_trials(count)} judged again from the traces ({reason})" for reason, count in again.items()]
    return ", ".join(parts)


def _trials(count: int) -> str:
    return f"{count} trial{'s' * (count != 1)} of before a change"


def _now(trial: Trial, change: _Change) -> Trial:
    first = _as_told(trial)
    if trial.provenance.get("study_sha256") == change.sha256:
        # The study is again what it was when this was told.
        found = first
    else:
        kept = trial.provenance.get("apart", {})
        if kept and kept["reason"] != BOUNDS:
            return trial
        if change.loop:
            return _apart(trial, first, f"another closed loop: {change.loop}")
        found = trial
        if first.score is not None and change.carry is not None and (change.verdict or kept):
            found = _judged_again(trial, first, change)
        elif kept:
            found = first
    if found.status is not TrialStatus.APART and not inside(change.space, trial.theta):
        return _apart(trial, first, BOUNDS)
    return found


def _judged_again(trial: Trial, first: Trial, change: _Change) -> Trial:
    if change.carry is None:
        return first
    try:
        episode = change.episode(trial.number)
        if episode is None:
            return _apart(trial, first, "without a trace it cannot be judged again")
        score = change.carry.judge(episode)
    except (KeyError, ValueError) as error:
        return _apart(trial, first, f"its trace cannot be judged again: {error}")
    if first.score is not None and score_to_json(score) == score_to_json(first.score):
        return first
    reason = change.verdict or trial.provenance.get("judged", {}).get("reason") or "the judgement has changed"
    told = {"score": score_to_json(first.score) if first.score else None, "reason": reason}
    return replace(first, score=score, provenance={**first.provenance, "judged": told})


def _apart(trial: Trial, first: Trial, reason: str) -> Trial:
    told = {
        "reason": reason,
        "status": first.status.value,
        "score": None if first.score is None else score_to_json(first.score),
        "ending": first.ending,
    }
    provenance = {**first.provenance, "apart": told}
    return replace(trial, status=TrialStatus.APART, score=None, ending=f"set apart: {reason}", provenance=provenance)


def _as_told(trial: Trial) -> Trial:
    """The trial as it was told, without any mark of a change."""
    apart, judged = trial.provenance.get("apart"), trial.provenance.get("judged")
    provenance = {name: value for name, value in trial.provenance.items() if name not in ("apart", "judged")}
    if apart:
        score = None if apart["score"] is None else score_from_json(apart["score"])
        return replace(trial, status=TrialStatus(apart["status"]), score=score, ending=apart["ending"], provenance=provenance)
    if judged:
        return replace(trial, score=score_from_json(judged["score"]), provenance=provenance)
    return trial
