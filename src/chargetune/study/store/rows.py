"""Rows of a store as the data of this program, and back."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Row

from chargetune.study.serialization import canonical_json, score_from_json, score_to_json
from chargetune.study.trial import Trial, TrialStatus

__all__ = ["ResultRecord", "StoreError", "StudyRecord", "record_of", "result_of", "trial_of", "trial_row"]


class StoreError(Exception):
    """The store cannot be used, or refuses what was asked; the message names the store and the reason."""


@dataclass(frozen=True)
class StudyRecord:
    """A study as it is stored. ``identity`` is JSON with the entries config, space, tuner, seed and batch.

    ``hardware`` says that its plant is no simulation. ``trial_count`` leaves out the imported trials.
    """

    id: int
    name: str
    created_at: str
    identity: Mapping[str, Any]
    identity_sha256: str
    versions: Mapping[str, str]
    hardware: bool = False
    trial_count: int = 0


@dataclass(frozen=True)
class ResultRecord:
    """The number of the trial that is a study's result (None: none has a score), why, and the hash of what it was made from."""

    number: int | None
    reason: str
    made_from: str


def trial_row(trial: Trial) -> dict[str, Any]:
    """The columns of a trial but the study's."""
    return {
        "number": trial.number,
        "theta": canonical_json(trial.theta, "theta"),
        "status": str(trial.status),
        "score": None if trial.score is None else canonical_json(score_to_json(trial.score), "score"),
        "ending": trial.ending,
        "seed": trial.seed,
        "asked_at": trial.asked_at,
        "told_at": trial.told_at,
        "trace_sha256": trial.trace_sha256,
        "provenance": canonical_json(trial.provenance, "provenance"),
        "attempt": trial.attempt,
    }


def trial_of(row: Row[Any]) -> Trial:
    """Inverse of `trial_row`."""
    return Trial(
        number=row.number,
        theta=tuple(json.loads(row.theta)),
        status=TrialStatus(row.status),
        score=None if row.score is None else score_from_json(json.loads(row.score)),
        ending=row.ending,
        seed=row.seed,
        asked_at=row.asked_at,
        told_at=row.told_at,
        trace_sha256=row.trace_sha256,
        provenance=json.loads(row.provenance),
        attempt=row.attempt,
    )


def result_of(trial: Trial) -> tuple[object, ...]:
    """What must be equal in a result that is told again."""
    return (trial.status, None if trial.score is None else score_to_json(trial.score), trial.ending, trial.trace_sha256)


def record_of(row: Row[Any]) -> StudyRecord:
    """The study of a row of the study table, which may have a column trial_count."""
    return StudyRecord(
        id=row.id,
        name=row.name,
        created_at=row.created_at,
        identity=json.loads(row.identity),
        identity_sha256=row.identity_sha256,
        versions=json.loads(row.versions),
        hardware=bool(row.hardware),
        trial_count=getattr(row, "trial_count", 0),
    )
