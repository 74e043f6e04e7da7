"""What shows a finding of the formulation check: one figure each."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from chargetune.checks.finding import Evidence, Finding
from chargetune.report.figures.style import BLUE, COLUMN_IN, GREEN, ORANGE, RED, cell_note, journal_style, legend_above, new_figure, save

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["finding_figure", "save_findings"]

# An excess of less than this share of what the curves span would not be seen.
SMALL = 0.05


def finding_figure(finding: Finding) -> Figure:
    """The curves of a finding with its bounds, and its message below. Raises ValueError when it has none."""
    shown = finding.evidence
    if shown is None:
        raise ValueError(f"finding {finding.code} has no curves to draw")
    with journal_style():
        figure, (axis,) = new_figure(COLUMN_IN, 3.0)
        handles = []
        for (label, (x, y)), color, dashes in zip(shown.lines.items(), (BLUE, ORANGE, GREEN), ("-", "--", "-."), strict=False):
            # Dashed, a line that lies on another one lets it show through.
            handles += axis.plot(x, y, color=color, label=label, linestyle=dashes, marker="o" if len(x) <= 60 else None, markersize=2.5)
        for label, value in shown.bounds.items():
            handles.append(axis.axhline(value, color=RED, linestyle=(0, (4, 2)), linewidth=0.9, label=label))
        _zoom(axis, shown)
        axis.set_xlabel(shown.x_label)
        axis.set_ylabel(shown.y_label)
        legend_above(figure, handles, columns=3)
        cell_note(figure, finding.code, finding.message)
    return figure


def _zoom(axis: Axes, shown: Evidence) -> None:
    """Where curves go beyond a bound by a small part of what they span, that part is what is shown."""
    values = np.concatenate([np.asarray(y, dtype=float) for _, y in shown.lines.values()])
    values = values[np.isfinite(values)]
    if len(shown.bounds) != 1 or not values.size:
        return
    (bound,) = shown.bounds.values()
    beyond = float(np.max(values)) - bound
    if 0.0 < beyond < SMALL * np.ptp(values):
        axis.set_ylim(bound - 4 * beyond, bound + 1.5 * beyond)
        axis.set_title("part of the axis: what is beyond the bound", fontsize=7, color="0.35")


def save_findings(findings: Sequence[Finding], folder: str | os.PathLike[str]) -> list[Path]:
    """One PNG for each finding that has curves, in ``folder``, which is made; gives the files written."""
    target = Path(folder)
    target.mkdir(parents=True, exist_ok=True)
    drawn = [(i, finding) for i, finding in enumerate(findings, start=1) if finding.evidence is not None]
    return [save(finding_figure(finding), target / f"{i}-{finding.code}.png") for i, finding in drawn]
