"""What shows a finding of the formulation check: one figure each."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from chargetune.checks.finding import Finding
from chargetune.report.figures.style import BLUE, COLUMN_IN, GREEN, ORANGE, RED, cell_note, journal_style, legend_above, new_figure, save

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["finding_figure", "save_findings"]


def finding_figure(finding: Finding) -> Figure:
    """The curves of a finding with its bounds, and its message below. Raises ValueError when it has none."""
    shown = finding.evidence
    if shown is None:
        raise ValueError(f"finding {finding.code} has no curves to draw")
    with journal_style():
        figure, (axis,) = new_figure(COLUMN_IN, 3.0)
        handles = []
        for (label, (x, y)), color in zip(shown.lines.items(), (BLUE, ORANGE, GREEN), strict=False):
            handles += axis.plot(x, y, color=color, label=label, marker="o" if len(x) <= 60 else None, markersize=2.5)
        for label, value in shown.bounds.items():
            handles.append(axis.axhline(value, color=RED, linestyle=(0, (4, 2)), linewidth=0.9, label=label))
        axis.set_xlabel(shown.x_label)
        axis.set_ylabel(shown.y_label)
        legend_above(figure, handles, columns=3)
        cell_note(figure, finding.code, finding.message)
    return figure


def save_findings(findings: Sequence[Finding], folder: str | os.PathLike[str]) -> list[Path]:
    """One PNG for each finding that has curves, in ``folder``, which is made; gives the files written."""
    target = Path(folder)
    target.mkdir(parents=True, exist_ok=True)
    drawn = [(i, finding) for i, finding in enumerate(findings, start=1) if finding.evidence is not None]
    return [save(finding_figure(finding), target / f"{i}-{finding.code}.png") for i, finding in drawn]
