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
    """Upper row: worst excess of each episode and limit. Lower row: time until a SOC is reached. Both over the share of the episodes.

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
    with journal_style():
        columns = 1 + len(conditions)
        figure, axes = new_figure(PAGE_IN, 4.2, 2, columns, sharex="col", sharey="row")
        upper, lower = axes[:columns], axes[columns:]
        handles: list[Any] = []
        for limit, values, bound, beyond, color in zip(limits, excess, bounds, over, (BLUE, ORANGE, GREEN), strict=False):
            label = f"{limit['name'].rpartition('_')[0].replace('_', ' ')} ({_unit(limit['name'])[1]})"
            handles += upper[0].plot(share, np.sort(values), color=color, label=label)
            dashes = [axis.axhline(bound, color=RED, linestyle=(0, (4, 2)), linewidth=0.9, label="tolerance") for axis in upper]
            for axis, (name, drawn) in zip(upper[1:], conditions.items(), strict=True):
                _points(axis, CONDITIONS[name][1] * drawn, values, beyond, color)
        handles.append(dashes[0])
        for mark, color in MARKS:
            times = np.array([_minutes(arrays, i, edges, mark, stated["sampling_time_s"]) for i in range(count)])
            handles += lower[0].plot(
                share, np.sort(np.where(np.isfinite(times), times, np.nan)), color=color, linestyle=":", label=_named(mark)
            )
            for axis, (name, drawn) in zip(lower[1:], conditions.items(), strict=True):
                _points(axis, CONDITIONS[name][1] * drawn, times, broken, color)
        handles += lower[0].plot([], [], "x", color=RED, markersize=3.5, label="violating")
        upper[0].set_ylabel("worst excess (negative: kept)")
        lower[0].set_ylabel("time (min)")
        for axis, label in zip(lower, ("episodes (%)", *(CONDITIONS[name][0] for name in conditions)), strict=True):
            axis.set_xlabel(label)
        letter(axes)
        figure.align_ylabels()
        legend_above(figure, handles)
        cell_note(
            figure,
            stated["cell"]["name"],
            f"{found['episodes']} fresh episodes, {found['violations']} violating, probability of a violation at most "
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
