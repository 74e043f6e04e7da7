"""chargetune check."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from chargetune.battery.charging.checks import check_charging
from chargetune.battery.charging.problem import ChargingProblem
from chargetune.battery.studies.study_file import Config, load_config
from chargetune.checks.finding import Finding
from chargetune.cli.output import console, setting
from chargetune.cli.outputs import Kind, Output, claim, read_by
from chargetune.runtime.counted import counted
from chargetune.runtime.interrupts import raise_lost_interrupt

__all__ = ["check_command", "facts", "print_findings"]


# A controller without theta can be simulated and compared, and not tuned, which is what a check is for.
NO_THETA = Finding(
    "no-theta",
    "error",
    "theta is empty: there is nothing to tune, and tune refuses it",
    "add a table [theta.backoff], [theta.R0] or [theta.R1]",
    {},
)


def check_command(path: Path, *, safe: str | None, figures: Path | None, overwrite: bool, as_json: bool) -> None:
    """Check the formulation of a study file; exit code 1 when an error is found."""
    from chargetune.cli.simulate import parse_theta

    config = load_config(path)
    problem = config.problem(path.parent)
    start = None if safe is None else parse_theta(safe, problem, "--safe")
    if figures is not None:
        # Which findings there are is not known yet; any of an earlier check may have the name of one.
        earlier = [p for p in figures.glob("*.png") if re.fullmatch(r"\d+-[a-z-]+", p.stem)] or [figures / "1-finding.png"]
        claim([Output("--figures", p, Kind.PNG) for p in earlier], inputs=read_by(path, config.model_dump()), overwrite=overwrite)
    screen = console()
    if as_json:
        findings = check_charging(problem, start=start)
    else:
        with console(stderr=True).status("running closed loops"):
            findings = check_charging(problem, start=start)
    if not any(finding.severity == "error" for finding in findings):
        findings = (*_first_trial(config, problem), *findings)
    raise_lost_interrupt()
    if not problem.space.dimension:
        findings = (NO_THETA, *findings)
    drawn: list[Path] = []
    if figures is not None and findings:
        from chargetune.report.figures.check_findings import save_findings

        drawn = save_findings(findings, figures)
    if as_json:
        found = {"file": str(path), "findings": [facts(f) for f in findings], "figures": [str(f) for f in drawn]}
        print(json.dumps(found | setting(problem) | {"note": problem.estimator.unread}))  # noqa: T201
    else:
        for line in problem.setting_lines:
            screen.print(line, markup=False, style="dim", soft_wrap=True)
        print_findings(findings, screen)
        if problem.estimator.unread:
            screen.print(f"note: {problem.estimator.unread}", markup=False, soft_wrap=True)
        screen.print(f"{path}: {summary(findings)}" + "".join(f"\nfigure {f}" for f in drawn), markup=False, soft_wrap=True)
    if any(f.severity == "error" for f in findings):
        sys.exit(1)


def _first_trial(config: Config, problem: ChargingProblem) -> tuple[Finding, ...]:
    """Whether safe mode has a theta to begin with. Over a range of use that takes minutes, and is left to the study."""
    if problem.safety is None or problem.safe_start is not None or problem.range is not None or not problem.space.dimension:
        return ()
    from chargetune.battery.studies.open_study import make_tuner
    from chargetune.learning import NoSafeThetaError

    try:
        with config.named():
            tuner = make_tuner(config.study.tuner, config.study.seed, problem, config.twin)
        tuner.ask(problem.space, [])
    except NoSafeThetaError as error:
        remedy = "a start that is known to keep them ([safety] start), wider bounds of theta, or a smaller spread in [twin]"
        return (Finding("no-safe-start", "error", str(error), remedy, {}),)
    return ()


def print_findings(findings: Sequence[Finding], screen: Console) -> None:
    """Each finding with what to do, two lines."""
    for finding in findings:
        color = "red" if finding.severity == "error" else "yellow"
        screen.print(f"[{color}]{finding.severity}[/] [bold]{finding.code}[/]: ", end="")
        # Names of entries have brackets, which are no markup.
        screen.print(finding.message, markup=False, soft_wrap=True)
        screen.print(f"  what to do: {finding.remedy}", markup=False, soft_wrap=True)


def summary(findings: Sequence[Finding]) -> str:
    """How many of each."""
    errors = sum(f.severity == "error" for f in findings)
    return f"{counted(errors, 'error')}, {counted(len(findings) - errors, 'warning')}" if findings else "nothing found"


def facts(finding: Finding) -> dict[str, Any]:
    """A finding as JSON, without its curves; a number that is none is null."""
    numbers = {name: value if abs(value) < float("inf") else None for name, value in finding.numbers.items()}
    return {
        "code": finding.code,
        "severity": finding.severity,
        "message": finding.message,
        "remedy": finding.remedy,
        "numbers": numbers,
    }
