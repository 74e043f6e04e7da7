"""What can be read of a store that may be damaged: row by row, so that one bad page costs what lies on it and no more."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import count
from typing import Any

from sqlalchemy import ColumnElement, Engine, Row, Table, func, inspect, literal_column, select
from sqlalchemy.exc import DBAPIError

from chargetune.runtime.counted import counted
from chargetune.study.serialization import canonical_json, sha256
from chargetune.study.store import schema
from chargetune.study.store.database import Database
from chargetune.study.store.rows import StoreError, record_of, trial_of
from chargetune.study.store.sqlite import SqliteFile
from chargetune.study.store.trace import content_sha256, decode
from chargetune.study.trial import TrialStatus

__all__ = ["Content", "Damage", "Key", "Step", "columns", "opened", "read_content", "read_traces"]

# (id of the study, number of the trial)
Key = tuple[int, int]
# Receives the rows read so far and how many there are in all.
Step = Callable[[int, int], None]
# Where even the number of the last row is lost, reading ends after so many numbers without a row.
STRAY = 5000


@dataclass(frozen=True)
class Damage:
    """Something that is not as it was stored. ``study`` and ``trial`` are None where it concerns no single one."""

    study: str | None
    trial: int | None
    what: str

    def __str__(self) -> str:
        places = [f"study {self.study!r}" if self.study is not None else "", f"trial {self.trial}" if self.trial is not None else ""]
        return ": ".join([", ".join(p for p in places if p), self.what]).removeprefix(": ")


@dataclass(frozen=True)
class Content:
    """Studies, trials and results that are whole, as rows of their tables, and what is wrong with the others."""

    names: Mapping[int, str]
    studies: Mapping[int, Row[Any]]
    trials: Mapping[Key, Row[Any]]
    results: Mapping[int, Row[Any]]
    findings: tuple[Damage, ...]


@contextmanager
def opened(database: Database) -> Iterator[Engine]:
    """An engine on a store of this schema, damaged or not. Raises StoreError for what is no such store."""
    engine = database.connect_damaged()
    try:
        try:
            with engine.connect() as connection:
                place = connection.get_execution_options().get("schema_translate_map", {}).get(None)
                if not inspect(connection).has_table(schema.store.name, schema=place):
                    raise StoreError(f"{database.label}: no store of this program (no table {schema.store.name})")
                version = connection.execute(select(func.max(schema.store.c.schema_version))).scalar()
        except DBAPIError as error:
            raise StoreError(database.explain(error)) from error
        if version != schema.SCHEMA_VERSION:
            raise StoreError(
                f"{database.label}: schema version {version}, allowed is {schema.SCHEMA_VERSION};"
                " `chargetune store migrate` converts an older one that is whole"
            )
        yield engine
    finally:
        engine.dispose()


def columns(row: Row[Any]) -> dict[str, Any]:
    """A row by the names of its columns."""
    return dict(row._mapping)  # noqa: SLF001 - the name that SQLAlchemy documents


def read_content(database: Database, engine: Engine) -> Content:
    """Every study and trial that can be read and is consistent in itself."""
    findings: list[Damage] = []
    names: dict[int, str] = {}
    studies: dict[int, Row[Any]] = {}
    trials: dict[Key, Row[Any]] = {}
    for row in _rows(database, engine, schema.study, findings):
        names[row.id] = str(row.name)
        wrong = _study_fault(row)
        if wrong:
            findings.append(Damage(names[row.id], None, wrong))
        else:
            studies[row.id] = row
    for row in _rows(database, engine, schema.trial, findings):
        key = (row.study_id, row.number)
        name = names.get(key[0], f"(number {key[0]}, its description is lost)")
        wrong = _trial_fault(row)
        if wrong:
            findings.append(Damage(name, key[1], wrong))
        elif key[0] not in studies:
            findings.append(Damage(name, key[1], "its study is damaged"))
        else:
            trials[key] = row
    for study in studies:
        numbers = {number for owner, number in trials if owner == study}
        known = {f.trial for f in findings if f.study == names[study]}
        missing = sorted(set(range(min(numbers, default=0), max(numbers, default=-1) + 1)) - numbers - known - {None})
        findings += [Damage(names[study], number, "missing") for number in missing]
    results: dict[int, Row[Any]] = {}
    for row in _rows(database, engine, schema.result, findings):
        # A result whose trial is lost is none, and the trial is among the findings.
        if row.study_id in studies and (row.number is None or (row.study_id, row.number) in trials):
            results[row.study_id] = row
    return Content(names, studies, trials, results, tuple(findings))


def read_traces(database: Database, engine: Engine, content: Content, step: Step | None = None) -> Iterator[tuple[Key, Row[Any] | Damage]]:
    """The trace of each whole trial that has one, as a row, or what is wrong with it."""
    due = {key: row.trace_sha256 for key, row in content.trials.items() if row.trace_sha256 is not None}
    total, lost = len(due), list[Damage]()
    for row in _rows(database, engine, schema.trace, lost):
        key = (row.study_id, row.number)
        name = content.names.get(key[0], str(key[0]))
        if key in due:
            wrong = _trace_fault(row, due.pop(key))
            yield key, Damage(name, key[1], wrong) if wrong else row
        elif key in content.trials:
            yield key, Damage(name, key[1], "a trace, but the trial says that it has none")
        if step is not None:
            step(total - len(due), total)
    for key in due:
        yield key, Damage(content.names[key[0]], key[1], "its trace is missing or cannot be read")


def _rows(database: Database, engine: Engine, table: Table, findings: list[Damage]) -> Iterator[Row[Any]]:
    """Each row by its key. What cannot be read goes to ``findings``, as one for the table."""
    lost, why = 0, ""
    # SQLite finds a row by its number without the index, and a number without a row costs microseconds.
    by_number = isinstance(database, SqliteFile)
    key: list[ColumnElement[Any]] = [literal_column("rowid")] if by_number else list(table.primary_key)
    last: int | None = None
    keys: Iterable[tuple[Any, ...]] = ()
    try:
        with engine.connect() as connection:
            if by_number:
                last = connection.execute(select(func.max(key[0])).select_from(table)).scalar() or 0
            else:
                keys = [tuple(row) for row in connection.execute(select(*key).order_by(*key))]
    except DBAPIError as error:
        lost, why = 1, str(error.orig)
    if by_number:
        keys = ((number,) for number in (count(1) if last is None else range(1, last + 1)))
    misses = 0
    for values in keys:
        try:
            with engine.connect() as connection:
                row = connection.execute(select(table).where(*(c == v for c, v in zip(key, values, strict=True)))).first()
        except (DBAPIError, ValueError) as error:  # ValueError: text that is no UTF-8
            row, lost, why = None, lost + 1, str(getattr(error, "orig", error))
        misses = 0 if row is not None else misses + 1
        if row is not None:
            yield row
        elif last is None and misses == STRAY:
            break
    if lost:
        many = "rows" if last is None else f"{lost} of at most {counted(last, 'row')}"
        findings.append(Damage(None, None, f"{many} of the table {table.name} cannot be read ({why})"))


def _study_fault(row: Row[Any]) -> str:
    try:
        record = record_of(row)
        if sha256(row.identity) != record.identity_sha256:
            return "the SHA-256 of its description is not the stored one"
        canonical_json(record.versions, "versions")
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        return f"its description cannot be read ({error})"
    return ""


def _trial_fault(row: Row[Any]) -> str:
    try:
        trial = trial_of(row)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        return f"cannot be read ({error})"
    told = trial.status is not TrialStatus.RUNNING
    if told != (trial.told_at is not None) or told != bool(trial.ending):
        return f"is {trial.status}, told at {trial.told_at}, ending {trial.ending!r}: these contradict each other"
    if trial.trace_sha256 is not None and not told:
        return "is running and has a trace"
    return ""


def _trace_fault(row: Row[Any], expected: str) -> str:
    try:
        arrays, meta = decode(bytes(row.data))
    except (TypeError, ValueError) as error:
        return f"its trace is damaged ({error})"
    return "" if content_sha256(arrays, meta) == expected else "its trace is damaged (its SHA-256 is not the stored one)"
