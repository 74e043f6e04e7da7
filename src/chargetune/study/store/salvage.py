"""Salvage: what can be read of a damaged store, as a new store. It copies a whole store, too, from a file to a server or back."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass

from sqlalchemy import Connection, insert, select, update

from chargetune.study.serialization import canonical_json
from chargetune.study.store import schema
from chargetune.study.store.damaged_reader import Damage, Key, Step, columns, opened, read_content, read_traces
from chargetune.study.store.database import database_at
from chargetune.study.store.store import Store, StoreError

__all__ = ["Salvage", "salvage"]


@dataclass(frozen=True)
class Salvage:
    """What was copied, and what was left."""

    store: str
    studies: int
    trials: int
    traces: int
    left: tuple[Damage, ...]


def salvage(source: str | os.PathLike[str], target: str | os.PathLike[str], step: Step | None = None) -> Salvage:
    """Copy every study, trial and trace that is whole to the new store ``target``; the source is not touched.

    A trial whose trace is lost keeps its result, with the entry ``trace_lost`` in its provenance. Numbers stay as they are; a study
    with a gap among them can be read and be the initial data of another one, but not go on.

    Raises StoreError when ``target`` has studies, or when of ``source`` not even the beginning can be read.
    """
    database = database_at(source)
    if database.label == database_at(target).label:
        raise StoreError(f"{database.label}: source and target are one store, allowed is a new one")
    with opened(database) as engine, Store(target) as store:
        if store.studies():
            raise StoreError(f"{store.label}: there are studies in it, allowed is a new store")
        content = read_content(database, engine)
        lost: dict[Key, Damage] = {}

        def copy(connection: Connection) -> int:
            lost.clear()
            copied = 0
            ids: dict[int, int] = {}
            for old, study in content.studies.items():
                connection.execute(insert(schema.study).values({k: v for k, v in columns(study).items() if k != "id"}))
                ids[old] = connection.execute(select(schema.study.c.id).where(schema.study.c.name == study.name)).scalar_one()
            for (study_id, _), trial in sorted(content.trials.items()):
                connection.execute(insert(schema.trial).values({**columns(trial), "study_id": ids[study_id]}))
            for study_id, result in content.results.items():
                connection.execute(insert(schema.result).values({**columns(result), "study_id": ids[study_id]}))
            for key, found in read_traces(database, engine, content, step):
                if isinstance(found, Damage):
                    lost[key] = found
                    continue
                connection.execute(insert(schema.trace).values({**columns(found), "study_id": ids[key[0]]}))
                copied += 1
            for (study_id, number), finding in lost.items():
                known = json.loads(content.trials[study_id, number].provenance)
                values = {"trace_sha256": None, "provenance": canonical_json({**known, "trace_lost": finding.what}, "provenance")}
                where = (schema.trial.c.study_id == ids[study_id], schema.trial.c.number == number)
                connection.execute(update(schema.trial).where(*where).values(values))
            return copied

        traces = store.write(copy)
        return Salvage(store.label, len(content.studies), len(content.trials), traces, (*content.findings, *lost.values()))
