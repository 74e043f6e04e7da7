"""The tables of a store. Times are UTC as ISO 8601 text; JSON is text, so that what is read is what was written, to the last bit."""

from __future__ import annotations

from sqlalchemy import (
    BigInteger,
    Column,
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

__all__ = ["SCHEMA_VERSION", "holder", "metadata", "store", "study", "trace", "trial"]

SCHEMA_VERSION = 1

metadata = MetaData()

store = Table(
    "chargetune_store",
    metadata,
    Column("schema_version", Integer, primary_key=True),
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
)

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
    PrimaryKeyConstraint("study_id", "number"),
)

# A table of its own: listing the trials must not read past the traces.
trace = Table(
    "trace",
    metadata,
    Column("study_id", Integer, nullable=False),
    Column("number", Integer, nullable=False),
    Column("data", LargeBinary, nullable=False),
    PrimaryKeyConstraint("study_id", "number"),
    ForeignKeyConstraint(["study_id", "number"], ["trial.study_id", "trial.number"]),
)

# Who works on a study, for people to read. The lock itself is the operating system's, see lease.py.
holder = Table(
    "holder",
    metadata,
    Column("study_id", ForeignKey("study.id"), primary_key=True),
    Column("process", Integer, nullable=False),
    Column("host", Text, nullable=False),
    Column("since", String(40), nullable=False),
)
