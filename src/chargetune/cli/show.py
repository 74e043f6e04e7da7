"""chargetune show."""

from __future__ import annotations

import json
from typing import Any

from rich.table import Table

from chargetune.cli.output import console, number, result_line, trials_table
from chargetune.study.result import StudyResult, read_result
from chargetune.study.store.store import Store, StudyRecord
from chargetune.study.trial import Trial, TrialStatus

__all__ = ["show_command"]


def show_command(location: str, *, study: str | None, as_json: bool) -> None:
    """Print the studies of a store, or every trial of one."""
    with Store(location, read_only=True) as store:
        if study is not None:
            record = store.study(study)
            trials = store.trials(record.id)
            result = read_result(store, record, trials)
            if as_json:
                print(json.dumps({**_summary(record, trials, result), "trials": [_trial(t) for t in trials]}))  # noqa: T201
            else:
                console().print(trials_table(trials))
                console().print(result_line(result), soft_wrap=True)
            return
        listed = [(record, trials := store.trials(record.id), read_result(store, record, trials)) for record in store.studies()]
    if as_json:
        print(json.dumps({"studies": [_summary(*one) for one in listed]}))  # noqa: T201
        return
    table = Table(box=None, pad_edge=False)
    for heading in ("study", "trials", "failed", "violating", "best t95 min", "best trial", "created"):
        table.add_column(heading, justify="left" if heading in ("study", "created") else "right")
    for record, trials, result in listed:
        s = _summary(record, trials, result)
        best = s["best"]
        table.add_row(
            record.name, str(s["done"]), str(s["failed"]), str(s["violating"]),
            number(best["metrics"].get("t95_min")) if best else "-", str(best["number"]) if best else "-", record.created_at[:19],
        )  # fmt: skip
    console().print(table)
    console().print("[dim]one study's trials: chargetune show STORE --study NAME[/]")


def _summary(record: StudyRecord, trials: list[Trial], result: StudyResult) -> dict[str, Any]:
    best = result.kept
    return {
        "name": record.name,
        "created_at": record.created_at,
        "done": sum(t.status is TrialStatus.DONE for t in trials),
        "failed": sum(t.status is TrialStatus.FAILED for t in trials),
        "apart": sum(t.status is TrialStatus.APART for t in trials),
        "running": sum(t.status is TrialStatus.RUNNING for t in trials),
        "violating": sum(t.score is not None and not t.score.feasible for t in trials),
        "best": _trial(best) if best else None,
        "result": result.facts(),
    }


def _trial(trial: Trial) -> dict[str, Any]:
    s = trial.score
    return {
        "number": trial.number,
        "status": trial.status.value,
        "ending": trial.ending,
        "theta": list(trial.theta),
        "objective": s.objective if s else None,
        "performance": s.performance if s else None,
        "excess": dict(s.excess) if s else None,
        "feasible": s.feasible if s else None,
        "metrics": dict(s.metrics) if s else {},
    }
