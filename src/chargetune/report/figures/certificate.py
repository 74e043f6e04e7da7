"""The page of a certificate: excess and charging times of every fresh episode, read from its two files."""

from __future__ import annotations

import json
import os
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from chargetune.report.figures.style import BLUE, GREEN, ORANGE, PAGE_IN, RED, cell_note, journal_style, legend_above, letter, new_figure
from chargetune.runtime.counted import counted

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["certificate_figure"]

MARKS = ((0.80, BLUE), (0.90, GREEN), (0.95, ORANGE))
# What a charge meets, by the name of its draw.
CONDITIONS = {
    "soc_start": ("SOC at the start (%)", 100.0),
    "ambient_K": ("ambient temperature (K)", 1.0),
    "age": ("age (% of full)", 100.0),
}


def certificate_figure(path: str | os.PathLike[str]) -> Figure:
    """Over the share of the episodes, one row a unit: worst excess of each episode and limit, below 0 kept; last the time to a SOC.

    A further column for each condition that differs, of start SOC, ambient temperature and age, shows each episode over it; a red
    cross is an episode that violates. Raises ValueError, OSError for files that cannot be read.
    """
    file = Path(path)
    stated = json.loads(file.read_text(encoding="utf-8"))
    with np.load(file.parent / Path(stated["traces"]["file"]).name, allow_pickle=False) as archive:
        arrays = {name: archive[name] for name in archive.files}
    count, found = len(arrays["length"]), stated["figures"]
    edges = np.concatenate([[0], np.cumsum(arrays["length"])])
    limits = [limit for limit in stated["limits"] if limit["name"] != "voltage_min_V"]
    excess = [_excess(arrays, edges, limit) for limit in limits]
    bounds = [_unit(limit["name"])[0] * limit["tolerance"] for limit in limits]
    over = [values > bound for values, bound in zip(excess, bounds, strict=True)]
    broken = np.any([~arrays["completed"].astype(bool), *over], axis=0)
    conditions = {name: drawn[:, 0] for name in CONDITIONS if (drawn := arrays.get(f"drawn.{name}")) is not None and np.ptp(drawn)}
    share = 100 * np.arange(1, count + 1) / count
    units = list(dict.fromkeys(_unit(limit["name"])[1] for limit in limits))
    with journal_style():
        columns = 1 + len(conditions)
        rows = [*units, "min"]
        figure, axes = new_figure(PAGE_IN, 0.6 + 1.8 * len(rows), len(rows), columns, sharex="col", sharey="row")
        row_of = {unit: axes[i * columns : (i + 1) * columns] for i, unit in enumerate(rows)}
        lower = row_of["min"]
        handles: list[Any] = []
        for k, (limit, values, bound, beyond, color) in enumerate(zip(limits, excess, bounds, over, (BLUE, ORANGE, GREEN), strict=False)):
            upper, what = row_of[_unit(limit["name"])[1]], limit["name"].rpartition("_")[0].replace("_", " ")
            handles += upper[0].plot(share, np.sort(values), color=color, label=what)
            # As many tolerances as there are limits, each in the colour of its own; equal ones show between each other's dashes.
            dashes: dict[str, Any] = {"color": color, "linestyle": (4 * k, (4, 4)), "linewidth": 0.9, "label": f"its tolerance ({what})"}
            line = [axis.axhline(bound, **dashes) for axis in upper]
            handles.append(line[0])
            for axis, (name, drawn) in zip(upper[1:], conditions.items(), strict=True):
                _points(axis, CONDITIONS[name][1] * drawn, values, beyond, color)
        for mark, color in MARKS:
            times = np.array([_minutes(arrays, i, edges, mark, stated["sampling_time_s"]) for i in range(count)])
            if not np.isfinite(times).any():
                # A SOC that no episode reached has no curve, and so no place in the legend.
                continue
            handles += lower[0].plot(
                share, np.sort(np.where(np.isfinite(times), times, np.nan)), color=color, linewidth=1.8, label=_named(mark)
            )
            for axis, (name, drawn) in zip(lower[1:], conditions.items(), strict=True):
                _points(axis, CONDITIONS[name][1] * drawn, times, broken, color)
        if conditions and np.any(broken):
            handles += lower[0].plot([], [], "x", color=RED, markersize=3.5, label="over a limit")
        for unit in units:
            row_of[unit][0].set_ylabel(f"worst excess ({unit})")
        lower[0].set_ylabel("time (min)")
        for axis in axes:
            axis.tick_params(labelbottom=True)
        for axis, label in zip(lower, ("episodes (%)", *(CONDITIONS[name][0] for name in conditions)), strict=True):
            axis.set_xlabel(label)
        letter(axes)
        figure.align_ylabels()
        legend_above(figure, handles, columns=4)
        cell_note(
            figure,
            stated["cell"]["name"],
            f"{counted(found['episodes'], 'fresh episode')}, {found['violations']} over a limit, probability of a violation at most "
            f"{100 * found['violation_probability_upper']:.2f} % (confidence {100 * stated['confidence']:g} %). "
            f"Study {stated['origin'].get('study', '')}, trial {stated['origin'].get('trial', '')}. {stated['cell']['remark']}",
        )
    return figure


def _named(mark: float) -> str:
    return f"t{round(100 * mark)}"


def _unit(limit: str) -> tuple[float, str]:
    """(factor, unit) in which the excess of a limit is drawn."""
    return (1e3, "mV") if limit.endswith("_V") else (1.0, limit.rpartition("_")[2])


def _excess(arrays: dict[str, NDArray[Any]], edges: NDArray[np.int64], limit: dict[str, Any]) -> NDArray[np.float64]:
    """Worst excess of each episode, NaN of one without an interval."""
    sign = 1.0 if limit["upper"] else -1.0
    beyond = np.maximum(*(sign * (arrays[f"{end}.{limit['signal']}"] - limit["bound"]) for end in ("start", "end")))
    return _unit(limit["name"])[0] * np.array([np.max(beyond[a:b]) if b > a else np.nan for a, b in pairwise(edges)])


def _points(axis: Axes, x: NDArray[np.float64], y: NDArray[np.float64], broken: NDArray[np.bool_], color: str) -> None:
    axis.plot(x[~broken], y[~broken], ".", color=color, markersize=2.5)
    axis.plot(x[broken], y[broken], "x", color=RED, markersize=3.5)


def _minutes(arrays: dict[str, NDArray[Any]], i: int, edges: NDArray[np.int64], mark: float, step: float) -> float:
    soc = np.concatenate([[arrays["soc_start"][i]], arrays["end.soc"][edges[i] : edges[i + 1]]])
    above = np.flatnonzero(soc >= mark)
    if not above.size:
        return float(np.inf)
    k = int(above[0])
    return float(step / 60 * (k - (soc[k] - mark) / (soc[k] - soc[k - 1]))) if k else 0.0
