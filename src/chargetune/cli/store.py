"""chargetune store check, salvage, export and migrate."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path

from chargetune.battery.studies.bdf_export import Format, export, planned_files
from chargetune.cli.output import console, shown, steps
from chargetune.cli.outputs import Kind, Output, claim
from chargetune.runtime.counted import counted
from chargetune.study.store.damaged_reader import Damage
from chargetune.study.store.integrity import check_store
from chargetune.study.store.salvage import salvage
from chargetune.study.store.schema import SCHEMA_VERSION
from chargetune.study.store.store import Store

__all__ = ["check_command", "export_command", "migrate_command", "salvage_command"]

SHOWN = 20


def check_command(location: str, *, as_json: bool) -> None:
    """Read everything in a store; exit code 1 when something is not as it was stored."""
    with steps("traces", quiet=as_json) as step:
        verdict = check_store(location, step)
    counts = {"studies": verdict.studies, "trials": verdict.trials, "traces": verdict.traces}
    if as_json:
        print(json.dumps({"store": verdict.store, **counts, "findings": _facts(verdict.findings)}))  # noqa: T201
    else:
        _lines(list(map(str, verdict.findings)))
        closing = f"{counted(len(verdict.findings), 'finding')}" if verdict.findings else "nothing wrong"
        remedy = "\n`chargetune store salvage STORE NEW` saves what is whole into a new store" if verdict.findings else ""
        console().print(f"{verdict.store}: {_all_counted(counts)} are whole; {closing}{remedy}", markup=False, soft_wrap=True)
    if verdict.findings:
        sys.exit(1)


def salvage_command(location: str, target: str, *, as_json: bool) -> None:
    """Copy what is whole, and name what was left."""
    if "://" not in target:
        # That a store is there is refused where its studies are known.
        claim([Output("NEW", Path(target), Kind.STORE, renewed=True)], inputs=[location], overwrite=False, folders=False)
    with steps("traces", quiet=as_json) as step:
        saved = salvage(location, target, step)
    counts = {"studies": saved.studies, "trials": saved.trials, "traces": saved.traces}
    if as_json:
        print(json.dumps({"store": saved.store, **counts, "left": _facts(saved.left)}))  # noqa: T201
        return
    _lines([f"left: {finding}" for finding in saved.left])
    closing = f"{counted(len(saved.left), 'finding')}" if saved.left else "nothing was left"
    console().print(f"{saved.store}: {_all_counted(counts)} saved; {closing}", markup=False, soft_wrap=True)


def export_command(location: str, *, out: Path, study: str | None, form: Format, overwrite: bool, as_json: bool) -> None:
    """Write trials and traces as tables."""
    kinds = {".json": Kind.JSON, ".csv": Kind.CSV, ".parquet": Kind.PARQUET}
    with Store(location, read_only=True) as store:
        planned = planned_files(store, out, study=study, form=form)
        claim([Output("--out", p, kinds[p.suffix]) for p in planned], inputs=[location], overwrite=overwrite)
        try:
            with steps("trials", quiet=as_json) as step:
                written = export(store, out, study=study, form=form, step=step)
        except ImportError as error:
            raise ValueError(str(error)) from error
    if as_json:
        print(json.dumps({"files": [str(f) for f in written.files], "left": list(written.left)}))  # noqa: T201
        return
    _lines([f"left: {line}" for line in written.left])
    console().print(f"{counted(len(written.files), 'file')} in {out}", markup=False, soft_wrap=True)


def migrate_command(location: str, *, as_json: bool) -> None:
    """Bring a store of an older schema to this one; opening it for writing does that."""
    if "://" not in location and not Path(location).exists():
        raise ValueError(f"{location}: no such store")
    with Store(location):
        pass
    if as_json:
        print(json.dumps({"store": shown(location), "schema_version": SCHEMA_VERSION}))  # noqa: T201
        return
    console().print(f"{shown(location)}: has this program's schema", markup=False, soft_wrap=True)


def _facts(findings: Sequence[Damage]) -> list[dict[str, object]]:
    return [{"study": f.study, "trial": f.trial, "what": f.what} for f in findings]


def _all_counted(counts: dict[str, int]) -> str:
    nouns = {"studies": "study", "trials": "trial", "traces": "trace"}
    return ", ".join(counted(number, nouns[name], name) for name, number in counts.items())


def _lines(lines: list[str]) -> None:
    for line in lines[:SHOWN]:
        console().print(line, style="red", markup=False, soft_wrap=True)
    if len(lines) > SHOWN:
        console().print(f"and {len(lines) - SHOWN} more (--json names all)", style="red", markup=False)
