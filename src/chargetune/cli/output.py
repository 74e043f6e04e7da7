"""How results look on a terminal."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from chargetune.battery.charging.problem import ChargingProblem
from chargetune.battery.charging.wording import limit_words, metric_words, objective_words
from chargetune.episode.score import Score
from chargetune.study.executors import bounded_workers
from chargetune.study.result import StudyResult
from chargetune.study.store.database import database_at
from chargetune.study.store.sqlite import SqliteFile

__all__ = [
    "beside",
    "console",
    "loss_of",
    "metrics_table",
    "number",
    "plants_over",
    "result_line",
    "setting",
    "shown",
    "steps",
    "theta_lines",
    "workers_for",
]

# Figures of a charge beside its objective and its limits.
ROWS = ("t80_min", "t90_min", "t95_min", "t99_min", "switch_min", "soc_end", "violation_mVs", "solver_failures")


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
    # Adding zero to a negative one that is rounded takes its sign.
    return "-" if value is None else f"{round(value, digits) + 0.0:.{digits}f}"


def result_line(result: StudyResult) -> str:
    """Which trial is the result of a study, and why."""
    which = "no result" if result.trial is None else f"the result is trial {result.trial.number}"
    return f"{which}: {result.sentence}"


def metrics_table(scores: Mapping[str, Score | None], problem: ChargingProblem, tuner: str = "") -> Table:
    """One column a run; a row for the objective, for each limit, and for each further figure of a charge."""
    table = Table(box=None, pad_edge=False)
    table.add_column("")
    for name in scores:
        table.add_column(name, justify="right")
    table.add_column("tolerance", justify="right")
    table.add_column("")
    runs = list(scores.values())

    def row(label: str, values: Iterable[str], unit: str, tolerance: str = "") -> None:
        table.add_row(label, *values, tolerance, unit)

    objective = objective_words(problem, tuner)
    row(f"objective: {objective.label}", (objective.text(loss_of(s, tuner)) if s else "-" for s in runs), objective.unit)
    for limit in problem.limits_by_name.values():
        words = limit_words(problem, limit)
        excess = [f"{words.factor * s.excess[words.name]:.2f}" if s and words.name in s.excess else "-" for s in runs]
        allowed = next((f"{words.factor * s.tolerance[words.name]:.3g}" for s in runs if s and words.name in s.tolerance), "")
        if words.samples == 1 or not words.largest or any(s and "plants" in s.metrics for s in runs):
            row(words.label, excess, words.unit, allowed)
            continue
        table.add_row(words.label)
        row(f"  {words.judged}", excess, words.unit, allowed)
        row("  largest sample", (number(s.metrics.get(words.largest)) if s else "-" for s in runs), words.unit)
    told = f"{objective.short}_{objective.unit}"
    for key in ROWS:
        if key != told and any(s and s.metrics.get(key) is not None for s in runs):
            label, unit = metric_words(key)
            row(label, (number(s.metrics.get(key)) if s else "-" for s in runs), unit)
    if any(s and "plants" in s.metrics for s in runs):
        counts = map(plants_over, runs)
        row("drawn plants over a limit", counts, "")
        table.add_row("  above: means; of limits the worst")
    row("limits", (("kept" if s.feasible else "[red]broken[/]") if s else "-" for s in runs), "")
    return table


def loss_of(score: Score, tuner: str = "") -> float:
    """What the tuner makes small."""
    return -(score.performance if tuner == "ei" else score.objective)


def plants_over(score: Score | None) -> str:
    """Of a trial over a range of use the drawn plants that broke a limit, "n of N"; a dash for any other trial."""
    drawn = {} if score is None else score.metrics
    return f"{drawn['violating_plants']:.0f} of {drawn['plants']:.0f}" if "plants" in drawn else "-"


def workers_for(wanted: int, work: int, what: tuple[str, str]) -> int:
    """The number of worker processes; where fewer than wanted can have something to do, one line on stderr says so."""
    count, said = bounded_workers(wanted, work, what)
    if said:
        console(stderr=True).print(f"--{said}", markup=False, soft_wrap=True)
    return count


def setting(problem: ChargingProblem) -> dict[str, str]:
    """For JSON: what the plant is, and of how many cells a pack, whose numbers are all those of one cell; empty for a single one."""
    return {"plant": problem.plant_line, "pack": problem.cell.pack_line}


def theta_lines(names: Sequence[str], units: Sequence[str], theta: Sequence[float]) -> str:
    """theta, one parameter a line."""
    return "\n".join(
        f"  {name} = {value:.5g} {'' if unit == '1' else unit}".rstrip() for name, unit, value in zip(names, units, theta, strict=True)
    )


@contextmanager
def steps(what: str, *, quiet: bool) -> Iterator[Callable[[int, int], None]]:
    """A bar on stderr, gone at the end: call what it gives with how many of how many are done."""
    parts = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*parts, console=console(stderr=True), disable=quiet, transient=True) as progress:
        task = progress.add_task(what, total=None)
        yield lambda done, total: progress.update(task, completed=done, total=total)
