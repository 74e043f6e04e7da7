"""How a study came to its result: what each trial was worth, and how far it went beyond the limits."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from chargetune.episode.score import Score
from chargetune.report.figures.style import (
    BLUE,
    COLUMN_IN,
    GREEN,
    ORANGE,
    RED,
    journal_style,
    legend_above,
    letter,
    new_figure,
    plain_symlog,
)
from chargetune.report.study_view import StudyView
from chargetune.study.trial import Trial, TrialStatus

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["convergence_figure", "excess_unit", "incumbents", "loss", "loss_label", "worst_excess"]

# Labels of the loss as matplotlib sets them.
TYPESET = {"-G": "$-G$", "-objective": "−objective", "mean of (z_d - z)²": "mean of $(z_d - z)^2$"}


def loss(view: StudyView, trial: Trial) -> float:
    """What the tuner makes small: -objective, for the tuner "ei" -G; NaN without a score."""
    if trial.score is None:
        return np.nan
    return -(trial.score.performance if view.tuner == "ei" else trial.score.objective)


def worst_excess(view: StudyView, score: Score | None) -> float:
    """The largest excess over all limits, in what `excess_unit` is a factor to; NaN without a score or a limit."""
    if score is None or not score.excess:
        return np.nan
    return max(score.excess.values()) if _alike(view) else score.worst


def incumbents(view: StudyView) -> NDArray[np.float64]:
    """The smallest loss up to each trial, among those within the limits (for "ei", whose G contains them, among all); NaN before."""
    counted = [t.score is not None and (view.tuner == "ei" or t.score.feasible) for t in view.trials]
    losses = [loss(view, t) if ok else np.nan for t, ok in zip(view.trials, counted, strict=True)]
    return np.asarray(np.fmin.accumulate(losses), dtype=float)


def convergence_figure(view: StudyView) -> Figure:
    """Upper panel: loss of each trial and the incumbent. Lower panel: worst excess, logarithmic beyond 1 unit of its axis."""
    with journal_style():
        from matplotlib.lines import Line2D
        from matplotlib.ticker import MaxNLocator

        figure, (upper, lower) = new_figure(COLUMN_IN, 3.6, 2, 1, sharex=True)
        numbers = [t.number for t in view.trials]
        label, scale = excess_unit(view)
        _scales(upper, lower, [loss(view, t) for t in view.trials])
        marks = _marks(view)
        for text, trials, style in marks:
            at = [t.number for t in trials]
            upper.plot(at, [loss(view, t) for t in trials], label=text, linestyle="none", **style)
            lower.plot(at, [scale * worst_excess(view, t.score) for t in trials], label=text, linestyle="none", **style)
        failed = [t.number for t in view.trials if t.status is TrialStatus.FAILED]
        if failed:
            # A failed trial has no value, so its mark stands at the foot of the axis.
            upper.plot(
                failed, [0.04] * len(failed), "x", color="black", markersize=4, transform=upper.get_xaxis_transform(), label="failed"
            )
        handles = [Line2D([], [], linestyle="none", label=text, **style) for text, trials, style in marks if trials]
        if failed:
            handles.append(Line2D([], [], linestyle="none", marker="x", color="black", markersize=4, label="failed"))
        best = incumbents(view)
        if np.isfinite(best).any():
            handles += upper.plot(numbers, best, color=ORANGE, drawstyle="steps-post", label="best so far", zorder=2)
        handles.append(lower.axhline(0.0, color=RED, linestyle=(0, (4, 2)), linewidth=0.9, label="limit"))
        allowed = {v for t in view.trials if t.score is not None for v in t.score.tolerance.values()}
        if _alike(view) and len(allowed) == 1 and allowed != {0.0}:
            handles.append(lower.axhline(scale * allowed.pop(), color=RED, linestyle=":", linewidth=0.8, label="tolerance"))
        low, high = lower.get_ylim()
        lower.set_ylim(min(-1.0, low), max(1.0, high))
        lower.xaxis.set_major_locator(MaxNLocator(integer=True))
        if not any(trials for _, trials, _ in marks):
            upper.set_yticks([])
        loss_name = loss_label(view)
        upper.set_ylabel(TYPESET.get(loss_name, loss_name))
        lower.set_ylabel(f"worst excess ({label})")
        lower.set_xlabel("trial")
        letter([upper, lower])
        figure.align_ylabels()
        legend_above(figure, handles, columns=4 if len(handles) > 6 else 3)
    return figure


def _scales(upper: Axes, lower: Axes, losses: list[float]) -> None:
    positive = np.array(losses)[np.isfinite(losses)]
    # Below a decade a logarithmic axis says no more than a linear one, and its ticks are harder to read.
    if positive.size and np.all(positive > 0) and np.max(positive) > 10 * np.min(positive):
        upper.set_yscale("log")
    plain_symlog(lower)


def _marks(view: StudyView) -> list[tuple[str, list[Trial], dict[str, Any]]]:
    """Label, trials and marker of each kind; kinds differ in shape, not in colour alone."""
    scored = [t for t in view.trials if t.score is not None]
    kinds: list[tuple[str, list[Trial], dict[str, Any]]] = [
        ("within limits", [t for t in scored if t.feasible], {"marker": "o", "color": GREEN, "markersize": 3.5}),
        ("violating", [t for t in scored if not t.feasible], {"marker": "^", "color": RED, "markersize": 3.5, "fillstyle": "none"}),
    ]
    for label, trial, color, marker in (("untuned", view.untuned, BLUE, "s"), (view.tuned_label, view.tuned, ORANGE, "o")):
        if trial is not None and trial.score is not None:
            ring = {"marker": marker, "color": color, "markersize": 8, "fillstyle": "none", "markeredgewidth": 1.4}
            kinds.append((label, [trial], {**ring, "zorder": 4, "clip_on": False}))
    return kinds


def loss_label(view: StudyView) -> str:
    """What `loss` is of this study, in plain text."""
    if view.tuner == "ei":
        return "-G"
    if view.problem is None:
        return "-objective"
    mark = view.problem.objective.charge_time_to_soc
    return "mean of (z_d - z)²" if mark is None else f"time to {mark:.3g} SOC / duration"


def excess_unit(view: StudyView) -> tuple[str, float]:
    """Unit of the worst excess and the factor to it: millivolts when every limit is a voltage, with the same tolerance.

    The unit of the limit where there is one. Else limits are compared as `Score.worst` does, in tolerances beyond the tolerance.
    """
    limits = _limits(view)
    if not _alike(view):
        return "tolerances, kept below 0", 1.0
    if (limits or view.problem is not None) and all(name.endswith("_V") for name in limits):
        return "mV", 1e3
    return "unit of the limit", 1.0


def _limits(view: StudyView) -> set[str]:
    return {name for t in view.trials if t.score is not None for name in t.score.excess}


def _alike(view: StudyView) -> bool:
    """Whether excesses of all limits may be compared as they are: one limit, or voltages of one tolerance."""
    limits = _limits(view)
    allowed = {t.score.tolerance.get(name, 0.0) for t in view.trials if t.score is not None for name in t.score.excess}
    return len(limits) <= 1 or (len(allowed) == 1 and all(name.endswith("_V") for name in limits))
