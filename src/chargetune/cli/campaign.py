"""chargetune campaign."""

from __future__ import annotations

import json
import sys
from contextlib import ExitStack
from pathlib import Path
from statistics import median
from typing import Any

from rich.live import Live
from rich.markup import escape
from rich.table import Table

from chargetune.battery.charging.checks import check_charging
from chargetune.battery.studies.campaign import Entry, Standing, load_campaign, run_campaign, standings
from chargetune.cli.check import print_findings
from chargetune.cli.output import console, number, shown, workers_for
from chargetune.cli.outputs import Kind, Output, claim, read_by
from chargetune.runtime.counted import counted
from chargetune.study.executors import process_executor
from chargetune.study.store.store import Store

__all__ = ["campaign_command"]

COLOURS = {"waiting": "dim", "running": "cyan", "done": "green", "stopped": "red"}


def campaign_command(path: Path, *, store: str | None, workers: int, force: bool, as_json: bool) -> None:
    """Tune every study file with every seed; exit code 1 when a study had to stop."""
    entries = load_campaign(path)
    kept = store or f"{path.stem}.sqlite"
    read = {e.source: read_by(e.folder / Path(e.source).name, e.config.model_dump()) for e in entries}
    if "://" not in kept:
        inputs = [path, *(file for files in read.values() for file in files)]
        claim([Output("--store", Path(kept), Kind.STORE, renewed=True)], inputs=inputs, overwrite=False)
    _check(entries, force=force)
    with Store(kept) as opened:
        found = standings(opened, entries)
    screen = console(stderr=True)
    workers = workers_for(workers, len(entries), ("study", "studies"))
    with ExitStack() as stack:
        executor = stack.enter_context(process_executor(workers))
        live = None if as_json else stack.enter_context(Live(_table(found.values(), screen.height), console=screen, transient=True))

        def note(standing: Standing) -> None:
            found[standing.name] = standing
            if live is not None:
                live.update(_table(found.values(), screen.height))

        rows = run_campaign(entries, kept, executor, workers, progress=note)
    stopped = any(row.message is not None for row in rows)
    if as_json:
        print(json.dumps({"store": shown(kept), "studies": [_facts(e, r) for e, r in zip(entries, rows, strict=True)]}))  # noqa: T201
    else:
        console().print(_table(rows))
        console().print(_medians(entries, rows))
        for row in rows:
            if row.message is not None:
                console().print(f"[red]{escape(row.name)}[/] stopped: {escape(row.message)}")
        console().print(f"trials in {shown(kept)}", markup=False, soft_wrap=True)
    if stopped:
        sys.exit(1)


def _check(entries: list[Entry], *, force: bool) -> None:
    for entry in {e.source: e for e in entries}.values():
        findings = check_charging(entry.config.problem(entry.folder), quick=True)
        errors = [finding for finding in findings if finding.severity == "error"]
        print_findings(errors, console(stderr=True))
        if errors and not force:
            raise ValueError(f"{entry.source}: the formulation has an error; `chargetune check` shows it, --force tunes nevertheless")


def _table(rows: Any, height: int | None = None) -> Table:
    """One row a study; those that are at work where not all fit on the screen."""
    rows = list(rows)
    title = None
    if height is not None and len(rows) > (fit := max(3, height - 6)):
        done = sum(row.state == "done" for row in rows)
        title = f"{counted(len(rows), 'study', 'studies')}, {done} done"
        order = {"running": 0, "stopped": 1, "waiting": 2, "done": 3}
        rows = sorted(rows, key=lambda row: order[row.state])[:fit]
    table = Table(box=None, pad_edge=False, title=title, title_justify="left")
    for heading in ("study", "", "trials", "failed", "over", "best", "t80 min", "t95 min"):
        table.add_column(heading, justify="left" if heading in ("study", "") else "right", no_wrap=True)
    for row in rows:
        score = row.best.score if row.best is not None and row.best.feasible else None
        table.add_row(
            escape(row.name), f"[{COLOURS[row.state]}]{row.state}[/]", f"{row.told}/{row.trials}", str(row.failed), str(row.violating),
            str(row.best.number) if row.best is not None and score else "-",
            number(score.metrics.get("t80_min")) if score else "-", number(score.metrics.get("t95_min")) if score else "-",
        )  # fmt: skip
    return table


def _medians(entries: list[Entry], rows: list[Standing]) -> Table:
    """One row a study file."""
    table = Table(box=None, pad_edge=False)
    for heading in ("file", "within the limits", "median t80 min", "median t95 min"):
        table.add_column(heading, justify="left" if heading == "file" else "right")
    for source in dict.fromkeys(entry.source for entry in entries):
        mine = [row for entry, row in zip(entries, rows, strict=True) if entry.source == source]
        kept = [row.best.score for row in mine if row.best is not None and row.best.score is not None and row.best.feasible]

        def middle(metric: str, scores: list[Any] = kept) -> float | None:
            values = [value for score in scores if (value := score.metrics.get(metric)) is not None]
            return median(values) if values else None

        table.add_row(escape(source), f"{len(kept)} of {len(mine)}", number(middle("t80_min")), number(middle("t95_min")))
    return table


def _facts(entry: Entry, row: Standing) -> dict[str, Any]:
    score = row.best.score if row.best is not None else None
    return {
        "study": row.name,
        "config": entry.source,
        "seed": entry.config.study.seed,
        "state": row.state,
        "message": row.message,
        "trials": row.told,
        "wanted": row.trials,
        "failed": row.failed,
        "violating": row.violating,
        "best": None
        if row.best is None or score is None
        else {"trial": row.best.number, "feasible": score.feasible, "objective": score.objective, "metrics": dict(score.metrics)},
        "result": row.result.facts(),
        "theta": None if row.best is None else list(row.best.theta),
    }
