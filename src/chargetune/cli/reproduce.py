"""chargetune reproduce."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, cast

from rich.table import Table

from chargetune.battery.case_study.configurations import case_study
from chargetune.battery.case_study.reproduce import reproduce, summarise
from chargetune.battery.studies.study_file import TunerName
from chargetune.cli.output import console, number, workers_for
from chargetune.cli.outputs import Kind, Output, claim
from chargetune.cli.tune import bar
from chargetune.runtime.counted import counted
from chargetune.study.executors import process_executor
from chargetune.study.files import write_whole

__all__ = ["reproduce_command", "seed_list"]


def seed_list(text: str) -> list[int]:
    """Seeds from the text ``A:B``, meaning range(A, B), or ``A,B,C``. Raises ValueError."""
    try:
        if ":" in text:
            first, last = (int(part) for part in text.split(":"))
            seeds = list(range(first, last))
        else:
            seeds = [int(part) for part in text.split(",")]
    except ValueError as error:
        raise ValueError(f"--seeds = {text!r}: expected A:B or A,B,C") from error
    if not seeds or min(seeds) < 0 or len(set(seeds)) != len(seeds):
        raise ValueError(f"--seeds = {text!r}: allowed are different whole numbers >= 0, at least one")
    return seeds


def reproduce_command(case: str, *, seeds: str, trials: int, tuner: str, workers: int, out: Path, overwrite: bool, as_json: bool) -> None:
    """Run the study for every seed, decide the claims, draw the figures."""
    from chargetune.report import save_figures, seeds_figure

    numbers, name = seed_list(seeds), cast("TunerName", tuner)
    path = out / f"{case}-{tuner}.sqlite"
    drawn = out / f"{case}-{tuner}-seed{numbers[0]}"
    tables = [out / "claims.json", out / f"claims-{case}-{tuner}.json"]
    # Studies that are found in the folder go on, and what was made of them is made again.
    own = overwrite or _is_claims(tables[0])
    claim(
        [
            Output("--out", path, Kind.STORE, renewed=True),
            *(Output("--out", table, Kind.JSON, renewed=own) for table in tables),
            Output("--out", out / f"{case}-{tuner}-seeds.png", Kind.PNG, renewed=own),
            *(Output("--out", drawn / f"{stem}.png", Kind.PNG, renewed=own) for stem in ("trajectories", "backoff", "R1", "convergence")),
        ],
        inputs=[],
        overwrite=overwrite,
    )
    out.mkdir(parents=True, exist_ok=True)
    workers = workers_for(workers, len(numbers), ("seed", "seeds"))
    with process_executor(workers) as executor, bar(quiet=as_json) as progress:
        task = progress.add_task(f"{case}, {tuner}", total=len(numbers), note="")
        safe = 0

        def note(seed: int, row: dict[str, Any]) -> None:
            nonlocal safe
            tuned = row["tuned"]
            safe += bool(tuned and tuned["overshoot_mV"] <= 1.0)
            progress.update(
                task, advance=1, note=f"seed {seed}: t95 {number(tuned['t95_min'] if tuned else None)} min; {counted(safe, 'seed')} safe"
            )

        rows = reproduce(case, numbers, trials=trials, tuner=name, path=path, executor=executor, progress=note)
    result = summarise(out, case, name, rows, trials)
    for target in tables:
        write_whole(target, json.dumps(result, indent=1))
    figures = save_figures(path, case_study(case, numbers[0], name).study.name, drawn, trials=trials)
    seeds_figure(rows, out / f"{case}-{tuner}-seeds.png")
    if as_json:
        print(json.dumps(result))  # noqa: T201
        return
    screen = console()
    summary = result["summary"]
    screen.print(_ways_table(summary["ways"]) if case == "rbf" else _rows_table(rows))
    screen.print(
        "offset-free: the untuned controller that reads the voltage, in its first charge; the others do not read it", soft_wrap=True
    )
    if case == "rbf":
        screen.print("cautious cost: what the safe twin begins with; oracle: the untuned controller that knows the cell", soft_wrap=True)
    screen.print(f"\n{summary['safe']} of {counted(summary['of'], 'seed')} within 1 mV, median t95 {number(summary['t95_min_median'])}"
                 f" min, {summary['violating_trials']} of {counted(summary['all_trials'], 'trial')} over the limit")  # fmt: skip
    table = Table(box=None, pad_edge=False, title="Claims", title_justify="left")
    for heading in ("", "claim", "holds"):
        table.add_column(heading)
    for found in result["claims"]:
        table.add_row(
            str(found["id"]),
            found["text"],
            f"{found['holds']} of {found['of']}" if found["of"] else "needs the other study in the same --out",
        )
    screen.print(table)
    screen.print(
        f"{out / 'claims.json'}" + "".join(f"\n{f}" for f in (*figures, out / f"{case}-{tuner}-seeds.png")), markup=False, soft_wrap=True
    )


def _is_claims(path: Path) -> bool:
    try:
        return bool({"case", "tuner", "claims", "per_seed"} <= json.loads(path.read_text(encoding="utf-8")).keys())
    except (OSError, ValueError, AttributeError):
        return False


def _rows_table(rows: list[dict[str, Any]]) -> Table:
    # At 80 columns a heading needs lines of its own.
    table = Table(box=None, pad_edge=False)
    for heading in (
        "seed", "untuned\nmV", "\nt95", "offset-\nfree mV", "\nt95", "tuned\nmV", "\nt80", "\nt95", "attain-\nable\nt95",
        "over\nlimit", "worst\nmV",
    ):  # fmt: skip
        table.add_column(heading, justify="right", no_wrap=True)
    for row in rows:
        untuned, feedback, tuned = row["untuned"], row["offset_free"], row["tuned"] or {}
        table.add_row(
            str(row["seed"]), number(untuned["overshoot_mV"], 1), number(untuned["t95_min"]),
            number(feedback["overshoot_mV"], 1), number(feedback["t95_min"]), number(tuned.get("overshoot_mV"), 2),
            number(tuned.get("t80_min")), number(tuned.get("t95_min")), number(row["attainable_t95_min"], 1),
            f"{row['violating_trials']}/{row['trials']}", number(row["worst_excess_mV"], 1),
        )  # fmt: skip
    return table


def _ways_table(ways: list[dict[str, Any]]) -> Table:
    table = Table(box=None, pad_edge=False)
    for heading in ("", "within 1 mV", "worst mV", "median t80", "median t95", "trials over"):
        table.add_column(heading, justify="right" if heading else "left")
    for way in ways:
        trials = "-" if way["trials"] is None else f"{way['violating_trials']} of {way['trials']}"
        table.add_row(
            way["name"], f"{way['safe']} of {way['of']}", number(way["worst_mV"], 1),
            number(way["t80_min_median"]), number(way["t95_min_median"]), trials,
        )  # fmt: skip
    return table
