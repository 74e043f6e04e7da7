"""chargetune show --worth."""

from __future__ import annotations

import json
from dataclasses import asdict

import numpy as np
from rich.table import Table

from chargetune.cli.output import console
from chargetune.runtime.counted import counted
from chargetune.study.result import read_result
from chargetune.study.store.store import Store

__all__ = ["show_worth"]

# Draws that no theta was chosen on: their seed is none that a study has for its trials.
WORTH_DRAWS = 200
WORTH_SEED = 2_410_049


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
            raise ValueError(
                f"{store.label} holds {counted(len(names), 'study', 'studies')}, choose one with --study: {', '.join(names) or '(none)'}"
            )
        record = store.study(study or names[0])
        best = read_result(store, record, store.trials(record.id)).trial
    problem = problem_of_document(record.identity["config"])
    if problem.range is None:
        raise ValueError(f"--worth: study {record.name!r} has no table [range], allowed is a study of a range of use")
    if best is None:
        raise ValueError(f"--worth: study {record.name!r} has no result yet, allowed is one that has")
    loop = ChargingRange(problem)
    plants = loop.draw(WORTH_DRAWS, WORTH_SEED)
    worths = entry_worths(
        RangeEvaluation(loop, objective_quantile=problem.range.objective_quantile), problem.space, np.array(best.theta), plants
    )
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
