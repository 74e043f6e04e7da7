"""Stores of older schemas, brought to this one: a copy of the file first, then everything in one transaction."""

from __future__ import annotations

import json
import os
import re
import sqlite3
import struct
import zlib
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection, Engine, func, insert, select, text, update

from chargetune.study.provenance import made_by, utc_now
from chargetune.study.serialization import canonical_json, sha256
from chargetune.study.store import schema
from chargetune.study.store.trace import encode, expand, facts

__all__ = ["from_2_to_3", "migrate", "stored_version"]


def stored_version(connection: Connection) -> int | None:
    """The schema version of a store, None when it says none."""
    version: int | None = connection.execute(select(func.max(schema.store.c.schema_version))).scalar()
    return version


def migrate(engine: Engine, path: Path) -> Path | None:
    """Bring an SQLite store to this schema; the path of the copy of the old file, None when there was nothing to do.

    A crash at any moment leaves the old store or the new one. Other processes wait.
    """
    with engine.connect() as connection:
        if stored_version(connection) == schema.SCHEMA_VERSION:
            return None
    with engine.execution_options(writing=True).begin() as connection:
        version = stored_version(connection)
        # Another process may have been first.
        if version == schema.SCHEMA_VERSION:
            return None
        copy = _back_up(path, version)
        if version == 1:
            _from_1_to_2(connection)
        from_2_to_3(connection)
        values = {"schema_version": schema.SCHEMA_VERSION, "created_at": utc_now(), "created_by": made_by()}
        connection.execute(insert(schema.store).values(values))
    return copy


def _back_up(path: Path, version: int | None) -> Path:
    # The write lock is held, so the copy is the state that is changed below.
    aside = path.with_name(f".{path.name}.{os.getpid()}.copy")
    aside.unlink(missing_ok=True)
    with closing(sqlite3.connect(f"{path.as_uri()}?mode=ro", uri=True)) as source, closing(sqlite3.connect(aside)) as target:
        source.backup(target)
        target.execute("PRAGMA journal_mode=DELETE")
    for count in range(1000):
        copy = path.with_name(f"{path.name}.schema-{version}" + (f".{count}" if count else ""))
        try:
            copy.hardlink_to(aside)
        except FileExistsError:
            continue  # of a migration that was interrupted; it may be all that somebody has
        except OSError:
            aside.rename(copy)  # a file system without hard links
        break
    aside.unlink(missing_ok=True)
    return copy


def from_2_to_3(connection: Connection) -> None:
    """Make the table of results, empty, and bring every identity to what `study_identity` makes today.

    Of an older study the result is what was measured, until its tuner is asked. An identity that is damaged stays as it is.
    """
    schema.result.create(connection)
    study = schema.study.c
    for row in connection.execute(select(study.id, study.identity, study.identity_sha256)).all():
        if sha256(row.identity) == row.identity_sha256:
            identity = canonical_json(_identity_3(json.loads(row.identity)), "identity")
            values = {"identity": identity, "identity_sha256": sha256(identity)}
            connection.execute(update(schema.study).where(study.id == row.id).values(values))


def _identity_3(identity: dict[str, Any]) -> dict[str, Any]:
    """An identity of schema 2 as schema 3 has it: the tuner without the problem, which its configuration holds, and by today's name."""
    config, tuner = identity.get("config"), identity.get("tuner")
    if isinstance(config, dict) and isinstance(config.get("study"), dict) and config["study"].get("tuner") == "envelope":
        config["study"]["tuner"] = "iterative_learning"
    if isinstance(tuner, dict):
        if tuner.get("type") == "Envelope":
            tuner["type"] = "IterativeLearning"
        if isinstance(tuner.get("loop"), dict):
            tuner["loop"].pop("problem", None)
    return identity


def _from_1_to_2(connection: Connection) -> None:
    for statement in (
        "ALTER TABLE study ADD COLUMN hardware INTEGER DEFAULT '0' NOT NULL",
        "ALTER TABLE trial ADD COLUMN attempt INTEGER DEFAULT '0' NOT NULL",
        "ALTER TABLE trial ADD COLUMN worker TEXT",
        "ALTER TABLE trial ADD COLUMN handed_out_at VARCHAR(40)",
        "ALTER TABLE trace ADD COLUMN units TEXT DEFAULT '{}' NOT NULL",
        "ALTER TABLE trace ADD COLUMN sampling_time_s FLOAT",
        "ALTER TABLE holder ADD COLUMN term INTEGER DEFAULT '0' NOT NULL",
        # Every running trial may have been begun.
        "UPDATE trial SET attempt = 1",
    ):
        connection.execute(text(statement))
    keys = connection.execute(text("SELECT study_id, number FROM trace")).all()
    for study_id, number in keys:
        where = {"s": study_id, "n": number}
        row = connection.execute(
            text("SELECT data, trace_sha256 FROM trace JOIN trial USING (study_id, number) WHERE study_id = :s AND number = :n"), where
        ).one()
        try:
            data = encode(*_decode_1(row.data)) if sha256(row.data) == row.trace_sha256 else None
        except (KeyError, TypeError, ValueError, struct.error, zlib.error):
            data = None
        # A damaged trace stays as it is, and stays flagged.
        if data is None:
            continue
        known = facts(data)
        connection.execute(
            text("UPDATE trace SET data = :d, units = :u, sampling_time_s = :t WHERE study_id = :s AND number = :n"),
            {"d": data, "u": canonical_json(known.units, "units"), "t": known.sampling_time_s, **where},
        )
        connection.execute(text("UPDATE trial SET trace_sha256 = :h WHERE study_id = :s AND number = :n"), {"h": known.sha256, **where})


MAGIC_1 = b"chargetune trace 1\n"
DTYPE = re.compile(r"[<|][biuf][1248]")


def _decode_1(data: bytes) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Arrays and metadata of a trace of schema 1: magic, length, header, one zlib block for each array."""
    if not data.startswith(MAGIC_1):
        raise ValueError("trace: these bytes do not begin as a trace of schema 1 does")
    start = len(MAGIC_1) + 4
    (length,) = struct.unpack_from("<I", data, len(MAGIC_1))
    header = json.loads(data[start : start + length])
    position = start + length
    arrays = {}
    for entry in header["arrays"]:
        if not DTYPE.fullmatch(entry["dtype"]):
            raise ValueError(f"trace: dtype {entry['dtype']!r} is not allowed")
        plain = zlib.decompress(data[position : position + entry["length"]])
        arrays[str(entry["name"])] = expand(plain, np.dtype(entry["dtype"]), tuple(entry["shape"]), entry["filter"])
        position += entry["length"]
    return arrays, dict(header["meta"])
