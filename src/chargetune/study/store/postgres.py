"""PostgreSQL under a store: the same tables in a schema of their own, and what the server's errors mean for a person."""

from __future__ import annotations

import os
import threading
from dataclasses import dataclass, field
from typing import Any

from sqlalchemy import URL, Connection, Engine, create_engine, event, func, insert, inspect, make_url, select, text
from sqlalchemy.exc import ArgumentError, DBAPIError
from sqlalchemy.pool import NullPool, QueuePool

from chargetune.study.provenance import made_by, utc_now
from chargetune.study.store import schema
from chargetune.study.store.migrate import from_2_to_3, stored_version
from chargetune.study.store.rows import StoreError

__all__ = ["PostgresServer", "ServerHold", "server_at"]

# The tables' names are common words, so they have a PostgreSQL schema of their own.
SCHEMA = "chargetune"
# Advisory locks of this program: (LOCKS, 0) while a transaction writes, (LOCKS, study id) while a process holds a study.
LOCKS = 0x63747573
CONNECT_S = 10
# The schema to which this program's only adds a table, so that a server needs no copy of its data first.
ADDED_TO = 2
DISK_FULL = "53100"
MEANINGS = {
    "55P03": "is locked by another session that did not let go in time",
    "42501": "no permission for this",
    "25006": "opened read-only",
    DISK_FULL: "the server's disk is full, nothing of this transaction was stored",
    "XX001": "the server reports damaged data, nothing was changed",
    "XX002": "the server reports a damaged index, nothing was changed",
}


@dataclass(frozen=True)
class PostgresServer:
    """A store in a database of a PostgreSQL server."""

    url: URL

    @property
    def location(self) -> str:
        """What opens the same store again, a password included."""
        return self.url.set(drivername="postgresql").render_as_string(hide_password=False)

    @property
    def label(self) -> str:
        """The URL without its password."""
        return self.url.set(drivername="postgresql").render_as_string(hide_password=True)

    def prepare(self, *, read_only: bool, busy_timeout_s: float) -> None:
        """Make the tables unless they are there, and add the one that schema 2 lacks. Raises StoreError for another schema version."""
        engine = self.connect(read_only=read_only, busy_timeout_s=busy_timeout_s)
        try:
            with engine.connect() as connection:
                found = inspect(connection).has_table(schema.store.name, schema=SCHEMA)
            if not found and read_only:
                raise StoreError(f"{self.label}: no store in this database")
            if not found:
                with engine.execution_options(writing=True).begin() as connection:
                    _create(connection)
            with engine.connect() as connection:
                version = stored_version(connection)
            if version == ADDED_TO and not read_only:
                with engine.execution_options(writing=True).begin() as connection:
                    version = _migrated(connection)
        except DBAPIError as error:
            raise StoreError(self.explain(error)) from error
        finally:
            engine.dispose()
        if version != schema.SCHEMA_VERSION:
            raise StoreError(
                f"{self.label}: schema version {version}, this program knows version {schema.SCHEMA_VERSION} on a server;"
                " open it with the program that wrote it"
            )

    def connect_damaged(self) -> Engine:
        """The same as for a whole one: what is unreadable is an error of the server for that row."""
        return self.connect(read_only=True, busy_timeout_s=0.0)

    def connect(self, *, read_only: bool, busy_timeout_s: float) -> Engine:
        """An engine on the server; a transaction with the execution option ``writing`` waits for the one before to end."""
        # Of 0 the server would make "for ever".
        timeout_ms = max(1, round(1000 * busy_timeout_s))
        engine = _engine(self.url, QueuePool, {"pool_pre_ping": True}).execution_options(schema_translate_map={None: SCHEMA})

        @event.listens_for(engine, "begin")
        def begin(connection: Connection) -> None:
            if read_only:
                connection.exec_driver_sql("SET TRANSACTION READ ONLY")
            elif connection.get_execution_options().get("writing"):
                # One message to the server. The commit is durable when it is told, whatever the server is set to.
                settings = f"SET LOCAL lock_timeout = {timeout_ms}; SET LOCAL synchronous_commit = on"
                connection.exec_driver_sql(f"{settings}; SELECT pg_advisory_xact_lock({LOCKS}, 0)")

        return engine

    def damage(self, connection: Connection, *, full: bool = False) -> str:
        """Nothing: the server checks its own pages, and says so in an error."""
        return ""

    def explain(self, error: DBAPIError) -> str:
        """What a database error means for the person at the keyboard."""
        reason = " ".join(str(error.orig).split())
        state = getattr(error.orig, "sqlstate", None)
        if state in MEANINGS:
            return f"{self.label}: {MEANINGS[state]} ({reason})"
        return f"{self.label}: {'no connection to the server' if self.lost(error) else 'refused'} ({reason})"

    def passes(self, error: DBAPIError) -> bool:
        """Whether the connection broke, so that the transaction may or may not have been stored, or the server's disk is full."""
        return self.lost(error) or getattr(error.orig, "sqlstate", None) == DISK_FULL

    def lost(self, error: DBAPIError) -> bool:
        """Whether the connection broke or could not be made: no SQLSTATE, or one of class 08 or 57P (server going down)."""
        state = getattr(error.orig, "sqlstate", None)
        return error.connection_invalidated or (
            type(error.orig).__name__ in ("OperationalError", "AdminShutdown", "CrashShutdown", "CannotConnectNow")
            and (state is None or state.startswith(("08", "57P")))
        )

    def mark(self) -> tuple[object, bool]:
        """Counts of what can be added and the hashes of what can be replaced."""
        engine = self.connect(read_only=True, busy_timeout_s=0.0)
        try:
            with engine.connect() as connection:
                trials = select(func.count(), func.count(schema.trial.c.told_at), func.sum(schema.trial.c.attempt))
                studies = select(schema.study.c.identity_sha256).order_by(schema.study.c.id)
                results = select(schema.result.c.study_id, schema.result.c.made_from).order_by(schema.result.c.study_id)
                counts, known = tuple(connection.execute(trials).one()), tuple(connection.execute(studies).scalars())
                return (counts, known, tuple(map(tuple, connection.execute(results)))), True
        except DBAPIError as error:
            raise StoreError(self.explain(error)) from error
        finally:
            engine.dispose()

    def hold(self, study_id: int) -> ServerHold | None:
        """Take the study's advisory lock on a connection of its own; the server gives it back when that connection ends."""
        key = (os.getpid(), str(self.url), study_id)
        with _guard:
            if key not in _held:
                try:
                    connection = _lock(self.url, study_id)
                except DBAPIError as error:
                    raise StoreError(self.explain(error)) from error
                if connection is None:
                    return None
                _held[key] = [connection, 0]
            _held[key][1] += 1
        return ServerHold(key)


@dataclass(frozen=True)
class ServerHold:
    """A study that this process holds. Within the process it may be taken several times and is free after as many releases.

    A connection that breaks lets another process take the study; the terms in the table of holders then tell the two apart.
    """

    key: tuple[int, str, int] = field(repr=False)

    def release(self) -> None:
        """Give the study back; a hold of before a fork is left alone."""
        with _guard:
            entry = _held.get(self.key)
            if entry is None or self.key[0] != os.getpid():
                return
            entry[1] -= 1
            if entry[1] <= 0:
                del _held[self.key]
                entry[0].close()
                entry[0].engine.dispose()


# [connection, count]; the process is part of the key: a forked child inherits this table but no lock.
_held: dict[tuple[int, str, int], list[Any]] = {}
_guard = threading.Lock()


def server_at(location: str) -> PostgresServer:
    """The server of a URL. Raises StoreError when it is none, or when the driver is not installed."""
    try:
        import psycopg  # noqa: F401
    except ModuleNotFoundError as error:
        raise StoreError("a store on a PostgreSQL server needs psycopg: pip install 'chargetune[postgres]'") from error
    try:
        url = make_url(location).set(drivername="postgresql+psycopg")
    except (ArgumentError, ValueError) as error:
        # The message must not repeat what may hold a password.
        raise StoreError("store: not a URL, allowed is postgresql://user:password@host:port/database") from error
    return PostgresServer(url)


def _engine(url: URL, pool: type[NullPool | QueuePool], options: dict[str, Any]) -> Engine:
    # Keepalives: a connection that a router forgot is noticed within a minute instead of hours.
    alive = {"keepalives": 1, "keepalives_idle": 20, "keepalives_interval": 10, "keepalives_count": 3}
    arguments = {"connect_timeout": CONNECT_S, "application_name": "chargetune", **alive}
    return create_engine(url, poolclass=pool, connect_args=arguments, **options)


def _create(connection: Connection) -> None:
    connection.exec_driver_sql(f"CREATE SCHEMA IF NOT EXISTS {SCHEMA}")
    # Another process may have been first, and has let go of the lock by now.
    if inspect(connection).has_table(schema.store.name, schema=SCHEMA):
        return
    schema.metadata.create_all(connection)
    values = {"schema_version": schema.SCHEMA_VERSION, "created_at": utc_now(), "created_by": made_by()}
    connection.execute(insert(schema.store).values(values))


def _migrated(connection: Connection) -> int | None:
    version = stored_version(connection)
    # Another process may have been first.
    if version != ADDED_TO:
        return version
    from_2_to_3(connection)
    values = {"schema_version": schema.SCHEMA_VERSION, "created_at": utc_now(), "created_by": made_by()}
    connection.execute(insert(schema.store).values(values))
    return schema.SCHEMA_VERSION


def _lock(url: URL, study_id: int) -> Connection | None:
    engine = _engine(url, NullPool, {"isolation_level": "AUTOCOMMIT"})
    connection = engine.connect()
    if connection.execute(text("SELECT pg_try_advisory_lock(:locks, :study)"), {"locks": LOCKS, "study": study_id}).scalar():
        return connection
    connection.close()
    engine.dispose()
    return None
