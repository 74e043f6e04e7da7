"""Trial: the numbered record of one theta, and the best of many trials."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

from chargetune.episode.html_repr import facts
from chargetune.episode.score import Score

__all__ = ["Trial", "TrialStatus", "best_feasible", "best_performance"]


class TrialStatus(StrEnum):
    """Where a trial stands. ``running`` means asked and not yet told, whether a process works on it or not.

    ``apart``: it was told before the study was changed, and is not comparable with what the study is now; its ending says why.
    """

    RUNNING = "running"
    DONE = "done"
    FAILED = "failed"
    APART = "apart"


@dataclass(frozen=True)
class Trial:
    """One theta that was asked for, and what became of it.

    number
        Order of asking, from 0, without gaps. Below 0: a trial of an earlier study, imported as initial data D_0.
    theta
        Values in the order of ``ParameterSpace.entries``, in their own units.
    score
        The verdict on the episode; None unless the status is done.
    ending
        Why the episode ended, or why the trial failed; None while running.
    seed
        The seed of this trial's evaluation, derived from the study's seed and the number.
    asked_at, told_at
        UTC times, ISO 8601. Nothing depends on their order, since a wall clock may jump.
    trace_sha256
        SHA-256 of the stored trace, None when there is none.
    provenance
        Hash of the study's configuration, versions of the programs, machine; ``learnt_sha256``: hash of the trials that theta was
        proposed from, which are the whole state of a tuner and its twin; ``pending``: numbers of the trials that were
        running when it was proposed beside them; ``losses``: how many workers were lost by it.
    attempt
        How often the trial was handed out to a worker; the result of an attempt before the last one is refused.
    episode
        Reads the trial's stored episode; a study gives it to its tuner, nobody else has it.
    """

    number: int
    theta: tuple[float, ...]
    status: TrialStatus = TrialStatus.RUNNING
    score: Score | None = None
    ending: str | None = None
    seed: int = 0
    asked_at: str = ""
    told_at: str | None = None
    trace_sha256: str | None = None
    provenance: Mapping[str, Any] = field(default_factory=dict)
    attempt: int = 0
    episode: Callable[[], Any] | None = field(default=None, compare=False, repr=False)

    def __post_init__(self) -> None:
        if self.number < 0 and self.status is TrialStatus.RUNNING:
            raise ValueError(f"trial: number = {self.number}, allowed is an integer >= 0; below 0 are told trials of earlier studies")
        if (self.score is not None) != (self.status is TrialStatus.DONE):
            raise ValueError(f"trial {self.number}: status = {self.status}, a score belongs to the status 'done' and only to it")

    @property
    def losses(self) -> int:
        """How many workers were lost while they evaluated it."""
        return int(self.provenance.get("losses", 0))

    @property
    def feasible(self) -> bool:
        """Whether the trial is done and kept every limit."""
        return self.score is not None and self.score.feasible

    def _repr_html_(self) -> str:
        theta = ", ".join(f"{value:.5g}" for value in self.theta)
        head = facts(f"Trial {self.number}", {"status": self.status.value, "ending": self.ending, "theta": theta, "seed": str(self.seed)})
        return head + (self.score._repr_html_() if self.score is not None else "")


def best_feasible(trials: Iterable[Trial]) -> Trial | None:
    """The trial of the largest objective among those that kept every limit; the earlier one of equals."""
    return _best((t.score.objective, t) for t in trials if t.score is not None and t.score.feasible)


def best_performance(trials: Iterable[Trial]) -> Trial | None:
    """The trial of the largest performance G, limits enter only through G's penalty; the earlier one of equals."""
    return _best((t.score.performance, t) for t in trials if t.score is not None)


def _best(valued: Iterable[tuple[float, Trial]]) -> Trial | None:
    found = max(valued, key=lambda pair: (pair[0], -pair[1].number), default=None)
    return None if found is None else found[1]
