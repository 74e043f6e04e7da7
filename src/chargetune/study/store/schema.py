"""The tables of a store. Times are UTC as ISO 8601 text; JSON is text, so that what is read is what was written, to the last bit."""

from __future__ import annotations

from sqlalchemy import (
    BigInteger,
    Column,
    Float,
    ForeignKey,
    ForeignKeyConstraint,
    Integer,
    LargeBinary,
    MetaData,
    PrimaryKeyConstraint,
    String,
    Table,
    Text,
)

__all__ = ["SCHEMA_VERSION", "holder", "metadata", "result", "store", "study", "trace", "trial"]

# 1: the first; 2: traces as zstd, attempts, terms of the holder, hardware; 3: the result of a study
SCHEMA_VERSION = 3

metadata = MetaData()

# One row for each version the store has had.
store = Table(
    "chargetune_store",
    metadata,
    Column("schema_version", Integer, primary_key=True, autoincrement=False),
    Column("created_at", String(40), nullable=False),
    Column("created_by", Text, nullable=False),
)

study = Table(
    "study",
    metadata,
    Column("id", Integer, primary_key=True),
    Column("name", String(100), nullable=False, unique=True),
    Column("created_at", String(40), nullable=False),
    Column("identity", Text, nullable=False),  # JSON: config, space, tuner, seed, batch
    Column("identity_sha256", String(64), nullable=False),
    Column("versions", Text, nullable=False),  # JSON, of the programs that created the study
    Column("hardware", Integer, nullable=False, server_default="0"),  # 1: a trial is handed out at most once
)

# Numbers below 0 are D_0: told trials of earlier studies, imported when the study began.
trial = Table(
    "trial",
    metadata,
    Column("study_id", ForeignKey("study.id"), nullable=False),
    Column("number", Integer, nullable=False),
    Column("theta", Text, nullable=False),
    Column("status", String(16), nullable=False),
    Column("score", Text),
    Column("ending", Text),
    Column("seed", BigInteger, nullable=False),
    Column("asked_at", String(40), nullable=False),
    Column("told_at", String(40)),
    Column("trace_sha256", String(64)),
    Column("provenance", Text, nullable=False),
    Column("attempt", Integer, nullable=False, server_default="0"),
    Column("worker", Text),
    Column("handed_out_at", String(40)),
    PrimaryKeyConstraint("study_id", "number"),
)

# A table of its own: listing the trials must not read past the traces.
trace = Table(
    "trace",
    metadata,
    Column("study_id", Integer, nullable=False),
    Column("number", Integer, nullable=False),
    Column("data", LargeBinary, nullable=False),
    Column("units", Text, nullable=False, server_default="{}"),  # JSON: unit by signal
    Column("sampling_time_s", Float),
    PrimaryKeyConstraint("study_id", "number"),
    ForeignKeyConstraint(["study_id", "number"], ["trial.study_id", "trial.number"]),
)

# Who works on a study. The lock itself is the operating system's or the server's; the term tells apart who held it when.
holder = Table(
    "holder",
    metadata,
    Column("study_id", ForeignKey("study.id"), primary_key=True, autoincrement=False),
    Column("process", Integer, nullable=False),
    Column("host", Text, nullable=False),
    Column("since", String(40), nullable=False),
    Column("term", Integer, nullable=False, server_default="0"),
)

# Which trial is the result, by the tuner that was asked. It holds for exactly the told trials of ``made_from``.
result = Table(
    "result",
    metadata,
    Column("study_id", ForeignKey("study.id"), primary_key=True, autoincrement=False),
    Column("number", Integer),
    Column("reason", String(16), nullable=False),
    Column("made_from", String(64), nullable=False),
    Column("made_at", String(40), nullable=False),
)
