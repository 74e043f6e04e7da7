"""The figures of one study, by name, and their files."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from chargetune.report.figures.convergence import convergence_figure
from chargetune.report.figures.style import FORMATS, save
from chargetune.report.figures.trajectories import trajectories_figure
from chargetune.report.figures.tuned_curves import backoff_figure, current_limit_figure, resistance_figure
from chargetune.report.study_view import StudyView, read_study

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["figure_names", "figures_of", "save_figures"]


def _drawings(view: StudyView) -> dict[str, Callable[[StudyView], Figure]]:
    drawings: dict[str, Callable[[StudyView], Figure]] = {}
    if view.problem is not None:
        if any(t.trace_sha256 is not None for t in view.trials):
            drawings["trajectories"] = trajectories_figure
        curves = view.problem.theta.curves
        if curves.backoff is not None:
            drawings["backoff"] = backoff_figure
        if curves.current_limit is not None:
            drawings["current_limit"] = current_limit_figure
        drawings |= {of: partial(resistance_figure, of=of) for of in curves.ratios}
    return {**drawings, "convergence": convergence_figure}


def figure_names(view: StudyView) -> list[str]:
    """Names of what can be drawn of a study, before anything is drawn."""
    return list(_drawings(view))


def figures_of(view: StudyView) -> dict[str, Figure]:
    """What can be drawn of a study: convergence always; of a charging study the trajectories, and what theta consists of."""
    return {name: draw(view) for name, draw in _drawings(view).items()}


def save_figures(
    store: str | os.PathLike[str],
    name: str,
    folder: str | os.PathLike[str],
    formats: Sequence[str] = ("png",),
    *,
    trials: int | None = None,
) -> list[Path]:
    """Draw the study ``name`` (its first ``trials`` trials) from its store into ``folder``, which is made; gives the files written.

    Formats are "png" (300 dpi), "pdf" and "svg" (vectors, at the width of a journal's column or page).
    Raises StoreError for a file that is no store and for an unknown study, ValueError for an unknown format or trial, or no trials.
    """
    unknown = [f for f in formats if f not in FORMATS]
    if unknown or not formats or isinstance(formats, str):
        raise ValueError(f"formats = {formats!r}, allowed is a non-empty selection of {', '.join(FORMATS)}")
    view = read_study(store, name, trials=trials)
    target = Path(folder)
    target.mkdir(parents=True, exist_ok=True)
    return [save(figure, target / f"{stem}.{kind}") for stem, figure in figures_of(view).items() for kind in formats]
