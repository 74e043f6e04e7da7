"""chargetune show."""

from __future__ import annotations

import json
import math
from typing import Any

from rich.markup import escape
from rich.table import Table

from chargetune.battery.charging.wording import METRIC_WORDS, LimitWords, metric_words, two_decimals
from chargetune.cli.output import console, loss_of, number, plants_over, result_line, theta_lines
from chargetune.report.study_view import StudyView, read_studies
from chargetune.report.words import limits_of_study, objective_of_study
from chargetune.study.store.store import Store
from chargetune.study.trial import Trial, TrialStatus

__all__ = ["show_command"]

# Of the known figures of a charge those that a table of trials has; of another system it has all.
COLUMNS = {"t80_min", "t95_min", "unsolved_percent"}
# A theta of so few entries stands in the table.
FEW = 2


def show_command(location: str, *, study: str | None, as_json: bool) -> None:
    """Print the studies of a store, or every trial of one; of a store with one study that one's."""
    if study is not None:
        with Store(location, read_only=True) as store:
            only = store.study(study).id
        views = read_studies(location, only)
    else:
        views = read_studies(location)
    if as_json:
        summaries = [_summary(view) for view in views]
        found = {"studies": summaries} if study is None else {**summaries[0], "trials": [_trial(t) for t in views[0].trials]}
        print(json.dumps(found))  # noqa: T201
    elif study is not None or len(views) == 1:
        _show_trials(views[0])
    else:
        _list(views)


def _list(views: list[StudyView]) -> None:
    table = Table(box=None, pad_edge=False)
    apart = ("apart",) if any(t.status is TrialStatus.APART for view in views for t in view.trials) else ()
    for heading in ("study", "trials", "failed", *apart, "over", "best trial", "its objective", "begun"):
        table.add_column(heading, justify="left" if heading in ("study", "its objective", "begun") else "right")
    for view in views:
        s, best = _summary(view), view.result.kept
        begun = "" if view.record is None else view.record.created_at[:10]
        counts = (str(s[name]) for name in ("done", "failed", *apart, "violating"))
        table.add_row(escape(view.name), *counts, str(best.number) if best else "-", _objective(view, best), begun)
    screen = console()
    screen.print(table)
    screen.print("[dim]one study's trials: chargetune show STORE --study NAME[/]")


def _objective(view: StudyView, trial: Trial | None) -> str:
    """What a trial was worth, in the words of its study: "t80 24.33 min"."""
    if trial is None or trial.score is None:
        return "-"
    words = objective_of_study(view)
    return f"{words.short} {words.text(loss_of(trial.score, view.tuner))} {words.unit}".rstrip()


def _show_trials(view: StudyView) -> None:
    trials, words, limits, best = view.trials, objective_of_study(view), limits_of_study(view), view.tuned
    names = dict.fromkeys(name for t in trials if t.score for name in t.score.metrics)
    same = f"{words.short}_{words.unit}"
    drawn = "plants" in names
    figures = [n for n in names if n != same and (n in COLUMNS or (view.problem is None and n not in METRIC_WORDS))]
    entries = list(view.space.entries) if view.space.dimension <= FEW else []
    figures = [name for name in figures if any(t.score and t.score.metrics.get(name) is not None for t in trials)]
    # A cell at rest meets its lower voltage limit: where no trial came near it there is nothing to read.
    met = [limit for limit in limits if limit.name == "voltage_min_V" and all(_excess(t, limit) < 0 for t in trials if t.score)]
    columns = [f"{words.short}\n({words.unit})" if words.unit else words.short.replace(" ", "\n", 1)]
    for limit in (limit for limit in limits if limit not in met):
        columns += [limit.short, *(["its\nlargest\nsample"] if limit.samples > 1 and limit.largest in names else [])]
    columns += [_heading(name) for name in figures]
    table = Table(box=None, pad_edge=False)
    table.add_column("trial", justify="right", no_wrap=True)
    for heading in ("", "status"):
        table.add_column(heading)
    for heading in (*columns, *(["plants\nover"] if drawn else []), *(escape(e.replace("_", "\n_", 1)) for e in entries)):
        # At 80 columns a name may need several lines; the end of it, its number, is never cut.
        table.add_column(heading, justify="right", vertical="bottom", overflow="fold")
    table.add_column("limits")
    for t in trials:
        s = t.score
        cells = [words.text(loss_of(s, view.tuner)) if s else "-"]
        for limit in (limit for limit in limits if limit not in met):
            cells += [two_decimals(_excess(t, limit)) if s and limit.name in s.excess else "-"]
            cells += [number(s.metrics.get(limit.largest)) if s else "-"] if limit.samples > 1 and limit.largest in names else []
        cells += [number(s.metrics.get(name)) if s else "-" for name in figures]
        cells += ([plants_over(s)] if drawn else []) + ([f"{v:.4g}" for v in t.theta] if entries else [])
        verdict = ("kept" if s.feasible else "[red]broken[/]") if s else "-"
        table.add_row(str(t.number), "*" if best is not None and t.number == best.number else "", t.status.value, *cells, verdict)
    screen = console()
    screen.print(f"study {view.name}", markup=False)
    screen.print(table)
    if limits:
        said = (
            f"{limit.label} {'by trial' if limit.tolerance is None else f'{limit.tolerance:.3g} {limit.unit}'.rstrip()}" for limit in limits
        )
        screen.print(f"[dim]an excess is kept up to its tolerance: {escape('; '.join(said))}[/]")
        means = {limit.samples for limit in limits if limit.samples > 1}
        for count in sorted(means):
            noisy = ", ".join(limit.label for limit in limits if limit.samples == count)
            screen.print(f"[dim]of noisy signals the moving mean of {count} intervals is judged: {escape(noisy)}[/]")
    for t in trials:
        if t.status is TrialStatus.FAILED:
            screen.print(f"trial {t.number} failed: {escape(t.ending or 'no reason is stored')}", soft_wrap=True)
    apart: dict[str, list[int]] = {}
    for t in trials:
        if t.status is TrialStatus.APART:
            apart.setdefault((t.ending or "no reason is stored").removeprefix("set apart: "), []).append(t.number)
    for reason, numbers in apart.items():
        named = f"trial {numbers[0]}" if len(numbers) == 1 else f"trials {', '.join(_stretches(numbers))}"
        screen.print(f"{named} set apart, in no result: {escape(reason)}", soft_wrap=True)
    screen.print(result_line(view.result), soft_wrap=True)
    if best is not None and not entries:
        units = [p.unit for p in view.space.parameters for _ in range(p.size)]
        screen.print(f"theta of trial {best.number} (*):\n{escape(theta_lines(view.space.entries, units, best.theta))}")


def _stretches(numbers: list[int]) -> list[str]:
    """Increasing numbers, those that follow each other as "3 to 7"."""
    ends = [k for k, n in enumerate(numbers) if k + 1 == len(numbers) or numbers[k + 1] != n + 1]
    starts = [0, *(k + 1 for k in ends[:-1])]
    return [str(numbers[a]) if a == b else f"{numbers[a]} to {numbers[b]}" for a, b in zip(starts, ends, strict=True)]


def _excess(trial: Trial, limit: LimitWords) -> float:
    """In the unit of its words; nan without a score."""
    return math.nan if trial.score is None else limit.factor * trial.score.excess.get(limit.name, math.nan)


def _heading(name: str) -> str:
    if name == "unsolved_percent":
        return "not\nsolved\n(%)"
    if name in METRIC_WORDS:
        stem, _, unit = name.rpartition("_")
        return f"{stem}\n({unit})"
    label, unit = metric_words(name)
    return escape(f"{label}\n({unit})" if unit else label)


def _summary(view: StudyView) -> dict[str, Any]:
    trials, result = view.trials, view.result
    best = result.kept
    return {
        "name": view.name,
        "created_at": "" if view.record is None else view.record.created_at,
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
