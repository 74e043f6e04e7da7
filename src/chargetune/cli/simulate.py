"""chargetune simulate."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.markup import escape

from chargetune.battery.charging.evaluate import outcome, run_charge
from chargetune.battery.charging.problem import ChargingProblem
from chargetune.battery.studies.study_file import load_config
from chargetune.cli.output import console, metrics_table, setting
from chargetune.cli.outputs import Kind, Output, claim, figure_kind, read_by
from chargetune.report.figures.style import check_format, save
from chargetune.report.figures.trajectories import episode_figure
from chargetune.report.page.trial_rows import trace_csv
from chargetune.runtime.counted import counted
from chargetune.runtime.interrupts import raise_lost_interrupt
from chargetune.study.files import write_whole

__all__ = ["parse_theta", "simulate_command"]


def simulate_command(
    path: Path, *, theta: str | None, seed: int, as_json: bool, figure: Path | None = None, out: Path | None = None, overwrite: bool = False
) -> None:
    """Run one closed loop and print what it was worth; with ``as_json`` also the trajectory.

    ``figure`` is drawn as its ending says (png, pdf, svg); ``out`` has the trace as CSV, one row an interval.
    """
    if figure is not None:
        check_format(figure, "--figure")
    if out is not None and out.suffix.lower() != ".csv":
        raise ValueError(f"--out {out}: allowed is a file that ends with .csv")
    config = load_config(path)
    outputs = [Output("--figure", figure, figure_kind(figure))] if figure is not None else []
    outputs += [Output("--out", out, Kind.CSV)] if out is not None else []
    claim(outputs, inputs=read_by(path, config.model_dump()), overwrite=overwrite, folders=False)
    problem = config.problem(path.parent)
    values = problem.theta_values if theta is None else parse_theta(theta, problem, "--theta")
    episode = run_charge(problem, values, seed)
    raise_lost_interrupt()
    if not len(episode):
        raise ValueError(f"the episode has no interval; it ended with {episode.ending.value}: {episode.message}")
    score, _, ending = outcome(problem, episode)
    written = []
    if figure is not None:
        written.append(f"figure {save(episode_figure(problem, episode, score), figure)}")
    if out is not None:
        written.append(f"trace {write_whole(out, trace_csv(episode))}")
    if score is None:
        # What ended the run can still be looked at.
        raise ValueError(
            f"the run has no score; it ended after {counted(len(episode), 'interval')}: {ending}" + "".join(f"\n{line}" for line in written)
        )
    start, end = episode.signal("voltage_V")
    _, soc = episode.signal("soc")
    if as_json:
        data: dict[str, Any] = {
            "overshoot_mV": score.metrics["overshoot_mV"],
            "t80_min": score.metrics["t80_min"],
            "t95_min": score.metrics["t95_min"],
            "soc": [problem.episode.soc_start, *soc.tolist()],
            "current_A": episode.input[:, 0].tolist(),
            "voltage_start_V": start.tolist(),
            "voltage_end_V": end.tolist(),
            "status": episode.status.tolist(),
            "kkt_worst": float(np.max(episode.kkt)),
            "theta": dict(zip(problem.space.entries, values.tolist(), strict=True)),
            "ending": episode.ending.value,
            "score": {
                "objective": score.objective,
                "performance": score.performance,
                "excess": dict(score.excess),
                "feasible": score.feasible,
            },
            "metrics": dict(score.metrics),
            **setting(problem),
        }
        print(json.dumps(data))  # noqa: T201
        return
    screen = console()
    screen.print(
        f"[bold]{escape(problem.cell.title)}[/], {counted(len(episode), 'interval')} of {problem.controller.sampling_time_s:g} s, "
        f"ended: {episode.ending.value}"
    )
    for line in problem.setting_lines:
        screen.print(f"[dim]{escape(line)}[/]")
    if problem.cell.remark:
        screen.print(f"[dim]{escape(problem.cell.remark)}[/]")
    screen.print(metrics_table({"this run": score}, problem, config.study.tuner))
    screen.print("".join(f"{line}\n" for line in written), end="", markup=False, soft_wrap=True)


def parse_theta(text: str, problem: ChargingProblem, option: str) -> NDArray[np.float64]:
    """theta as an option gives it: numbers separated by commas, or a JSON object of named values. Raises ValueError."""
    if text.lstrip().startswith("{"):
        try:
            named = json.loads(text)
        except json.JSONDecodeError as error:
            raise ValueError(f"{option} is not valid JSON: {error}") from error
        return problem.space.from_dict(named)
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError as error:
        raise ValueError(f"{option} = {text!r}: expected numbers separated by commas, or a JSON object of named values") from error
    space = problem.space
    if len(numbers) != space.dimension:
        named = ", ".join(space.entries)
        raise ValueError(f"{option} has {counted(len(numbers), 'value')}, allowed is one for each of these {space.dimension}: {named}")
    return space.validate(numbers)
