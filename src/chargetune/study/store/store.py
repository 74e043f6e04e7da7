"""Store: studies, trials and traces in an SQLite file or on a PostgreSQL server; it survives a crash at any moment."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from types import TracebackType
from typing import Any, Self, TypeVar

from numpy.typing import NDArray
from sqlalchemy import Connection, func, insert, select, update
from sqlalchemy.exc import DBAPIError, IntegrityError

from chargetune.episode.score import Score
from chargetune.study.provenance import utc_now, versions
from chargetune.study.serialization import canonical_json, sha256
from chargetune.study.store import schema
from chargetune.study.store.database import Hold, database_at
from chargetune.study.store.rows import ResultRecord, StoreError, StudyRecord, record_of, result_of, trial_of, trial_row
from chargetune.study.store.trace import content_sha256, decode, facts
from chargetune.study.trial import Trial, TrialStatus

__all__ = ["Store", "StoreError", "StudyRecord"]

T = TypeVar("T")
PAUSE_S = 0.2


class Store:
    """An open store; several studies live in one.

    location
        The path of an SQLite file, or ``postgresql://user@host/database``.
    busy_timeout_s
        How long a writer waits for another one, and how long a lost connection or a full disk is tried again.

    Every change is one transaction, on the disk when the method returns. With ``read_only`` nothing is created or changed.
    A store of an older schema is brought to this one, after a copy of the file was made.

    Raises StoreError, before anything is written, for what cannot be a store: folder missing, no write permission, a
    directory, not a store, damaged, written by a newer version, no such server. A damaged file is never recreated.
    """

    def __init__(self, location: str | os.PathLike[str], *, read_only: bool = False, busy_timeout_s: float = 10.0) -> None:
        if not busy_timeout_s >= 0:
            raise ValueError(f"busy_timeout_s = {busy_timeout_s!r}, allowed is a number of seconds >= 0")
        self.database = database_at(location)
        self.location = self.database.location
        self.label = self.database.label
        self.read_only = read_only
        self.busy_timeout_s = busy_timeout_s
        self.database.prepare(read_only=read_only, busy_timeout_s=busy_timeout_s)
        self._engine = self.database.connect(read_only=read_only, busy_timeout_s=busy_timeout_s)
        if not read_only:
            try:
                self.write(lambda _: None)
            except BaseException:
                self._engine.dispose()
                raise

    def close(self) -> None:
        """Close the store. A crash instead of it loses nothing."""
        self._engine.dispose()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, traceback: TracebackType | None) -> None:
        self.close()

    def studies(self) -> list[StudyRecord]:
        """All studies, oldest first, with the number of their trials."""
        own = (schema.trial.c.study_id == schema.study.c.id, schema.trial.c.number >= 0)
        count = select(func.count()).where(*own).correlate(schema.study).scalar_subquery()
        query = select(schema.study, count.label("trial_count")).order_by(schema.study.c.id)
        return [record_of(row) for row in self.read(lambda connection: connection.execute(query).all())]

    def study(self, name: str) -> StudyRecord:
        """The study of this name; StoreError names those that there are."""
        records = self.studies()
        for record in records:
            if record.name == name:
                return record
        raise StoreError(f"{self.label}: no study {name!r}; there are: {', '.join(r.name for r in records) or '(none)'}")

    def trials(self, study_id: int) -> list[Trial]:
        """All trials of a study by number, without their traces and without the imported ones."""
        return self._trials(study_id, schema.trial.c.number >= 0)

    def earlier(self, study_id: int) -> list[Trial]:
        """D_0 of a study: the trials of earlier studies that it began with; their numbers are below 0."""
        return self._trials(study_id, schema.trial.c.number < 0)

    def trace(self, study_id: int, number: int) -> tuple[dict[str, NDArray[Any]], dict[str, Any]] | None:
        """Arrays and metadata of a trial's episode, None when none was stored.

        Raises StoreError when the content is not what was stored; the other trials stay readable.
        """
        where = (schema.trial.c.study_id == study_id, schema.trial.c.number == number)
        query = select(schema.trial.c.trace_sha256, schema.trace.c.data).select_from(schema.trial.outerjoin(schema.trace)).where(*where)
        row = self.read(lambda connection: connection.execute(query).first())
        if row is None:
            raise StoreError(f"{self.label}: no trial {number} in this study")
        if row.trace_sha256 is None:
            return None
        damaged = f"{self.label}: the trace of trial {number} is damaged"
        if row.data is None:
            raise StoreError(f"{damaged} (it is missing)")
        try:
            arrays, meta = decode(bytes(row.data))
        except ValueError as error:
            raise StoreError(f"{damaged} ({error})") from error
        if content_sha256(arrays, meta) != row.trace_sha256:
            raise StoreError(f"{damaged} (its SHA-256 is not the stored one)")
        return arrays, meta

    def add_study(
        self, name: str, identity: Mapping[str, Any], *, hardware: bool = False, earlier: Sequence[tuple[Trial, bytes | None]] = ()
    ) -> StudyRecord:
        """Record a new study and D_0: told trials with numbers below 0, each with its encoded trace or None."""
        identity_text = canonical_json(identity, "study")
        values = {
            "name": name,
            "created_at": utc_now(),
            "identity": identity_text,
            "identity_sha256": sha256(identity_text),
            "versions": canonical_json(versions(), "versions"),
            "hardware": int(hardware),
        }

        def add(connection: Connection) -> None:
            found = connection.execute(select(schema.study).where(schema.study.c.name == name)).first()
            if found is not None:
                # The same to the millisecond: this very transaction, whose answer was lost.
                if (found.created_at, found.identity) == (values["created_at"], values["identity"]):
                    return
                raise StoreError(f"{self.label}: there is a study {name!r} already")
            connection.execute(insert(schema.study).values(values))
            study_id = connection.execute(select(schema.study.c.id).where(schema.study.c.name == name)).scalar_one()
            for trial, trace in earlier:
                connection.execute(insert(schema.trial).values(study_id=study_id, **trial_row(trial)))
                _add_trace(connection, study_id, trial.number, trace)

        self.write(add)
        return self.study(name)

    def change_study(self, study_id: int, identity: Mapping[str, Any], trials: Sequence[Trial] = (), *, term: int | None = None) -> None:
        """Replace what a study is about, and those of its ``trials`` that are others by that, in one transaction.

        The trials so far keep the hash of the old identity in their provenance.
        """
        text = canonical_json(identity, "study")
        query = update(schema.study).where(schema.study.c.id == study_id).values(identity=text, identity_sha256=sha256(text))

        def change(connection: Connection) -> None:
            connection.execute(query)
            for trial in trials:
                where = (schema.trial.c.study_id == study_id, schema.trial.c.number == trial.number)
                connection.execute(update(schema.trial).where(*where).values(trial_row(trial)))

        self.write(change, study_id, term)

    def add_trials(self, study_id: int, trials: Sequence[Trial], *, term: int | None = None) -> None:
        """Record trials as running, all or none. Their numbers must go on where the stored ones end."""
        if not trials:
            return
        rows = [{"study_id": study_id, **trial_row(trial)} for trial in trials]
        own = (schema.trial.c.study_id == study_id, schema.trial.c.number >= 0)

        def add(connection: Connection) -> None:
            count, last = connection.execute(select(func.count(), func.max(schema.trial.c.number)).where(*own)).one()
            if count and last >= count:
                raise StoreError(
                    f"{self.label}: this study lacks trials since it was salvaged, and cannot go on;"
                    " a new study can begin with what it has ([[study.earlier]])"
                )
            numbers = [trial.number for trial in trials]
            if numbers == list(range(count, count + len(trials))):
                connection.execute(insert(schema.trial), rows)
                return
            newest = select(schema.trial).where(*own, schema.trial.c.number >= count - len(trials)).order_by(schema.trial.c.number)
            # Equal ones are this very transaction, whose answer was lost.
            if [trial_of(row) for row in connection.execute(newest)] != list(trials):
                raise StoreError(f"{self.label}: trial numbers {numbers} do not follow the {count} stored ones")

        self.write(add, study_id, term)

    def hand_out(self, study_id: int, trials: Sequence[Trial], worker: str, *, term: int | None = None) -> list[Trial]:
        """Record, before they begin, that ``worker`` evaluates running trials; gives them with the number of this attempt.

        The attempt before is given up: its result is refused from now on. Raises StoreError, and hands out none, for a trial
        that is told, or that somebody else handed out since it was read; and for one of a study on hardware that was handed out
        before, because it may have run.
        """
        tried = False

        def hand(connection: Connection) -> list[Trial]:
            nonlocal tried
            again, tried = tried, True
            hardware = connection.execute(select(schema.study.c.hardware).where(schema.study.c.id == study_id)).scalar()
            handed = []
            for trial in trials:
                where = (schema.trial.c.study_id == study_id, schema.trial.c.number == trial.number)
                row = connection.execute(select(schema.trial).where(*where)).first()
                if row is None or row.status != TrialStatus.RUNNING:
                    raise StoreError(f"{self.label}: trial {trial.number} is not running, nothing is handed out")
                if not (again and row.attempt == trial.attempt + 1 and row.worker == worker):
                    if hardware and row.attempt:
                        raise StoreError(
                            f"{self.label}: trial {trial.number} was handed out to {row.worker} at {row.handed_out_at} and may have run;"
                            " on hardware that happens once. Look at the cell, then tell its result or fail it"
                        )
                    if row.attempt != trial.attempt:
                        raise StoreError(
                            f"{self.label}: trial {trial.number} was handed out to {row.worker} at {row.handed_out_at} already"
                        )
                    values = {"attempt": trial.attempt + 1, "worker": worker, "handed_out_at": utc_now()}
                    connection.execute(update(schema.trial).where(*where).values(values))
                handed.append(replace(trial_of(row), attempt=trial.attempt + 1))
            return handed

        return self.write(hand, study_id, term)

    def finish_trial(
        self,
        study_id: int,
        number: int,
        *,
        score: Score | None,
        ending: str,
        trace: bytes | None,
        provenance: Mapping[str, Any],
        attempt: int | None = None,
        term: int | None = None,
    ) -> Trial:
        """Record the result of a running trial (no score: it failed) and its trace in one transaction.

        ``attempt`` is the one that the result comes from; None speaks for whatever attempt there is.
        Telling the same result twice changes nothing and gives the stored trial; another result, or that of an attempt that
        was given up, raises StoreError.
        """
        where = (schema.trial.c.study_id == study_id, schema.trial.c.number == number)
        hashed = None if trace is None else facts(trace).sha256

        def finish(connection: Connection) -> Trial:
            row = connection.execute(select(schema.trial).where(*where)).first()
            if row is None or number < 0:
                raise StoreError(f"{self.label}: no trial {number} in this study, ask comes before tell")
            stored = trial_of(row)
            told = replace(
                stored,
                status=TrialStatus.FAILED if score is None else TrialStatus.DONE,
                score=score,
                ending=ending,
                told_at=utc_now(),
                trace_sha256=hashed,
                provenance={**stored.provenance, **provenance},
            )
            if stored.status is not TrialStatus.RUNNING:
                if result_of(stored) == result_of(told):
                    return stored
                raise StoreError(f"{self.label}: trial {number} is {stored.status} already, with another result")
            if attempt is not None and attempt != stored.attempt:
                raise StoreError(
                    f"{self.label}: trial {number}: attempt {attempt} was given up, its late result is refused; attempt {stored.attempt}"
                    f" is with {row.worker} since {row.handed_out_at}"
                )
            _add_trace(connection, study_id, number, trace)
            connection.execute(update(schema.trial).where(*where).values(trial_row(told)))
            return told

        return self.write(finish, study_id, term)

    def result(self, study_id: int) -> ResultRecord | None:
        """The result stored last, which may be of fewer trials than there are now: `read_result` knows. None where there is none."""
        query = select(schema.result).where(schema.result.c.study_id == study_id)
        row = self.read(lambda connection: connection.execute(query).first())
        return None if row is None else ResultRecord(row.number, row.reason, row.made_from)

    def set_result(self, study_id: int, result: ResultRecord, *, term: int | None = None) -> None:
        """Record which trial is the result of a study, in place of what was recorded before."""
        where = schema.result.c.study_id == study_id
        values = {"number": result.number, "reason": result.reason, "made_from": result.made_from, "made_at": utc_now()}

        def put(connection: Connection) -> None:
            if connection.execute(select(schema.result).where(where)).first() is None:
                connection.execute(insert(schema.result).values(study_id=study_id, **values))
            else:
                connection.execute(update(schema.result).where(where).values(values))

        self.write(put, study_id, term)

    def count_loss(self, study_id: int, number: int, by: int = 1, *, term: int | None = None) -> int:
        """Add to how many workers a running trial has lost, and give that number."""
        where = (schema.trial.c.study_id == study_id, schema.trial.c.number == number)
        losses: int | None = None

        def count(connection: Connection) -> int:
            nonlocal losses
            provenance = json.loads(connection.execute(select(schema.trial.c.provenance).where(*where)).scalar_one())
            # Tried again after a lost answer it must not count twice.
            losses = int(provenance.get("losses", 0)) + by if losses is None else losses
            text = canonical_json({**provenance, "losses": losses}, "provenance")
            connection.execute(update(schema.trial).where(*where).values(provenance=text))
            return losses

        return self.write(count, study_id, term)

    def hold(self, study_id: int) -> Hold | None:
        """Take a study for this process, None when another process has it."""
        if self.read_only:
            raise StoreError(f"{self.label}: opened read-only")
        return self.database.hold(study_id)

    def note_holder(self, study_id: int, process: int, host: str) -> int:
        """Record who works on a study, for the message to whoever is refused; gives the number of this term.

        With it, writing refuses whoever held the study before.
        """
        values = {"process": process, "host": host, "since": utc_now()}
        where = schema.holder.c.study_id == study_id

        def note(connection: Connection) -> int:
            term: int | None = connection.execute(select(schema.holder.c.term).where(where)).scalar()
            if term is None:
                connection.execute(insert(schema.holder).values(study_id=study_id, term=1, **values))
                return 1
            connection.execute(update(schema.holder).where(where).values(term=term + 1, **values))
            return term + 1

        return self.write(note)

    def holder(self, study_id: int | None = None) -> str:
        """The process noted last, for one study or for any, as text."""
        query = select(schema.holder).order_by(schema.holder.c.since.desc())
        if study_id is not None:
            query = query.where(schema.holder.c.study_id == study_id)
        row = self.read(lambda connection: connection.execute(query).first())
        return "unknown" if row is None else f"process {row.process} on {row.host} since {row.since}"

    def _trials(self, study_id: int, which: Any) -> list[Trial]:
        query = select(schema.trial).where(schema.trial.c.study_id == study_id, which).order_by(schema.trial.c.number)
        return [trial_of(row) for row in self.read(lambda connection: connection.execute(query).all())]

    def read(self, action: Callable[[Connection], T]) -> T:
        """Run ``action``, which must not write; StoreError for what the database makes of it."""

        def once() -> T:
            with self._engine.connect() as connection:
                return action(connection)

        return self._persist(once)

    def write(self, action: Callable[[Connection], T], study_id: int | None = None, term: int | None = None) -> T:
        """Run ``action`` as one transaction; again when a connection is lost or the disk is full, so it must bear repetition."""
        if self.read_only:
            raise StoreError(f"{self.label}: opened read-only")

        def once() -> T:
            with self._engine.execution_options(writing=True).begin() as connection:
                if term is not None:
                    row = connection.execute(select(schema.holder).where(schema.holder.c.study_id == study_id)).first()
                    if row is None or row.term != term:
                        by = "nobody" if row is None else f"process {row.process} on {row.host} since {row.since}"
                        raise StoreError(
                            f"{self.label}: this study was taken over by {by}; nothing is written on behalf of its former holder"
                        )
                return action(connection)

        return self._persist(once)

    def _persist(self, once: Callable[[], T]) -> T:
        until = time.monotonic() + self.busy_timeout_s
        while True:
            try:
                return once()
            except IntegrityError as error:
                raise StoreError(f"{self.label}: refused by the store ({error.orig})") from error
            except DBAPIError as error:
                if self.database.passes(error) and time.monotonic() < until:
                    time.sleep(PAUSE_S)
                    continue
                message = self.database.explain(error)
                if "is locked" in message:
                    message += f"; last holder: {self.holder()}"
                raise StoreError(message) from error


def _add_trace(connection: Connection, study_id: int, number: int, trace: bytes | None) -> None:
    if trace is None:
        return
    known = facts(trace)
    values = {"data": trace, "units": canonical_json(known.units, "units"), "sampling_time_s": known.sampling_time_s}
    connection.execute(insert(schema.trace).values(study_id=study_id, number=number, **values))
