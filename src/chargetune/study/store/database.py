"""What a store needs of the database below it, and which database a location means."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Protocol

from sqlalchemy import Connection, Engine
from sqlalchemy.exc import DBAPIError

from chargetune.study.store.rows import StoreError
from chargetune.study.store.sqlite import SqliteFile

__all__ = ["Database", "Hold", "database_at", "store_name"]


class Hold(Protocol):
    """A study that this process holds until it is released or the process ends."""

    def release(self) -> None:
        """Give the study back."""
        ...


class Database(Protocol):
    """SQLite file or PostgreSQL server. A transaction with the execution option ``writing`` is the only one of its kind at a time."""

    @property
    def location(self) -> str:
        """What opens it again."""
        ...

    @property
    def label(self) -> str:
        """How messages name it; without a password."""
        ...

    def prepare(self, *, read_only: bool, busy_timeout_s: float) -> None:
        """Make an empty store where there is nothing yet, and bring an old one to this schema. Raises StoreError."""
        ...

    def connect_damaged(self) -> Engine:
        """An engine that reads what it can of a store that may be damaged. Raises StoreError when there is nothing at all."""
        ...

    def connect(self, *, read_only: bool, busy_timeout_s: float) -> Engine:
        """An engine for the store that `prepare` left."""
        ...

    def damage(self, connection: Connection, *, full: bool = False) -> str:
        """What a quick or a full check of the database finds; empty when it finds nothing."""
        ...

    def explain(self, error: DBAPIError) -> str:
        """What a database error means for a person."""
        ...

    def passes(self, error: DBAPIError) -> bool:
        """Whether the same transaction may succeed a moment later: the connection broke, or the disk is full."""
        ...

    def mark(self) -> tuple[object, bool]:
        """Something that differs after every change, and whether it is to be trusted: an equal one then means no change."""
        ...

    def hold(self, study_id: int) -> Hold | None:
        """Take a study for this process; None when another process has it."""
        ...


def database_at(location: str | os.PathLike[str]) -> Database:
    """The database of a path or of a URL ``postgresql://user@host/database``. Raises StoreError for another URL."""
    text = os.fspath(location)
    scheme = re.match(r"([A-Za-z][A-Za-z0-9+.-]*)://", text)
    if scheme is None:
        return SqliteFile(Path(text).resolve())
    if scheme[1] not in ("postgresql", "postgresql+psycopg", "postgres"):
        raise StoreError(f"store {scheme[0]}...: allowed are the path of a file and postgresql://user@host/database")
    # Only here: the driver is an extra.
    from chargetune.study.store.postgres import server_at

    return server_at(text)


def store_name(location: str | os.PathLike[str]) -> str:
    """What a page calls the store: the file's name, or the URL without its password."""
    database = database_at(location)
    return database.path.name if isinstance(database, SqliteFile) else database.label
