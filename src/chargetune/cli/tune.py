"""chargetune tune."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, Future
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Column

from chargetune.battery.charging.checks import check_charging
from chargetune.battery.charging.problem import ChargingProblem
from chargetune.battery.charging.verdict import violation_mVs
from chargetune.battery.charging.wording import objective_words
from chargetune.battery.studies.open_study import evaluation_of, open_study
from chargetune.battery.studies.study_file import Config, load_config
from chargetune.cli.check import print_findings
from chargetune.cli.output import console, loss_of, metrics_table, number, result_line, setting, shown, theta_lines, workers_for
from chargetune.cli.outputs import Kind, Output, claim, read_by
from chargetune.episode.episode import Ending
from chargetune.episode.score import Score
from chargetune.runtime.counted import counted
from chargetune.runtime.notes import first_line
from chargetune.study.executors import process_executor
from chargetune.study.files import write_whole
from chargetune.study.result import StudyResult, by_newest, read_result
from chargetune.study.store.store import Store
from chargetune.study.study import Study
from chargetune.study.trial import Trial, TrialStatus

__all__ = ["bar", "tune_command"]

P = ParamSpec("P")
T = TypeVar("T")

# Said of a result that `chargetune certify` will mostly find to break its limits.
ONE_CELL = """this theta holds for the cell and the start that it was tuned on, others may
break its limits; a table [range] in the study file tunes it for all of them"""


def bar(*, quiet: bool) -> Progress:
    """A progress bar on stderr, so that a program can read stdout. At 80 columns the note is what goes on in a second line."""
    columns = (
        TextColumn("{task.description}", markup=False, table_column=Column(no_wrap=True)),
        BarColumn(bar_width=5, table_column=Column(no_wrap=True)),
        MofNCompleteColumn(table_column=Column(no_wrap=True)),
        TimeElapsedColumn(table_column=Column(no_wrap=True)),
        TimeRemainingColumn(compact=True, table_column=Column(no_wrap=True)),
        TextColumn("{task.fields[note]}", markup=False, table_column=Column(overflow="fold")),
    )
    return Progress(*columns, console=console(stderr=True), disable=quiet)


def tune_command(
    path: Path,
    *,
    trials: int | None,
    seed: int | None,
    store: str | None,
    workers: int,
    out: Path | None,
    as_json: bool,
    force: bool = False,
    accept_changed: bool = False,
    overwrite: bool = False,
) -> None:
    """Tune, show the way there, and say what came of it. An error of the formulation stops before the first trial, unless ``force``."""
    config = load_config(path)
    if seed is not None:
        config = config.model_copy(update={"study": config.study.model_copy(update={"seed": seed})})
    count = config.study.trials if trials is None else trials
    kept = store or str(out / "study.sqlite" if out else f"{path.stem}.sqlite")
    problem = config.problem(path.parent)
    if not problem.space.dimension:
        raise ValueError(f"{path}: theta is empty; add a table [theta.backoff], [theta.R0] or [theta.R1]")
    outputs = [] if "://" in kept else [Output("--store", Path(kept), Kind.STORE, renewed=True)]
    if out is not None:
        outputs += _files(out, config, problem, kept)
    claim(outputs, inputs=read_by(path, config.model_dump()), overwrite=overwrite)
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
    _check(problem, problem.safe_start, force=force)
    opening = Opening(config, path.parent, kept, accept_changed)
    everything, more, result, safety = _run(opening, problem, count, workers, quiet=as_json)
    now = [t for t in everything if t.status is not TrialStatus.APART]
    summary = {**_summary(config, problem, now, result), "trials": len(everything), "apart": len(everything) - len(now)}
    summary |= {"safety": safety} if safety else {}
    figures: list[Path] = []
    if out is not None:
        from chargetune.report import save_figures

        # First what says whose folder this is.
        write_whole(out / "summary.json", json.dumps({**summary, "store": shown(kept)}, indent=1))
        figures = save_figures(kept, config.study.name, out, trials=count)
    if as_json:
        print(json.dumps(summary))  # noqa: T201
        _end(safety, now)
        return
    _closing(problem, now, result, config.study.tuner)
    if more:
        console().print(
            f"the study has {counted(len(everything) + more, 'trial')}; these are the first {len(everything)} of them, as --trials asks"
        )
    if safety:
        budget = "" if safety["budget_mVs"] is None else f" of {safety['budget_mVs']:g}"
        spent = f"violation beyond the tolerance: {safety['violation_mVs']:.3g}{budget} mV s"
        console().print(f"{spent}; {counted(safety['ended_at_a_limit'], 'trial')} ended at a limit")
    console().print(f"trials in {shown(kept)}" + "".join(f"\nfigure {f}" for f in figures), markup=False, soft_wrap=True)
    _end(safety, now)


def _files(out: Path, config: Config, problem: ChargingProblem, kept: str) -> list[Output]:
    """What is written into ``out``. Where an earlier run of this study wrote there, the same command renews it."""
    summary = out / "summary.json"
    try:
        found = json.loads(summary.read_text(encoding="utf-8"))
        own = (found["study"], found.get("store", shown(kept))) == (config.study.name, shown(kept))
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        own = False
    tuned = problem.theta
    stems = ["trajectories", "convergence", *tuned.ratios]
    stems += [name for name, table in (("backoff", tuned.backoff), ("current_limit", tuned.current_limit)) if table is not None]
    figures = [Output("--out", out / f"{stem}.png", Kind.PNG, renewed=own) for stem in stems]
    return [Output("--out", summary, Kind.JSON, renewed=own), *figures]


@dataclass(frozen=True)
class Opening:
    """Where a study comes from and where its trials are kept."""

    config: Config
    folder: Path
    kept: str
    accept_changed: bool


def _run(
    opening: Opening, problem: ChargingProblem, count: int, workers: int, *, quiet: bool
) -> tuple[list[Trial], int, StudyResult, dict[str, Any] | None]:
    """The trials of the study that are asked for, how many more it has, its result, and what there is to say of safety."""
    config, kept = opening.config, opening.kept
    with ExitStack() as stack:
        store = stack.enter_context(Store(kept))
        plants = _plants_executor(config, problem, workers, stack)
        study = stack.enter_context(open_study(store, config, opening.folder, accept_changed=opening.accept_changed, executor=plants))
        known = study.trials()
        done = sum(t.status is not TrialStatus.RUNNING for t in known)
        # Without batches more workers have something to do only if the order of the trials is given up for them; and
        # not with a tuner whose every step needs the trial before it.
        alone = study.batch > 1 or config.safety is not None or config.study.tuner in ("iterative_learning", "range")
        alone = alone or config.range is not None
        at_once = min(study.batch, max(1, count - done)) if alone else max(1, count - done)
        if plants is not None:
            workers = 1
        workers = workers_for(workers, at_once, ("trial at a time", "trials at a time") if alone else ("trial", "trials"))
        executor = stack.enter_context(process_executor(workers)) if workers > 1 else None
        progress = stack.enter_context(bar(quiet=quiet))
        # Without a word before it the line of a trial is whole at 80 columns.
        task = progress.add_task("", total=count, completed=min(done, count), note="")
        if study.earlier and not quiet:
            progress.console.print(f"begun with {counted(len(study.earlier), 'trial')} of earlier studies")
        if done and not quiet:
            progress.console.print(f"resumed: {counted(done, 'trial')} in {shown(kept)}", markup=False, soft_wrap=True)

        # Charges from starts of their own do not compare: the newest is shown, not the one that began fullest.
        own = by_newest(study.record.identity)

        def note(told: Trial, incumbent: Trial | None, violating: int, failures: int) -> None:
            trial, said = told if own else incumbent, ""
            if trial is not None and trial.score is not None:
                said = f"{'last' if own else 'best'} {_headline(config, problem, trial.score)} (trial {trial.number})"
            progress.update(task, advance=1, note=progress_note(said, violating, failures))

        if plants is not None:
            plants.tell = lambda charges: progress.update(task, note=counted(charges, "simulated charge"))
        stack.enter_context(_said(progress.console))
        # A tuner has loaded this folder by now.
        from chargetune.learning import NoSafeThetaError

        stopped = ""
        try:
            ahead = workers if workers > 1 and not alone else None
            study.run(evaluation_of(config.study.tuner, problem, plants), count, executor=executor, workers=ahead, progress=note)
        except NoSafeThetaError as error:
            stopped = str(error)
        stored = study.trials()
        everything, more = stored[:count], max(0, len(stored) - count)
        safety = _safety(config, problem, study, everything, stopped)
        # After a study that stopped, too.
        study.result()
        result = read_result(store, study.record, everything)
    return everything, more, result, safety


class _PlantsExecutor(Executor):
    """Runs charges of one theta on many plants in worker processes, and tells how many are done."""

    def __init__(self, executor: Executor) -> None:
        self._executor, self._done = executor, 0
        self.tell: Callable[[int], None] = lambda _: None

    def submit(self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        future = self._executor.submit(fn, *args, **kwargs)
        future.add_done_callback(self._count)
        return future

    def _count(self, _: Future[Any]) -> None:
        self._done += 1
        self.tell(self._done)


def _plants_executor(config: Config, problem: ChargingProblem, workers: int, stack: ExitStack) -> _PlantsExecutor | None:
    """What runs the plants of one trial over a range, where a charge takes seconds."""
    if config.study.tuner != "range" or problem.range is None or problem.plant_cell is not None:
        return None
    workers = workers_for(workers, problem.range.draws, ("plant", "plants"))
    return _PlantsExecutor(stack.enter_context(process_executor(workers)))


def progress_note(said: str, violating: int, failures: int) -> str:
    """What a bar says of the trials so far, in about 50 characters; failures only where there are some."""
    return f"{said or 'none within limits'}, {violating} over" + f", {failures} failed" * (failures > 0)


def _headline(config: Config, problem: ChargingProblem, score: Score) -> str:
    """What a trial is worth: the objective where it is a time; else the time to 95 % SOC, where that was reached."""
    words = objective_words(problem, config.study.tuner)
    t95 = score.metrics.get("t95_min")
    if words.unit or t95 is None:
        return f"{words.short} {words.text(loss_of(score, config.study.tuner))} {words.unit}".rstrip()
    return f"t95 {number(t95)} min"


@contextmanager
def _said(screen: Console) -> Iterator[None]:
    """Warnings of a tuner as lines above the progress bar."""
    with warnings.catch_warnings():
        warnings.simplefilter("always", RuntimeWarning)
        warnings.showwarning = lambda message, *_, **__: screen.print(f"note: {first_line(message)}", style="yellow", markup=False)
        yield


def _end(safety: dict[str, Any] | None, trials: Sequence[Trial] = ()) -> None:
    """A last line and an exit code that say so where nothing can have come of it."""
    if safety and safety["stopped"]:
        raise ValueError(f"stopped before the last trial: {safety['stopped']}")
    if trials and all(t.score is None for t in trials):
        raise ValueError(f"no trial has a score; the last one ended with: {trials[-1].ending}")


def _safety(config: Config, problem: ChargingProblem, study: Study, trials: Sequence[Trial], stopped: str) -> dict[str, Any] | None:
    """What safe learning stated and spent; an episode that was ended at a limit counts with its trace."""
    table = config.safety
    if table is None:
        return None
    spent, ended = 0.0, 0
    for trial in trials:
        if trial.score is not None:
            spent += trial.score.metrics.get("violation_mVs") or 0.0
        elif trial.status is TrialStatus.FAILED:
            episode = study.episode(trial.number)
            spent += violation_mVs(problem, episode) if episode is not None and len(episode) else 0.0
            ended += (trial.ending or "").startswith(Ending.LIMIT.value)
    return {
        "probability": table.probability,
        "violation_mVs": spent,
        "budget_mVs": table.budget_mVs,
        "ended_at_a_limit": ended,
        "stopped": stopped or None,
    }


def _check(problem: ChargingProblem, start: NDArray[np.float64] | None, *, force: bool) -> None:
    findings = check_charging(problem, start=start, quick=True)
    print_findings(findings, console(stderr=True))
    if not force and any(finding.severity == "error" for finding in findings):
        raise ValueError("the formulation has an error; `chargetune check` shows it, --force tunes nevertheless")


def _start_label(problem: ChargingProblem, trials: Sequence[Trial]) -> str:
    """What trial 0 is: a safe study does not begin with the untuned controller."""
    if not trials or np.array_equal(trials[0].theta, problem.space.default):
        return "untuned"
    if problem.safe_start is not None:
        return "declared start"
    # Over a range the first theta is chosen for all of it, and no cautious corner.
    return "trial 0" if problem.safety is None or problem.range is not None else "cautious start"


def _closing(problem: ChargingProblem, everything: list[Trial], result: StudyResult, tuner: str = "") -> None:
    screen, best = console(), result.trial
    violating = sum(t.score is not None and not t.score.feasible for t in everything)
    failed = sum(t.status is TrialStatus.FAILED for t in everything)
    screen.print(
        f"\n[bold]{escape(problem.cell.title)}[/]: {counted(len(everything), 'trial')}, {violating} broke a limit, {failed} failed"
    )
    for line in problem.setting_lines:
        screen.print(f"[dim]{escape(line)}[/]")
    if problem.cell.remark:
        screen.print(f"[dim]{escape(problem.cell.remark)}[/]")
    screen.print(f"[dim]estimator {problem.estimator.line}[/]")
    if all(t.score is None for t in everything):
        # There is nothing that a table could show.
        screen.print(result_line(result), markup=False, soft_wrap=True)
        return
    first = everything[0].score if everything else None
    scores = {_start_label(problem, everything): first, "tuned": best.score if best else None}
    screen.print(metrics_table(scores, problem, tuner))
    if best is None:
        return
    if not best.feasible:
        said = f"[red]No trial of {len(everything)} kept the limits.[/] Shown is the one that came closest."
        screen.print(f"{said} More trials or a wider theta may help.")
    units = [p.unit for p in problem.space.parameters for _ in range(p.size)]
    screen.print(result_line(result), markup=False, soft_wrap=True)
    screen.print(f"theta of trial {best.number}:\n{theta_lines(problem.space.entries, units, best.theta)}")
    if problem.range is None:
        screen.print(ONE_CELL, style="dim", markup=False, soft_wrap=True)


def _summary(config: Config, problem: ChargingProblem, trials: list[Trial], result: StudyResult) -> dict[str, Any]:
    best, label = result.trial, _start_label(problem, trials)
    first = trials[0] if trials else None

    def facts(trial: Trial | None) -> dict[str, Any] | None:
        if trial is None or trial.score is None:
            return None
        s = trial.score
        return {
            "trial": trial.number,
            "feasible": s.feasible,
            "objective": s.objective,
            "excess": dict(s.excess),
            "metrics": dict(s.metrics),
        }

    return {
        "study": config.study.name,
        "tuner": config.study.tuner,
        "trials": len(trials),
        "violating": sum(t.score is not None and not t.score.feasible for t in trials),
        "failed": sum(t.status is TrialStatus.FAILED for t in trials),
        "untuned": facts(first) if label == "untuned" else None,
        "start": None if first is None else {"what": label, **(facts(first) or {"trial": first.number})},
        "tuned": facts(best),
        "result": result.facts(),
        "theta": dict(zip(problem.space.entries, best.theta, strict=True)) if best else None,
        **setting(problem),
    }
