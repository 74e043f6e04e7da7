"""How results look on a terminal."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from rich.console import Console, JustifyMethod
from rich.table import Table

from chargetune.battery.charging.problem import ChargingProblem
from chargetune.episode.score import Score
from chargetune.study.executors import bounded_workers
from chargetune.study.result import StudyResult
from chargetune.study.store.database import database_at
from chargetune.study.store.sqlite import SqliteFile
from chargetune.study.trial import Trial

__all__ = [
    "beside",
    "console",
    "metrics_table",
    "number",
    "plants_over",
    "result_line",
    "shown",
    "theta_lines",
    "trials_table",
    "workers_for",
]

ROWS = (
    ("overshoot_mV", "worst voltage over the limit", "mV"),
    ("overshoot_mVs", "its integral", "mV s"),
    ("t80_min", "time to 80 % SOC", "min"),
    ("t90_min", "time to 90 % SOC", "min"),
    ("t95_min", "time to 95 % SOC", "min"),
    ("t99_min", "time to 99 % SOC", "min"),
    ("switch_min", "end of constant current", "min"),
    ("soc_end", "SOC at the end", ""),
    ("solver_failures", "control steps not solved to tolerance", ""),
)

# Of these figures those that a study has.
COLUMNS = (("overshoot_mV", "overshoot mV"), ("t80_min", "t80 min"), ("t95_min", "t95 min"), ("unsolved_percent", "unsolved %"))


def console(*, stderr: bool = False) -> Console:
    """Where text for a person goes."""
    return Console(stderr=stderr, highlight=False)


def beside(location: str, ending: str) -> Path:
    """A file beside a store's file and with its name; for a store on a server, with the database's name here."""
    database = database_at(location)
    if isinstance(database, SqliteFile):
        return Path(location).with_name(Path(location).stem + ending)
    return Path(re.sub(r"[^\w.-]+", "-", database.label.partition("?")[0].rpartition("/")[2]) + ending)


def shown(location: str) -> str:
    """A store in a message: the path as it was given, or the URL without its password."""
    database = database_at(location)
    return location if isinstance(database, SqliteFile) else database.label


def number(value: float | None, digits: int = 2) -> str:
    """A figure, or a dash where the episode never got there."""
    return "-" if value is None else f"{value:.{digits}f}"


def result_line(result: StudyResult) -> str:
    """Which trial is the result of a study, and why."""
    which = "no result" if result.trial is None else f"the result is trial {result.trial.number}"
    return f"{which}: {result.sentence}"


def metrics_table(scores: Mapping[str, Score | None], problem: ChargingProblem) -> Table:
    """One column a run, one row a figure."""
    table = Table(box=None, pad_edge=False)
    table.add_column("")
    for name in scores:
        table.add_column(name, justify="right")
    table.add_column("")
    for key, label, unit in ROWS:
        table.add_row(label, *(number(s.metrics.get(key)) if s else "-" for s in scores.values()), unit)
    if any(s and "plants" in s.metrics for s in scores.values()):
        counts = map(plants_over, scores.values())
        table.add_row("drawn plants over a limit; the figures above are their means, over a limit their worst", *counts, "")
    verdict = [("kept" if s.feasible else "[red]broken[/]") if s else "-" for s in scores.values()]
    table.add_row(f"limits ({problem.voltage_min_V:g} V to {problem.voltage_max_V:g} V)", *verdict, "")
    return table


def plants_over(score: Score | None) -> str:
    """Of a trial over a range of use the drawn plants that broke a limit, "n of N"; a dash for any other trial."""
    drawn = {} if score is None else score.metrics
    return f"{drawn['violating_plants']:.0f} of {drawn['plants']:.0f}" if "plants" in drawn else "-"


def workers_for(wanted: int, work: int, what: str) -> int:
    """The number of worker processes; where fewer than wanted can have something to do, one line on stderr says so."""
    count, said = bounded_workers(wanted, work, what)
    if said:
        console(stderr=True).print(f"--{said}", markup=False, soft_wrap=True)
    return count


def theta_lines(names: Sequence[str], units: Sequence[str], theta: Sequence[float]) -> str:
    """theta, one parameter a line."""
    return "\n".join(
        f"  {name} = {value:.5g} {'' if unit == '1' else unit}".rstrip() for name, unit, value in zip(names, units, theta, strict=True)
    )


def trials_table(trials: Sequence[Trial]) -> Table:
    """One row a trial, with the share of its control steps that were not solved."""
    told = {name for t in trials if t.score for name in t.score.metrics}
    figures = [(name, label) for name, label in COLUMNS if name in told]
    table = Table(box=None, pad_edge=False)
    drawn = any(t.score is not None and "plants" in t.score.metrics for t in trials)
    of_range = ["plants over"] if drawn else []
    for heading in ("trial", "status", *(label for _, label in figures), "G", *of_range, "limits", "ending"):
        side: JustifyMethod = "left" if heading in ("status", "limits", "ending") else "right"
        table.add_column(heading, justify=side, no_wrap=heading in of_range)
    for t in trials:
        s = t.score
        table.add_row(
            str(t.number),
            t.status.value,
            *(number(s.metrics.get(name)) if s else "-" for name, _ in figures),
            f"{s.performance:.4g}" if s else "-",
            *([plants_over(s)] if drawn else []),
            ("kept" if s.feasible else "[red]broken[/]") if s else "-",
            t.ending or "",
        )
    return table
