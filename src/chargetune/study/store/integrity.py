"""Check of a store: the database, every study, every trial, every trace's hash."""

from __future__ import annotations

import os
from dataclasses import dataclass

from sqlalchemy.exc import DBAPIError

from chargetune.study.store.damaged_reader import Damage, Step, opened, read_content, read_traces
from chargetune.study.store.database import database_at

__all__ = ["Verdict", "check_store"]


@dataclass(frozen=True)
class Verdict:
    """What a check read, and found wrong."""

    store: str
    studies: int
    trials: int
    traces: int
    findings: tuple[Damage, ...]


def check_store(location: str | os.PathLike[str], step: Step | None = None) -> Verdict:
    """Read everything and change nothing; ``step`` receives the traces read so far and all there are.

    Raises StoreError for what is no store at all, or one of another schema version.
    """
    database = database_at(location)
    with opened(database) as engine:
        findings = []
        try:
            with engine.connect() as connection:
                damage = database.damage(connection, full=True)
        except DBAPIError as error:
            damage = database.explain(error)
        if damage:
            findings.append(Damage(None, None, f"the database is damaged ({_short(damage)})"))
        content = read_content(database, engine)
        traces = 0
        for _, found in read_traces(database, engine, content, step):
            traces += not isinstance(found, Damage)
            findings += [found] if isinstance(found, Damage) else []
    return Verdict(database.label, len(content.studies), len(content.trials), traces, (*content.findings, *findings))


def _short(text: str) -> str:
    text = " ".join(text.split())
    return text if len(text) <= 300 else text[:297] + "..."
