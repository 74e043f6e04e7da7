"""SQLite under a store: creation of the file, connections, and what its errors mean for a person."""

from __future__ import annotations

import contextlib
import os
import sqlite3
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sqlalchemy import Connection, Engine, create_engine, event, insert
from sqlalchemy.exc import DatabaseError, DBAPIError
from sqlalchemy.pool import QueuePool

from chargetune.study.provenance import made_by, utc_now
from chargetune.study.store import schema
from chargetune.study.store.lease import Lease, take_lease
from chargetune.study.store.migrate import migrate, stored_version
from chargetune.study.store.rows import StoreError

__all__ = ["SqliteFile"]

SALVAGE = "; `chargetune store salvage` saves what can be read into a new file"
# A file system may give two writes within some milliseconds the same time: a change younger than this may hide another.
SETTLED_S = 1.0
# How long reading a damaged file waits for a writer.
PATIENCE_S = 10.0


@dataclass(frozen=True)
class SqliteFile:
    """A store in one file: WAL, synchronous FULL, immediate transactions."""

    path: Path

    @property
    def location(self) -> str:
        """What opens the same store again."""
        return str(self.path)

    @property
    def label(self) -> str:
        """The path."""
        return str(self.path)

    def prepare(self, *, read_only: bool, busy_timeout_s: float) -> None:
        """Make an empty store unless there is a file, and bring an old one to this schema; StoreError when there can be none."""
        try:
            if not _is_there(self.path, read_only=read_only):
                _create(self.path)
                return
            engine = self.connect(read_only=read_only, busy_timeout_s=busy_timeout_s)
            try:
                with engine.connect() as connection:
                    self._check(connection, read_only=read_only)
                migrate(engine, self.path)
            finally:
                engine.dispose()
        except DatabaseError as error:
            raise StoreError(self.explain(error)) from error
        except OSError as error:
            raise StoreError(f"{self.path}: cannot be opened or created ({error.strerror})") from error

    def connect_damaged(self) -> Engine:
        """An engine that only reads, and opens a file that was cut off, too."""
        _is_there(self.path, read_only=True)
        return connect_engine(self.path, read_only=True, busy_timeout_s=PATIENCE_S, damaged=True)

    def connect(self, *, read_only: bool, busy_timeout_s: float) -> Engine:
        """An engine on the file; a transaction with the execution option ``writing`` takes the write lock when it begins."""
        return connect_engine(self.path, read_only=read_only, busy_timeout_s=busy_timeout_s)

    def damage(self, connection: Connection, *, full: bool = False) -> str:
        """What SQLite's own check finds, of the whole file or of all but the traces; empty when it finds nothing."""
        if full:
            rows = connection.exec_driver_sql("PRAGMA integrity_check").scalars().all()
            return "" if rows == ["ok"] else "; ".join(str(row) for row in rows)
        # Traces are checked by their hash when read: going over all of them would take seconds at each start.
        there = set(connection.exec_driver_sql("SELECT name FROM sqlite_master WHERE type = 'table'").scalars())
        # A store of an older schema lacks some.
        for table in (t.name for t in schema.metadata.sorted_tables if t is not schema.trace and t.name in there):
            verdict = connection.exec_driver_sql(f"PRAGMA quick_check('{table}')").scalar()
            if verdict != "ok":
                return str(verdict)
        return ""

    def explain(self, error: DBAPIError) -> str:
        """What a database error means for the person at the keyboard."""
        return explain(self.path, error)

    def passes(self, error: DBAPIError) -> bool:
        """Whether the disk is full: somebody may make room."""
        return getattr(error.orig, "sqlite_errorcode", 0) & 0xFF == sqlite3.SQLITE_FULL

    def mark(self) -> tuple[object, bool]:
        """Identity, size and time of the file and of its log, and whether the newest of them has some age."""
        marks: list[tuple[int, int, int]] = []
        newest = 0.0
        for path in (self.path, self.path.with_name(self.path.name + "-wal")):
            try:
                found = path.stat()
            except OSError:
                continue
            # An empty log says nothing, and comes and goes with those who only read.
            if found.st_size:
                marks.append((found.st_ino, found.st_size, found.st_mtime_ns))
                newest = max(newest, found.st_mtime)
        return tuple(marks), time.time() - newest > SETTLED_S

    def hold(self, study_id: int) -> Lease | None:
        """Lock the study's byte of the lock file beside the store."""
        try:
            return take_lease(self.path, study_id)
        except OSError as error:
            raise StoreError(f"{self.path}-lock: cannot be opened or locked ({error.strerror})") from error

    def _check(self, connection: Connection, *, read_only: bool) -> None:
        tables = {str(row[0]) for row in connection.exec_driver_sql("SELECT name FROM sqlite_master WHERE type = 'table'")}
        if schema.store.name not in tables:
            raise StoreError(f"{self.path}: a database, but not a store of this program (no table {schema.store.name})")
        version = stored_version(connection)
        if version is None or version > schema.SCHEMA_VERSION:
            raise StoreError(
                f"{self.path}: schema version {version}, this program knows versions up to {schema.SCHEMA_VERSION};"
                " open it with the newer program that wrote it"
            )
        damage = self.damage(connection)
        if damage:
            raise StoreError(f"{self.path}: damaged, nothing was changed ({' '.join(damage.split())}){SALVAGE}")
        if version < schema.SCHEMA_VERSION and read_only:
            raise StoreError(
                f"{self.path}: schema version {version}, this program reads version {schema.SCHEMA_VERSION};"
                f" `chargetune store migrate {self.path}` converts it and keeps the old file"
            )


def _is_there(path: Path, *, read_only: bool) -> bool:
    # The file is only looked at from outside: closing a handle of our own would drop the locks that SQLite holds on it in this process.
    if path.is_dir():
        raise StoreError(f"{path}: a directory, allowed is the path of a file")
    if path.exists():
        if path.stat().st_size == 0:
            raise StoreError(f"{path}: an empty file, not a store; was it cut off? Remove it to begin a new store")
        return True
    if read_only:
        raise StoreError(f"{path}: no such store")
    if not path.parent.is_dir():
        raise StoreError(f"{path}: there is no folder {path.parent}")
    return False


def _create(path: Path) -> None:
    # A kill during creation must leave either no store or a whole one, so it is made aside and then given its name.
    aside = path.with_name(f".{path.name}.{os.getpid()}.new")
    # What a killed process of the same number left may be a second name of a store in use.
    aside.unlink(missing_ok=True)
    try:
        engine = connect_engine(aside, read_only=False, busy_timeout_s=0.0, mode="rwc")
        try:
            # The one statement that must stand outside of a transaction. The mode stays with the file.
            with engine.connect().execution_options(autocommit=True) as connection:
                connection.exec_driver_sql("PRAGMA journal_mode=WAL")
            with engine.execution_options(writing=True).begin() as connection:
                schema.metadata.create_all(connection)
                values = {"schema_version": schema.SCHEMA_VERSION, "created_at": utc_now(), "created_by": made_by()}
                connection.execute(insert(schema.store).values(values))
        finally:
            engine.dispose()
        try:
            path.hardlink_to(aside)
        except FileExistsError:
            pass  # another process was first, its store is as good
        except OSError:
            aside.rename(path)  # a file system without hard links
    finally:
        aside.unlink(missing_ok=True)


def connect_engine(path: Path, *, read_only: bool, busy_timeout_s: float, mode: str = "rw", damaged: bool = False) -> Engine:
    """An engine on the file; ``execution_options(writing=True)`` takes the write lock at the beginning of a transaction."""
    query = "mode=ro" if read_only else f"mode={mode}"
    writable = os.access(path.parent, os.W_OK, effective_ids=os.access in os.supports_effective_ids)
    if read_only and not writable and not path.with_name(path.name + "-wal").exists():
        # WAL needs companion files; where they cannot be made and are not there, nobody is writing either.
        query = "immutable=1"
    uri = f"{path.as_uri()}?{query}"
    tidy = query == "mode=ro" and not any(path.with_name(path.name + end).exists() for end in ("-wal", "-shm", "-journal"))

    def connect() -> sqlite3.Connection:
        # With isolation_level None the transactions are those that `begin` below opens, none is opened behind its back.
        return sqlite3.connect(uri, uri=True, timeout=busy_timeout_s, isolation_level=None, check_same_thread=False)

    engine = create_engine("sqlite://", creator=connect, poolclass=QueuePool)

    @event.listens_for(engine, "connect")
    def configure(connection: Any, _record: object) -> None:
        if damaged:
            # Otherwise a file shorter than its header says is refused as a whole.
            connection.execute("PRAGMA writable_schema=ON")
        connection.execute("PRAGMA foreign_keys=ON")
        connection.execute("PRAGMA synchronous=FULL")

    if tidy:

        @event.listens_for(engine, "engine_disposed")
        def remove_companions(_: Engine) -> None:
            _close_as_writer(path)

    @event.listens_for(engine, "begin")
    def begin(connection: Connection) -> None:
        options = connection.get_execution_options()
        if not options.get("autocommit"):
            connection.exec_driver_sql("BEGIN IMMEDIATE" if options.get("writing") else "BEGIN")

    return engine


def _close_as_writer(path: Path) -> None:
    """Remove the companion files that reading has made: SQLite does so, under its locks, when the last one that may write closes."""
    with contextlib.suppress(sqlite3.Error), contextlib.closing(sqlite3.connect(f"{path.as_uri()}?mode=rw", uri=True, timeout=0.0)) as last:
        last.execute("SELECT count(*) FROM sqlite_master").fetchone()


def explain(path: Path, error: DBAPIError) -> str:
    """What a database error means for the person at the keyboard."""
    reason = str(error.orig)
    code = getattr(error.orig, "sqlite_errorcode", 0) & 0xFF
    meanings = {
        sqlite3.SQLITE_BUSY: "is locked by another process that did not let go in time",
        sqlite3.SQLITE_NOTADB: "not a store (no SQLite database, or damaged at its beginning)",
        sqlite3.SQLITE_CORRUPT: "damaged, nothing was changed",
        sqlite3.SQLITE_READONLY: "no permission to write",
        sqlite3.SQLITE_CANTOPEN: "cannot be opened; reading and writing need permission for the file and its folder",
        sqlite3.SQLITE_FULL: "the disk is full, nothing of this transaction was stored",
        sqlite3.SQLITE_IOERR: "reading or writing failed on the disk",
    }
    remedy = SALVAGE if code == sqlite3.SQLITE_CORRUPT else ""
    return f"{path}: {meanings[code]} ({reason}){remedy}" if code in meanings else f"{path}: {reason}"
