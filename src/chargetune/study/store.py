"""Store: studies, trials and traces in one SQLite file that survives a crash at any moment."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from numpy.typing import NDArray
from sqlalchemy import Connection, Row, func, insert, select, update
from sqlalchemy.exc import DatabaseError, IntegrityError

from chargetune.episode.score import Score
from chargetune.study import schema
from chargetune.study.document import canonical_json, score_from_json, score_to_json, sha256
from chargetune.study.provenance import utc_now, versions
from chargetune.study.sqlite import BEGIN_WRITING, StoreError, connect_engine, create_file, explain
from chargetune.study.trace import decode
from chargetune.study.trial import Trial, TrialStatus

__all__ = ["Store", "StoreError", "StudyRecord"]


@dataclass(frozen=True)
class StudyRecord:
    """A study as it is stored. ``identity`` is JSON with the entries config, space, tuner, seed and batch."""

    id: int
    name: str
    created_at: str
    identity: Mapping[str, Any]
    identity_sha256: str
    versions: Mapping[str, str]
    trial_count: int = 0


class Store:
    """An open store file; several studies live in one.

    Every change is one transaction, on the disk when the method returns (WAL, synchronous FULL, immediate transactions). A second
    writer waits at most ``busy_timeout_s`` seconds. With ``read_only`` nothing is created or changed.

    Raises StoreError, before anything is written, for a path that cannot be a store: folder missing, no write permission, a
    directory, not a store, damaged, written by a newer version. A damaged file is never recreated.
    """

    def __init__(self, path: str | os.PathLike[str], *, read_only: bool = False, busy_timeout_s: float = 10.0) -> None:
        self.path = Path(path).resolve()
        self.read_only = read_only
        if not busy_timeout_s >= 0:
            raise ValueError(f"busy_timeout_s = {busy_timeout_s!r}, allowed is a number of seconds >= 0")
        create_file(self.path, read_only=read_only)
        self._engine = connect_engine(self.path, read_only=read_only, busy_timeout_s=busy_timeout_s)
        try:
            self._check()
        except BaseException:
            self._engine.dispose()
            raise

    def close(self) -> None:
        """Close the file. A crash instead of it loses nothing."""
        self._engine.dispose()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, traceback: TracebackType | None) -> None:
        self.close()

    def studies(self) -> list[StudyRecord]:
        """All studies, oldest first, with the number of their trials."""
        count = select(func.count()).where(schema.trial.c.study_id == schema.study.c.id).scalar_subquery()
        with self._reading() as connection:
            rows = connection.execute(select(schema.study, count.label("trial_count")).order_by(schema.study.c.id)).all()
        return [_record(row) for row in rows]

    def study(self, name: str) -> StudyRecord:
        """The study of this name; StoreError names those that there are."""
        records = self.studies()
        for record in records:
            if record.name == name:
                return record
        raise StoreError(f"{self.path}: no study {name!r}; there are: {', '.join(r.name for r in records) or '(none)'}")

    def trials(self, study_id: int) -> list[Trial]:
        """All trials of a study by number, without their traces."""
        with self._reading() as connection:
            rows = connection.execute(select(schema.trial).where(schema.trial.c.study_id == study_id).order_by(schema.trial.c.number)).all()
        return [_trial(row) for row in rows]

    def trace(self, study_id: int, number: int) -> tuple[dict[str, NDArray[Any]], dict[str, Any]] | None:
        """Arrays and metadata of a trial's episode, None when none was stored.

        Raises StoreError when the bytes are not those that were stored; the other trials stay readable.
        """
        where = (schema.trial.c.study_id == study_id, schema.trial.c.number == number)
        joined = schema.trial.outerjoin(schema.trace)
        with self._reading() as connection:
            row = connection.execute(select(schema.trial.c.trace_sha256, schema.trace.c.data).select_from(joined).where(*where)).first()
        if row is None:
            raise StoreError(f"{self.path}: no trial {number} in this study")
        if row.trace_sha256 is None:
            return None
        if row.data is None or sha256(row.data) != row.trace_sha256:
            raise StoreError(f"{self.path}: the trace of trial {number} is damaged (its SHA-256 is not the stored one)")
        return decode(row.data)

    def add_study(self, name: str, identity: Mapping[str, Any]) -> StudyRecord:
        """Record a new study."""
        text = canonical_json(identity, "study")
        values = {
            "name": name,
            "created_at": utc_now(),
            "identity": text,
            "identity_sha256": sha256(text),
            "versions": canonical_json(versions(), "versions"),
        }
        with self._writing() as connection:
            if connection.execute(select(schema.study.c.id).where(schema.study.c.name == name)).first():
                raise StoreError(f"{self.path}: there is a study {name!r} already")
            connection.execute(insert(schema.study).values(values))
        return self.study(name)

    def change_study(self, study_id: int, identity: Mapping[str, Any]) -> None:
        """Replace what a study is about; the trials so far keep the hash of the old one in their provenance."""
        text = canonical_json(identity, "study")
        values = {"identity": text, "identity_sha256": sha256(text)}
        with self._writing() as connection:
            connection.execute(update(schema.study).where(schema.study.c.id == study_id).values(values))

    def add_trials(self, study_id: int, trials: Sequence[Trial]) -> None:
        """Record trials as running, all or none. Their numbers must go on where the stored ones end."""
        with self._writing() as connection:
            count = connection.execute(select(func.count()).where(schema.trial.c.study_id == study_id)).scalar_one()
            numbers = [trial.number for trial in trials]
            if numbers != list(range(count, count + len(trials))):
                raise StoreError(f"{self.path}: trial numbers {numbers} do not follow the {count} stored ones")
            connection.execute(insert(schema.trial), [{"study_id": study_id, **_values(trial)} for trial in trials])

    def finish_trial(
        self, study_id: int, number: int, *, score: Score | None, ending: str, trace: bytes | None, provenance: Mapping[str, Any]
    ) -> Trial:
        """Record the result of a running trial (no score: it failed) and its trace in one transaction.

        Telling the same result twice changes nothing and gives the stored trial; another result raises StoreError.
        """
        where = (schema.trial.c.study_id == study_id, schema.trial.c.number == number)
        with self._writing() as connection:
            row = connection.execute(select(schema.trial).where(*where)).first()
            if row is None:
                raise StoreError(f"{self.path}: no trial {number} in this study, ask comes before tell")
            stored = _trial(row)
            told = replace(
                stored,
                status=TrialStatus.FAILED if score is None else TrialStatus.DONE,
                score=score,
                ending=ending,
                told_at=utc_now(),
                trace_sha256=None if trace is None else sha256(trace),
                provenance={**stored.provenance, **provenance},
            )
            if stored.status is not TrialStatus.RUNNING:
                if _result(stored) == _result(told):
                    return stored
                raise StoreError(f"{self.path}: trial {number} is {stored.status} already, with another result")
            if trace is not None:
                connection.execute(insert(schema.trace).values(study_id=study_id, number=number, data=trace))
            connection.execute(update(schema.trial).where(*where).values(_values(told)))
        return told

    def count_loss(self, study_id: int, number: int, by: int = 1) -> int:
        """Add to how many workers a running trial has lost, and give that number."""
        where = (schema.trial.c.study_id == study_id, schema.trial.c.number == number)
        with self._writing() as connection:
            provenance = json.loads(connection.execute(select(schema.trial.c.provenance).where(*where)).scalar_one())
            provenance["losses"] = provenance.get("losses", 0) + by
            text = canonical_json(provenance, "provenance")
            connection.execute(update(schema.trial).where(*where).values(provenance=text))
        return int(provenance["losses"])

    def note_holder(self, study_id: int, process: int, host: str) -> None:
        """Record who works on a study, for the message to whoever is refused."""
        values = {"process": process, "host": host, "since": utc_now()}
        with self._writing() as connection:
            if not connection.execute(update(schema.holder).where(schema.holder.c.study_id == study_id).values(values)).rowcount:
                connection.execute(insert(schema.holder).values(study_id=study_id, **values))

    def holder(self, study_id: int | None = None) -> str:
        """The process noted last, for one study or for any, as text."""
        query = select(schema.holder).order_by(schema.holder.c.since.desc())
        if study_id is not None:
            query = query.where(schema.holder.c.study_id == study_id)
        with self._reading() as connection:
            row = connection.execute(query).first()
        return "unknown" if row is None else f"process {row.process} on {row.host} since {row.since}"

    def _check(self) -> None:
        with self._reading() as connection:
            tables = {str(row[0]) for row in connection.exec_driver_sql("SELECT name FROM sqlite_master WHERE type = 'table'")}
            if schema.store.name not in tables:
                raise StoreError(f"{self.path}: a database, but not a store of this program (no table {schema.store.name})")
            version = connection.execute(select(func.max(schema.store.c.schema_version))).scalar()
            if version is None or version > schema.SCHEMA_VERSION:
                raise StoreError(
                    f"{self.path}: schema version {version}, this program knows versions up to {schema.SCHEMA_VERSION};"
                    " open it with the newer program that wrote it"
                )
            # Traces are checked by their hash when read: going over all of them would take seconds at each start.
            for table in (t.name for t in schema.metadata.sorted_tables if t is not schema.trace):
                verdict = connection.exec_driver_sql(f"PRAGMA quick_check('{table}')").scalar()
                if verdict != "ok":
                    raise StoreError(f"{self.path}: damaged, nothing was changed ({verdict})")
        if not self.read_only:
            with self._writing():
                pass

    @contextmanager
    def _reading(self) -> Iterator[Connection]:
        try:
            with self._engine.connect() as connection:
                yield connection
        except DatabaseError as error:
            raise StoreError(explain(self.path, error)) from error

    @contextmanager
    def _writing(self) -> Iterator[Connection]:
        if self.read_only:
            raise StoreError(f"{self.path}: opened read-only")
        try:
            with self._engine.execution_options(begin=BEGIN_WRITING).begin() as connection:
                yield connection
        except IntegrityError as error:
            raise StoreError(f"{self.path}: refused by the store ({error.orig})") from error
        except DatabaseError as error:
            message = explain(self.path, error)
            raise StoreError(f"{message}; last holder: {self.holder()}" if "is locked" in message else message) from error


def _values(trial: Trial) -> dict[str, Any]:
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
    }


def _result(trial: Trial) -> tuple[object, ...]:
    return (trial.status, None if trial.score is None else score_to_json(trial.score), trial.ending, trial.trace_sha256)


def _trial(row: Row[Any]) -> Trial:
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
    )


def _record(row: Row[Any]) -> StudyRecord:
    return StudyRecord(
        id=row.id,
        name=row.name,
        created_at=row.created_at,
        identity=json.loads(row.identity),
        identity_sha256=row.identity_sha256,
        versions=json.loads(row.versions),
        trial_count=row.trial_count,
    )
