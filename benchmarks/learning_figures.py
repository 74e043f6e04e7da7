"""Figures of the learning benchmark, from what learning.py printed.

    python benchmarks/learning.py --plant ecm --study r0 --json > r0.json
    python benchmarks/learning_figures.py r0.json more.json --out docs/learning.png

One column for each plant and study, several files of which add their methods: seeds solved over the number of trials above, the
worst true excess of any trial so far below (0 where the limit was never broken).
"""

from __future__ import annotations

import argparse
import json
import sys
from itertools import groupby
from pathlib import Path
from typing import Any

from chargetune.report.figures.style import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PAGE_IN,
    RED,
    check_format,
    journal_style,
    legend_above,
    new_figure,
    save,
)

LOOKS: dict[str, dict[str, Any]] = {
    "safe": {"color": BLUE, "marker": "o"},
    "twin": {"color": GREEN, "marker": "s"},
    "composite": {"color": ORANGE, "marker": "^"},
    "ilc": {"color": BLUE, "linestyle": ":"},
    "default": {"color": RED},
    "ei": {"color": RED, "linestyle": "--"},
    "cmaes": {"color": GREY},
    "tpe": {"color": GREY, "linestyle": "--"},
    "sobol": {"color": GREY, "linestyle": ":"},
}
NAMES = {
    "ecm": "circuit", "unknown": "circuit, capacity, SOC\nand OCV unknown", "structural": "another circuit",
    "dfn": "DFN 2C 298 K", "dfn-283K": "DFN 2C 283 K", "dfn-3C": "DFN 3C 298 K",
    "dfn-limits": "DFN 2C, limits of\ntemperature and anode", "dfn-3C-limits": "DFN 3C, limits of\ntemperature and anode",
}  # fmt: skip
THETA = {"r0": "nine nodes of R0", "signed": "signed backoff, 11 nodes", "backoff": "backoff, 7 nodes", "model": "R1"}
# Trials up to which every trial is marked, and beyond which their axis is logarithmic.
FEW = 12
COLUMNS = 4


def _key(row: dict[str, Any]) -> tuple[str, str]:
    return row["plant"], row["study"]


def draw(rows: list[dict[str, Any]], out: Path) -> None:
    rows = sorted(rows, key=lambda r: (list(NAMES).index(r["plant"]), r["study"], list(LOOKS).index(r["method"]), r["trials"]))
    panels = [(key, list(group)) for key, group in groupby(rows, key=_key)]
    bands = -(-len(panels) // COLUMNS)
    wide = min(COLUMNS, len(panels))
    with journal_style():
        figure, flat = new_figure(PAGE_IN, 2.9 * bands, 2 * bands, wide)
        places = [flat[2 * band * wide + column :: wide][:2] for band in range(bands) for column in range(wide)]
        for (upper, lower), ((plant, study), group) in zip(places, panels, strict=False):
            _panel(upper, lower, group)
            upper.set_title(f"{NAMES[plant]}\n{THETA[study]}")
        for upper, lower in places[::wide]:
            upper.set_ylabel("seeds solved, %")
            lower.set_ylabel("worst excess, mV")
        for pair in places[len(panels) :]:
            for ax in pair:
                ax.set_axis_off()
        lines = {str(line.get_label()): line for ax in flat for line in ax.get_lines()}
        legend_above(figure, [lines[name] for name in LOOKS if name in lines])
        save(figure, out)


def _panel(upper: Any, lower: Any, group: list[dict[str, Any]]) -> None:
    most = max(r["trials"] for r in group)
    for method, own in groupby(group, key=lambda r: r["method"]):
        part = list(own)
        trials = [r["trials"] for r in part]
        look = LOOKS[method] | ({} if most <= FEW else {"marker": ""})
        upper.plot(trials, [100 * r["solved"] / r["of"] for r in part], label=method, markersize=3, **look)
        lower.plot(trials, [max(0.0, r["worst_excess_mV"]) for r in part], label=method, markersize=3, **look)
    upper.set_ylim(-4, 104)
    lower.set_yscale("symlog", linthresh=1.0)
    lower.set_ylim(-0.2, 600)
    lower.set_yticks([0, 1, 10, 100], ["0", "1", "10", "100"])
    lower.axhline(1.0, color=GREY, linewidth=0.6, zorder=0)
    for ax in (upper, lower):
        if most > FEW:
            ax.set_xscale("log")
            ax.set_xticks([t for t in (1, 3, 10, 30, 100) if t <= most], [str(t) for t in (1, 3, 10, 30, 100) if t <= most])
            ax.minorticks_off()
        else:
            ax.set_xticks(range(1, most + 1))
    lower.set_xlabel("trials")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="+", type=Path, help="what learning.py --json printed")
    parser.add_argument("--out", type=Path, default=Path("out/learning/learning.png"))
    args = parser.parse_args()
    check_format(args.out)
    rows: list[dict[str, Any]] = []
    for file in args.files:
        try:
            rows += json.loads(file.read_text())["rows"]
        except (OSError, ValueError, KeyError, TypeError) as error:
            sys.exit(f"{file}: expected is what learning.py --json prints: {error}")
    args.out.parent.mkdir(parents=True, exist_ok=True)
    draw(rows, args.out)
    print(args.out)


if __name__ == "__main__":
    main()
