"""The table, the figure and the leaderboard page of the tuner suite."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table
from tuner_suite.methods import METHODS
from tuner_suite.table import WANTED, rows, solved_at

__all__ = ["print_table", "write_page"]

BEGIN, END = "<!-- begin: leaderboard, written by benchmarks/tuners.py --page -->", "<!-- end: leaderboard -->"


def print_table(found: Sequence[dict[str, Any]]) -> None:
    """A line for each plant and method."""
    table = Table("plant", "method", "solved", "trials", "over, of", "ask s", "stopped")
    for r in found:
        trials = "-" if r["trials"] is None else str(r["trials"])
        over, ask = f"{r['over']:g}, {r['of']}", "-" if r["ask_s"] is None else f"{r['ask_s']:.1f}"
        table.add_row(r["plant"], r["method"], f"{r['solved']}/{r['seeds']}", trials, over, ask, str(r["stopped"]))
    Console().print(table)


def write_page(runs: Sequence[dict[str, Any]], plants: Sequence[str], methods: Sequence[str], docs: Path, command: str) -> None:
    """The part of docs/tuners.md between its two marks, and docs/tuners.png."""
    found = {(r["plant"], r["method"]): r for r in rows(runs)}
    there = [m for m in methods if any(method == m for _, method in found)]
    page = docs / "tuners.md"
    text = page.read_text(encoding="utf-8")
    head, rest = text.split(BEGIN)
    _, tail = rest.split(END)
    page.write_text(head + BEGIN + "\n\n" + _text(found, runs, plants, there, command) + "\n" + END + tail, encoding="utf-8")
    _figure(runs, there, docs / "tuners.png")


def _text(found: dict, runs: Sequence[dict[str, Any]], plants: Sequence[str], methods: Sequence[str], command: str) -> str:
    seeds = sorted({r["seed"] for r in runs})
    counts = sorted({r["seeds"] for r in found.values()})
    said = f"{counts[0]} to {counts[-1]} seeds" if len(counts) > 1 else f"{counts[0]} seed{'s' if counts[0] > 1 else ''}"
    out = [f"Made with `{command}`:", f"{len(runs)} runs, {said} for each plant and method (seeds {seeds[0]} to {seeds[-1]}).", ""]
    out += ["| method | plants solved | runs solved | trials over a limit | s a proposal | refused |", "|---|---|---|---|---|---|"]
    order = sorted(methods, key=lambda m: (-_share(found, m)[0], _share(found, m)[2]))
    for m in order:
        solved, of, over = _share(found, m)
        mine = [r for (_, method), r in found.items() if method == m]
        own = [r for r in runs if r["method"] == m]
        tried = sum(len(r["kept"][:WANTED]) for r in own)
        ask = float(np.median([r["ask_s"] for r in mine if r["ask_s"] is not None]))
        runs_solved = f"{sum(r['solved'] for r in mine)} of {sum(r['seeds'] for r in mine)}"
        refused = sum(r["stopped"] for r in mine)
        out.append(f"| {m}: {METHODS[m].what} | {solved} of {of} | {runs_solved} | {over} of {tried} | {ask:.2g} | {refused} |")
    out += ["", f"Solved: within {WANTED} trials; a plant counts as solved where more than half of its seeds are.", ""]
    out += ["![Share of runs that are solved over the number of trials, and share of trials over a limit, by method](tuners.png)", ""]
    out += ["| plant | " + " | ".join(methods) + " |", "|---|" + "---|" * len(methods)]
    for p in plants:
        if any(plant == p for plant, _ in found):
            out.append(f"| {p} | " + " | ".join(_cell(found.get((p, m))) for m in methods) + " |")
    out += ["", "Each cell: median trials to the first solution (-: half of the seeds or more have none) / median trials over a limit."]
    return "\n".join(out) + "\n"


def _cell(row: dict[str, Any] | None) -> str:
    return "n/a" if row is None else f"{'-' if row['trials'] is None else row['trials']} / {row['over']:g}"


def _share(found: dict, method: str) -> tuple[int, int, int]:
    """(plants solved, plants run, trials over) of a method."""
    mine = [r for (_, m), r in found.items() if m == method]
    return sum(2 * r["solved"] > r["seeds"] for r in mine), len(mine), sum(r["over_sum"] for r in mine)


def _figure(runs: Sequence[dict[str, Any]], methods: Sequence[str], path: Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1.3, 1.0))
    most = max(r["trials"] for r in runs)
    styles = {m: {"color": f"C{k % 10}", "ls": ("-", "--")[k >= 10]} for k, m in enumerate(methods)}
    for m in methods:
        own = [r for r in runs if r["method"] == m]
        at, count = np.array([solved_at(r) for r in own]), max(r["trials"] for r in own)
        left.plot(range(1, count + 1), [100 * np.mean(at <= k) for k in range(1, count + 1)], marker=".", label=m, **styles[m])
    left.set(xlabel="trials", ylabel="runs solved (%)", ylim=(-3, 103), xticks=range(1, most + 1))
    figure.legend(loc="outside upper center", fontsize=8, ncols=6)
    over = {m: 100 * (1 - np.mean([k for r in runs if r["method"] == m for k in r["kept"][:WANTED]])) for m in methods}
    right.barh(range(len(methods)), [over[m] for m in methods], color=[styles[m]["color"] for m in methods])
    right.set_yticks(range(len(methods)), methods)
    right.invert_yaxis()
    right.set(xlabel=f"of the first {WANTED} trials over a limit (%)", xlim=(0, 100))
    figure.savefig(path, dpi=130)
