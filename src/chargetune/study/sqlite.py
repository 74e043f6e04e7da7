"""SQLite under a store: creation of the file, connections, and what its errors mean for a person."""

from __future__ import annotations

import os
import sqlite3
from pathlib import Path
from typing import Any

from sqlalchemy import Connection, Engine, create_engine, event, insert
from sqlalchemy.exc import DatabaseError
from sqlalchemy.pool import QueuePool

from chargetune.study import schema
from chargetune.study.provenance import utc_now, versions

__all__ = ["BEGIN_WRITING", "StoreError", "connect_engine", "create_file", "explain"]

BEGIN_WRITING = "BEGIN IMMEDIATE"


class StoreError(Exception):
    """The store cannot be used, or refuses what was asked; the message names the file and the reason."""


def create_file(path: Path, *, read_only: bool) -> None:
    """Make an empty store at ``path`` unless there is a file; StoreError when there can be none."""
    try:
        if not _is_there(path, read_only=read_only):
            _create(path)
    except DatabaseError as error:
        raise StoreError(explain(path, error)) from error
    except OSError as error:
        raise StoreError(f"{path}: cannot be opened or created ({error.strerror})") from error


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
            with engine.connect().execution_options(begin=None) as connection:
                connection.exec_driver_sql("PRAGMA journal_mode=WAL")
            with engine.execution_options(begin=BEGIN_WRITING).begin() as connection:
                schema.metadata.create_all(connection)
                made_by = f"chargetune {versions().get('chargetune', '(not installed)')}"
                values = {"schema_version": schema.SCHEMA_VERSION, "created_at": utc_now(), "created_by": made_by}
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


def connect_engine(path: Path, *, read_only: bool, busy_timeout_s: float, mode: str = "rw") -> Engine:
    """An engine on the file; ``execution_options(begin=BEGIN_WRITING)`` takes the write lock at the beginning of a transaction."""
    query = "mode=ro" if read_only else f"mode={mode}"
    writable = os.access(path.parent, os.W_OK, effective_ids=os.access in os.supports_effective_ids)
    if read_only and not writable and not path.with_name(path.name + "-wal").exists():
        # WAL needs companion files; where they cannot be made and are not there, nobody is writing either.
        query = "immutable=1"
    uri = f"{path.as_uri()}?{query}"

    def connect() -> sqlite3.Connection:
        # With isolation_level None the transactions are those that `begin` below opens, none is opened behind its back.
        return sqlite3.connect(uri, uri=True, timeout=busy_timeout_s, isolation_level=None, check_same_thread=False)

    engine = create_engine("sqlite://", creator=connect, poolclass=QueuePool)

    @event.listens_for(engine, "connect")
    def configure(connection: Any, _record: object) -> None:
        connection.execute("PRAGMA foreign_keys=ON")
        connection.execute("PRAGMA synchronous=FULL")

    @event.listens_for(engine, "begin")
    def begin(connection: Connection) -> None:
        statement = connection.get_execution_options().get("begin", "BEGIN")
        if statement is not None:
            connection.exec_driver_sql(statement)

    return engine


def explain(path: Path, error: DatabaseError) -> str:
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
    return f"{path}: {meanings[code]} ({reason})" if code in meanings else f"{path}: {reason}"
