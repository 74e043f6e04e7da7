"""The page of a certificate: excess and charging times of every fresh episode, read from its two files."""

from __future__ import annotations

import json
import os
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from chargetune.report.figures.style import BLUE, GREEN, ORANGE, PAGE_IN, RED, cell_note, journal_style, legend_above, letter, new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["certificate_figure"]

MARKS = ((0.80, BLUE), (0.90, GREEN), (0.95, ORANGE))


def certificate_figure(path: str | os.PathLike[str]) -> Figure:
    """(a) worst excess of each episode, largest first, of each upper limit; (b) share of episodes that reached a SOC by a time.

    Raises ValueError, OSError for files that cannot be read.
    """
    file = Path(path)
    stated = json.loads(file.read_text(encoding="utf-8"))
    with np.load(file.parent / Path(stated["traces"]["file"]).name, allow_pickle=False) as archive:
        arrays = {name: archive[name] for name in archive.files}
    length, found = arrays["length"], stated["figures"]
    edges = np.concatenate([[0], np.cumsum(length)])
    with journal_style():
        figure, axes = new_figure(PAGE_IN, 2.9, 1, 2)
        handles = []
        shown = [limit for limit in stated["limits"] if limit["name"] != "voltage_min_V"]
        for limit, color in zip(shown, (BLUE, ORANGE, GREEN), strict=False):
            factor, unit = (1e3, "mV") if limit["name"].endswith("_V") else (1.0, limit["name"].rpartition("_")[2])
            values = np.maximum(arrays[f"start.{limit['signal']}"], arrays[f"end.{limit['signal']}"])
            if not limit["upper"]:
                values = -np.minimum(arrays[f"start.{limit['signal']}"], arrays[f"end.{limit['signal']}"])
            beyond = values - (limit["bound"] if limit["upper"] else -limit["bound"])
            worst = np.array([np.max(beyond[a:b], initial=-np.inf) for a, b in pairwise(edges)])
            label = f"{limit['name'].rpartition('_')[0].replace('_', ' ')} ({unit})"
            handles += axes[0].plot(np.arange(1, len(worst) + 1), factor * np.sort(worst)[::-1], color=color, label=label)
            dashes = axes[0].axhline(factor * limit["tolerance"], color=RED, linestyle=(0, (4, 2)), linewidth=0.9, label="tolerance")
        handles.append(dashes)
        axes[0].set_xlabel("episodes, worst first")
        axes[0].set_ylabel("worst excess (negative: kept)")
        for mark, color in MARKS:
            times = np.sort([_minutes(arrays, i, edges, mark, stated["sampling_time_s"]) for i in range(len(length))])
            reached = times[np.isfinite(times)]
            share = 100 * np.arange(1, len(reached) + 1) / len(length)
            handles += axes[1].step(reached, share, where="post", color=color, linestyle=":", label=f"t{round(100 * mark)}")
        axes[1].set_ylim(0.0, 100.0)
        axes[1].set_xlabel("time (min)")
        axes[1].set_ylabel("episodes (%)")
        letter(axes)
        legend_above(figure, handles)
        cell_note(
            figure,
            stated["cell"]["name"],
            f"{found['episodes']} fresh episodes, {found['violations']} violating, probability of a violation at most "
            f"{100 * found['violation_probability_upper']:.2f} % (confidence {100 * stated['confidence']:g} %). "
            f"Study {stated['origin'].get('study', '')}, trial {stated['origin'].get('trial', '')}. {stated['cell']['remark']}",
        )
    return figure


def _minutes(arrays: dict[str, NDArray[np.float64]], i: int, edges: NDArray[np.int64], mark: float, step: float) -> float:
    soc = np.concatenate([[arrays["soc_start"][i]], arrays["end.soc"][edges[i] : edges[i + 1]]])
    above = np.flatnonzero(soc >= mark)
    if not above.size:
        return float(np.inf)
    k = int(above[0])
    return float(step / 60 * (k - (soc[k] - mark) / (soc[k] - soc[k - 1]))) if k else 0.0
