"""chargetune show."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Any

import numpy as np
from rich.table import Table

from chargetune.cli.output import console, number, result_line, trials_table
from chargetune.study.result import StudyResult, read_result
from chargetune.study.store.store import Store, StudyRecord
from chargetune.study.trial import Trial, TrialStatus

__all__ = ["show_command", "show_worth"]

# Draws that no theta was chosen on: their seed is none that a study has for its trials.
WORTH_DRAWS = 200
WORTH_SEED = 2_410_049


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


def show_worth(location: str, *, study: str | None, as_json: bool) -> None:
    """Print what each entry of the result's theta is worth on fresh draws of the study's range of use.

    Raises ValueError for a study that has no range of use, or no result.
    """
    from chargetune.battery.charging.charging_range import ChargingRange
    from chargetune.battery.studies.study_file import problem_of_document
    from chargetune.learning.range_of_use.range_verdict import RangeEvaluation
    from chargetune.learning.range_of_use.worth import entry_worths

    with Store(location, read_only=True) as store:
        names = [record.name for record in store.studies()]
        if study is None and len(names) != 1:
            raise ValueError(f"{store.label} holds {len(names)} studies, choose one with --study: {', '.join(names) or '(none)'}")
        record = store.study(study or names[0])
        best = read_result(store, record, store.trials(record.id)).trial
    problem = problem_of_document(record.identity["config"])
    if problem.range is None:
        raise ValueError(f"--worth: study {record.name!r} has no table [range], allowed is a study of a range of use")
    if best is None:
        raise ValueError(f"--worth: study {record.name!r} has no result yet, allowed is one that has")
    loop = ChargingRange(problem)
    plants = loop.draw(WORTH_DRAWS, WORTH_SEED)
    worths = entry_worths(RangeEvaluation(loop), problem.space, np.array(best.theta), plants)
    if as_json:
        print(json.dumps({"study": record.name, "trial": best.number, "draws": WORTH_DRAWS, "worths": [asdict(w) for w in worths]}))  # noqa: T201
        return
    table = Table(box=None, pad_edge=False)
    for heading in ("entry", "put to", "value", "objective lost", "more plants over", ""):
        table.add_column(heading, justify="left" if heading in ("entry", "put to", "") else "right")
    for one in worths:
        cells = (f"{one.value:.4g}", f"{one.lost:+.3g}", f"{one.more_violating:+d}", "worth nothing" if one.idle else "")
        table.add_row(one.entry, one.put_to, *cells)
    console().print(table)
    console().print(
        f"trial {best.number} on {WORTH_DRAWS} fresh draws, one entry put back at a time; an objective lost below 0 is bought with limits",
        soft_wrap=True,
    )


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
