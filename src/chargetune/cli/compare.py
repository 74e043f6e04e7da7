"""chargetune compare."""

from __future__ import annotations

import json
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from rich.table import Table

from chargetune.battery.baselines.comparison import Row, chosen_rows, compare, row_names
from chargetune.battery.baselines.range_comparison import DRAWS, ORACLE, RangeRow, compare_range, range_row_names
from chargetune.battery.charging.problem import ChargingProblem
from chargetune.battery.studies.study_file import load_config
from chargetune.cli.output import console, number, result_line, setting, shown, workers_for
from chargetune.cli.outputs import Output, claim, figure_kind, read_by
from chargetune.cli.tune import bar
from chargetune.report.figures.style import check_format
from chargetune.runtime.counted import counted
from chargetune.runtime.interrupts import raise_lost_interrupt
from chargetune.study.executors import process_executor
from chargetune.study.result import StudyResult, read_result
from chargetune.study.store.store import Store

__all__ = ["compare_command"]


def compare_command(
    path: Path,
    *,
    store: str | None,
    study: str | None,
    rows: list[str],
    seed: int,
    draws: int | None,
    workers: int,
    figure: Path | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Charge the plant of a study file, or those drawn from its range of use, in every way there is, and print one table."""
    if figure is not None:
        check_format(figure, "--figure")
    config = load_config(path)
    if figure is not None:
        read: list[str | Path] = [*read_by(path, config.model_dump()), *([] if store is None else [store])]
        claim([Output("--figure", figure, figure_kind(figure))], inputs=read, overwrite=overwrite, folders=False)
    problem = config.problem(path.parent)
    result = None if store is None else _result(store, study or config.study.name)
    theta = None if result is None or result.trial is None else problem.space.validate(result.trial.theta).tolist()
    if problem.range is not None:
        if figure is not None:
            raise ValueError(
                "--figure is given for a study with a table [range]: each row is many charges; certify draws them by condition"
            )
        _over_range(problem, theta, result, wanted=rows, draws=draws or DRAWS, seed=seed, workers=workers, as_json=as_json)
        return
    if draws is not None:
        raise ValueError(f"--draws {draws}: allowed only for a study with a table [range]")
    names = chosen_rows(row_names(problem, theta), rows)
    workers = workers_for(workers, len(names), ("controller", "controllers"))
    found: dict[str, Row] = {}
    with ExitStack() as stack:
        executor = stack.enter_context(process_executor(workers)) if workers > 1 else None
        progress = stack.enter_context(bar(quiet=as_json))
        task = progress.add_task("charging", total=len(names), note="")
        for row in compare(problem, theta, rows=names, seed=seed, executor=executor):
            raise_lost_interrupt()
            found[row.name] = row
            progress.update(task, advance=1, note=row.name)
    done = [found[name] for name in names]
    if figure is not None:
        from chargetune.report.figures.comparison import comparison_figure
        from chargetune.report.figures.style import save

        save(comparison_figure(problem, done), figure)
    if as_json:
        told = {"rows": [_facts(row) for row in done], "result": None if result is None else result.facts()}
        print(json.dumps(told | setting(problem)))  # noqa: T201
        return
    screen = console()
    screen.print(_table(done))
    screen.print(
        "[dim]Judged without sensor noise: voltage over its limit (negative: the distance kept), and where there are some the least anode "
        "potential and the highest temperature. CC-CV and steps keep the voltage exactly, the plant oracle every limit: it knows the plant "
        "and is what can be reached. Chosen is what was set on this very plant: CC-CV's fastest rate and the smallest "
        "constant backoff with which every limit is kept.[/]"
    )
    if result is not None:
        screen.print(f"Tuned MPC: {result_line(result)}", style="dim", markup=False, soft_wrap=True)
    if store is None:
        screen.print("[dim]--store STORE adds the tuned controller of a study.[/]")
    if figure is not None:
        screen.print(f"figure {figure}", markup=False, soft_wrap=True)


def _over_range(
    problem: ChargingProblem,
    theta: list[float] | None,
    result: StudyResult | None,
    *,
    wanted: list[str],
    draws: int,
    seed: int,
    workers: int,
    as_json: bool,
) -> None:
    names = chosen_rows(range_row_names(problem, theta), wanted)
    workers = workers_for(workers, len(names), ("controller", "controllers"))
    found: dict[str, RangeRow] = {}
    with ExitStack() as stack:
        executor = stack.enter_context(process_executor(workers)) if workers > 1 else None
        progress = stack.enter_context(bar(quiet=as_json))
        task = progress.add_task("charging", total=len(names), note="")
        for row in compare_range(problem, theta, rows=names, draws=draws, seed=seed, executor=executor):
            raise_lost_interrupt()
            found[row.name] = row
            progress.update(task, advance=1, note=row.name)
    limits = [limit for limit in problem.limits_by_name if limit != "voltage_min_V"]
    facts = [_range_facts(found[name], found.get(ORACLE), limits) for name in names]
    use = {} if problem.range is None else problem.range.entries
    if as_json:
        print(json.dumps({"range": use, "draws": draws, "rows": facts, "result": None if result is None else result.facts()}))  # noqa: T201
        return
    screen, table = console(), Table(box=None, pad_edge=False)
    # At 80 columns a heading needs lines of its own. Where that is not enough names are wrapped, and no number is cut.
    excesses = [f"worst\n{limit.replace('_', chr(10), 1)}" for limit in limits]
    for heading in ("", "chosen", "over a\nlimit", *excesses, "mean\nt80\nmin", "mean\nt90\nmin", "t80 to\noracle's"):
        table.add_column(heading, justify="left" if heading in ("", "chosen") else "right", no_wrap=heading != "")
    for one in facts:
        worst = (_excess(limit, one["worst_excess"][limit]) for limit in limits)
        times = (number(one["mean_t80_min"]), number(one["mean_t90_min"]), number(one["ratio"], 3))
        table.add_row(one["name"], one["setting"], f"{one['violations']} of {draws}", *worst, *times)
    screen.print(table)
    line = "" if problem.range is None else problem.range.line
    screen.print(
        f"Range of use: {line}. The same {counted(draws, 'drawn plant')} in every row, judged by their true outputs. CC-CV and steps "
        "have the fastest rate, and the constant backoffs the smallest values, with which all of these plants keep every limit, or the "
        "most cautious one if none does; they were chosen on them, tuned theta was not. The plant oracle knows each plant.",
        style="dim",
    )
    if result is not None:
        screen.print(f"Tuned MPC: {result_line(result)}", style="dim", markup=False, soft_wrap=True)


def _range_facts(row: RangeRow, oracle: RangeRow | None, limits: list[str]) -> dict[str, Any]:
    own, best = row.mean("t80_min"), None if oracle is None else oracle.mean("t80_min")
    return {
        "name": row.name,
        "setting": row.setting,
        "draws": len(row.scores),
        "violations": row.violations,
        "not_completed": sum(score is None for score in row.scores),
        "worst_excess": {limit: row.worst_excess(limit) for limit in limits},
        "mean_t80_min": own,
        "mean_t90_min": row.mean("t90_min"),
        "ratio": own / best if own is not None and best else None,
    }


def _excess(limit: str, value: float | None) -> str:
    volts = limit.endswith("_V")
    return "-" if value is None else f"{1e3 * value if volts else value:.1f} {'mV' if volts else limit.rpartition('_')[2]}"


def _result(location: str, study: str) -> StudyResult:
    with Store(location, read_only=True) as store:
        result = read_result(store, store.study(study))
    if result.trial is None:
        raise ValueError(f"{shown(location)}: study {study!r} has no trial with a score yet")
    return result


def _facts(row: Row) -> dict[str, Any]:
    metrics = row.score.metrics if row.score else {}
    return {
        "name": row.name,
        "setting": row.setting,
        "t80_min": metrics.get("t80_min"),
        "t90_min": metrics.get("t90_min"),
        "worst_excess": row.worst_excess,
        "breaks_limit": row.breaks_limit,
        "anode_potential_min_mV": _extreme(row, "anode_potential_V", largest=False, factor=1e3),
        "temperature_max_K": _extreme(row, "temperature_K", largest=True, factor=1.0),
        "ending": row.episode.ending.value,
        "message": row.episode.message,
    }


def _extreme(row: Row, signal: str, *, largest: bool, factor: float) -> float | None:
    if signal not in row.episode.output_names or not len(row.episode):
        return None
    start, end = row.episode.signal(signal)
    return factor * float(max(start.max(), end.max()) if largest else min(start.min(), end.min()))


def _table(rows: list[Row]) -> Table:
    """A column for what some row has: a study without anode or temperature has none for them."""
    table, facts = Table(box=None, pad_edge=False), [_facts(row) for row in rows]
    columns = {
        "t80\nmin": [number(one["t80_min"]) for one in facts],
        "t90\nmin": [number(one["t90_min"]) for one in facts],
        "over\nmV": [number(one["worst_excess"]["voltage_mV"], 1) for one in facts],
        "anode\nmV": [number(one["anode_potential_min_mV"], 1) for one in facts],
        "max\nK": [number(one["temperature_max_K"], 1) for one in facts],
    }
    told = {heading: values for heading, values in columns.items() if {*values} != {"-"}}
    for heading in ("", "chosen", *told, "limits"):
        table.add_column(heading, justify="left" if heading in ("", "chosen", "limits") else "right", no_wrap=heading != "")
    for row, *values in zip(rows, *told.values(), strict=True):
        table.add_row(row.name, row.setting, *values, "[red]broken[/]" if row.breaks_limit else "kept")
    return table
