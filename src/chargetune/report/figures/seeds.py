"""One case study over many mismatch seeds: untuned and tuned, seed by seed."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from chargetune.report.figures.style import (
    BLUE,
    COLUMN_IN,
    GREY,
    ORANGE,
    PAGE_IN,
    RED,
    journal_style,
    legend_above,
    letter,
    new_figure,
    plain_symlog,
    save,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["draw_seeds", "seeds_figure"]

PANELS = (("overshoot_mV", "overshoot (mV)"), ("t95_min", "time to 95 %\nSOC (min)"))
# More seeds than this need the width of a page.
COLUMN_SEEDS = 12


def seeds_figure(rows: Sequence[Mapping[str, Any]], path: str | os.PathLike[str]) -> Path:
    """Write the figure of `draw_seeds` to ``path``, whose ending says the format: png, pdf or svg. Raises ValueError."""
    return save(draw_seeds(rows), path)


def draw_seeds(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """Worst overshoot and t95 of every seed, untuned and tuned, with their medians.

    Each row has ``seed``, ``untuned`` and ``tuned`` (both with overshoot_mV and t95_min, None where SOC 95 % was not reached;
    ``tuned`` None where no trial qualified) and may have ``attainable_t95_min``. Raises ValueError for no rows.
    """
    if not rows:
        raise ValueError("rows: empty, allowed is at least one seed")
    with journal_style():
        from matplotlib.lines import Line2D

        figure, axes = new_figure(COLUMN_IN if len(rows) <= COLUMN_SEEDS else PAGE_IN, 3.6, 2, 1, sharex=True)
        positions = np.arange(len(rows))
        plain_symlog(axes[0])
        for axis, (key, label) in zip(axes, PANELS, strict=True):
            _panel(axis, rows, key)
            axis.set_ylabel(label)
        axes[0].axhline(0.0, color=RED, linestyle=(0, (4, 2)), linewidth=0.9, label="limit")
        handles = [
            Line2D([], [], linestyle="none", marker="o", color=BLUE, markersize=4, label="untuned"),
            Line2D([], [], linestyle="none", marker="D", color=ORANGE, markersize=4, label="tuned"),
            Line2D([], [], color="0.3", linewidth=0.9, linestyle=":", label="median"),
            Line2D([], [], color=RED, linestyle=(0, (4, 2)), linewidth=0.9, label="limit"),
        ]
        if any(label.endswith("no value") for axis in axes for label in axis.get_legend_handles_labels()[1]):
            handles.append(Line2D([], [], linestyle="none", marker="x", color="0.3", markersize=4, label="no value"))
        known = [row.get("attainable_t95_min") for row in rows]
        if any(v is not None for v in known):
            axes[1].plot(positions, _numbers(known), "_", color="black", markersize=8, label="attainable")
            handles.append(Line2D([], [], linestyle="none", marker="_", color="black", markersize=8, label="attainable"))
        every = max(1, -(-len(rows) // 40))
        axes[1].set_xticks(positions[::every], [str(row["seed"]) for row in rows][::every])
        axes[1].set_xlim(-0.7, len(rows) - 0.3)
        axes[1].set_xlabel("mismatch seed")
        figure.align_ylabels()
        letter(axes)
        legend_above(figure, handles, columns=3 if len(rows) <= COLUMN_SEEDS else None)
    return figure


def _panel(axis: Axes, rows: Sequence[Mapping[str, Any]], key: str) -> None:
    positions = np.arange(len(rows))
    values = {name: _numbers([(row[name] or {}).get(key) for row in rows]) for name in ("untuned", "tuned")}
    both = np.isfinite(values["untuned"]) & np.isfinite(values["tuned"])
    axis.vlines(positions[both], values["untuned"][both], values["tuned"][both], color=GREY, linewidth=0.8, zorder=1)
    for name, color, marker, aside in (("untuned", BLUE, "o", -0.15), ("tuned", ORANGE, "D", 0.15)):
        axis.plot(positions, values[name], marker, color=color, markersize=4, label=name, zorder=3)
        median = _median(rows, name, values[name])
        if np.isfinite(median):
            axis.axhline(median, color=color, linewidth=0.9, linestyle=":", label=f"median {name}", zorder=2)
        without = positions[np.isnan(values[name])]
        if without.size:
            cross: dict[str, Any] = {"color": color, "markersize": 4, "clip_on": False, "label": f"{name}: no value"}
            axis.plot(without + aside, [0.97] * without.size, "x", transform=axis.get_xaxis_transform(), **cross)


def _numbers(values: Sequence[float | None]) -> NDArray[np.float64]:
    return np.array([np.nan if v is None else v for v in values], dtype=float)


def _median(rows: Sequence[Mapping[str, Any]], name: str, values: NDArray[np.float64]) -> float:
    """Over the seeds that have a result; one that never reaches the SOC took longer than any that does."""
    there = np.array([row[name] is not None for row in rows])
    return float(np.median(np.where(np.isnan(values), np.inf, values)[there])) if there.any() else np.nan
