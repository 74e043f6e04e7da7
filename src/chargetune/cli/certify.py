"""chargetune certify."""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

from rich.markup import escape
from rich.table import Table

from chargetune.battery.cell.cell import load_cells
from chargetune.battery.certification.certificate import Charge, run_charges, write_certificate
from chargetune.battery.certification.default_range import default_range
from chargetune.battery.charging.problem import ChargingProblem
from chargetune.battery.charging.range_settings import range_line
from chargetune.battery.studies.study_file import problem_of_document
from chargetune.cli.output import beside, console, number, workers_for
from chargetune.cli.outputs import Kind, Output, claim
from chargetune.cli.tune import bar
from chargetune.runtime.counted import counted
from chargetune.runtime.interrupts import raise_lost_interrupt
from chargetune.study.executors import process_executor
from chargetune.study.result import read_result
from chargetune.study.store.database import store_name
from chargetune.study.store.store import Store

__all__ = ["certify_command"]


def certify_command(
    location: str,
    *,
    study: str | None,
    trial: int | None,
    episodes: int,
    seed: int,
    confidence: float,
    changes: Mapping[str, Any],
    cells: Path | None,
    workers: int,
    output: Path | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Run the theta of a trial, or of the study's result, on fresh episodes of the study's range and write the certificate.

    ``changes`` are entries of the range that the certificate has another value of, ``cells`` a folder of cell files.
    """
    if not 0.0 < confidence < 1.0:
        raise ValueError(f"--confidence = {confidence:g}, allowed is (0, 1)")
    with Store(location, read_only=True) as store:
        names = [record.name for record in store.studies()]
        if study is None and len(names) != 1:
            raise ValueError(
                f"{store.label} holds {counted(len(names), 'study', 'studies')}, choose one with --study: {', '.join(names) or '(none)'}"
            )
        record = store.study(study or names[0])
        trials = store.trials(record.id)
        result = read_result(store, record, trials)
    best = result.kept if trial is None else next((t for t in trials if t.number == trial), None)
    if best is None and trial is not None:
        allowed = f"0 to {len(trials) - 1}" if trials else "none: it has no trials"
        raise ValueError(f"--trial {trial}: study {record.name!r} has no such trial, allowed is {allowed}")
    if best is None and result.trial is not None:
        raise ValueError(
            f"{store.label}: the result of study {record.name!r}, trial {result.trial.number}, broke a limit ({result.sentence}),"
            " so there is nothing to certify; --trial N certifies another one"
        )
    if best is None:
        raise ValueError(f"{store.label}: study {record.name!r} has no trial with a score, so there is nothing to certify")
    if "cell" not in record.identity["config"]:
        raise ValueError(f"{store.label}: study {record.name!r} is not one of battery charging")
    problem, whose = _with_range(problem_of_document(record.identity["config"]), changes, cells)
    target = output or beside(location, "-certificate.json")
    if target.suffix != ".json":
        raise ValueError(f"--output {target}: allowed is a file name that ends in .json")
    outputs = [Output("--output", target, Kind.CERTIFICATE), Output("--output's figure", target.with_suffix(".png"), Kind.PNG)]
    claim(outputs, inputs=[location, *(cells.glob("*.toml") if cells else ())], overwrite=overwrite)
    target.parent.mkdir(parents=True, exist_ok=True)
    charges: list[Charge] = []
    workers = workers_for(workers, episodes, ("episode", "episodes"))
    with ExitStack() as stack:
        executor = stack.enter_context(process_executor(workers)) if workers > 1 else None
        progress = stack.enter_context(bar(quiet=as_json))
        task = progress.add_task("certifying", total=episodes, note="")
        for portion in run_charges(problem, best.theta, seed=seed, episodes=episodes, executor=executor):
            raise_lost_interrupt()
            charges += portion
            over = sum(charge.score is None or not charge.score.feasible for charge in charges)
            progress.update(task, advance=len(portion), note=f"{over} over")
    certificate = write_certificate(
        target,
        problem,
        charges,
        theta=dict(zip(problem.space.entries, best.theta, strict=True)),
        origin={
            "store": store_name(location),
            "study": record.name,
            "study_sha256": record.identity_sha256,
            "trial": best.number,
            "trials": len(trials),
            "why": f"it is the result: {result.sentence}" if trial is None else "it was named",
            "range": whose,
        },
        seed=seed,
        confidence=confidence,
    )
    from chargetune.report.figures.certificate import certificate_figure
    from chargetune.report.figures.style import save

    figure = save(certificate_figure(target), target.with_suffix(".png"))
    if as_json:
        print(json.dumps(certificate))  # noqa: T201
        return
    screen = console()
    _print(certificate)
    traces = target.with_name(certificate["traces"]["file"])
    screen.print(f"certificate {target}\ntraces {traces}\nfigure {figure}", markup=False, soft_wrap=True)
    line = f"recompute every figure from the traces: chargetune verify {target}"
    screen.print(line, style="dim", markup=False, soft_wrap=True)


def _with_range(problem: ChargingProblem, changes: Mapping[str, Any], cells: Path | None) -> tuple[ChargingProblem, str]:
    """The problem with the range that is certified, and where that is from."""
    given = {name: value for name, value in changes.items() if value is not None}
    if cells is not None:
        given["cells"] = cells.resolve().name
    whose = "the default, since the study has no table [range]" if problem.range is None else "the study's [range]"
    settings = replace(problem.range or default_range(problem), **given)
    changed = replace(problem, range=settings, range_cells=problem.range_cells if cells is None else load_cells(cells))
    return changed, whose + (f", with other {', '.join(given)}" if given else "")


def _print(certificate: dict[str, Any]) -> None:
    f, origin = certificate["figures"], certificate["origin"]
    screen = console()
    screen.print(
        f"[bold]{escape(certificate['cell']['name'])}[/], study {escape(repr(origin['study']))}, trial {origin['trial']}: "
        f"{counted(f['episodes'], 'fresh episode')}, {f['violations']} broke a limit ({f['not_completed']} did not come to their end)",
        soft_wrap=True,
    )
    screen.print(f"trial {origin['trial']}: {origin['why']}", style="dim", markup=False, soft_wrap=True)
    if certificate["cell"]["remark"]:
        screen.print(f"[dim]{escape(certificate['cell']['remark'])}[/]")
    bound, confidence = f["violation_probability_upper"], certificate["confidence"]
    screen.print(f"probability of a violation at most {100 * bound:.2f} % (confidence {100 * confidence:g} %)")
    table = Table(box=None, pad_edge=False)
    for heading in ("limit", "violations", "worst excess", "tolerance"):
        table.add_column(heading, justify="left" if heading == "limit" else "right")
    for limit in certificate["limits"]:
        worst, unit = f[f"{limit['name']}.worst_excess"], limit["name"].rpartition("_")[2]
        factor, shown = (1e3, "mV") if unit == "V" else (1.0, unit)
        table.add_row(
            limit["name"],
            str(f[f"{limit['name']}.violations"]),
            f"{number(None if worst is None else factor * worst)} {shown}",
            f"{factor * limit['tolerance']:g} {shown}",
        )
    screen.print(table)
    for name in ("t80_min", "t95_min"):
        values = ", ".join(
            f"{label} {number(f[f'{name}.{key}'])}" for label, key in (("median", "q50"), ("95 %", "q95"), ("worst", "worst"))
        )
        screen.print(f"{name.removesuffix('_min')} in minutes: {values}")
    # A name in brackets is no markup.
    use = f"range of use ({origin['range']}): {range_line(certificate['range'])}. {certificate['drawn']}"
    screen.print(use, style="dim", markup=False, soft_wrap=True)
