"""How a study came to its result: what each trial was worth, and how far it went beyond the limits."""

from __future__ import annotations

from collections.abc import Sequence
from textwrap import fill
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from chargetune.battery.charging.wording import LimitWords
from chargetune.episode.score import Score
from chargetune.report.best_possible import best_possible
from chargetune.report.figures.style import (
    BLUE,
    COLUMN_IN,
    GREEN,
    GREY,
    ORANGE,
    RED,
    journal_style,
    legend_above,
    letter,
    new_figure,
    plain_symlog,
)
from chargetune.report.study_view import StudyView
from chargetune.report.words import limits_of_study, objective_of_study
from chargetune.study.trial import Trial, TrialStatus

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["convergence_figure", "drawn_limits", "excess_unit", "incumbents", "linear_within", "loss", "worst_excess"]

# A trial without a value has its mark at the foot of the axis.
WITHOUT_VALUE = ((TrialStatus.FAILED, "failed", "x"), (TrialStatus.APART, "set apart", "|"))
# Labels as matplotlib sets them.
TYPESET = {"-G": "$-G$", "mean of (z_d - z)^2": "mean of $(z_d - z)^2$"}


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
    """The smallest loss up to each trial, among those within the limits (for "ei", whose G contains them, among all); NaN before.

    All are NaN where trials are not comparable (`StudyView.comparable`): the one that began fullest would be the best.
    """
    if not view.comparable:
        return np.full(len(view.trials), np.nan)
    counted = [t.score is not None and (view.tuner == "ei" or t.score.feasible) for t in view.trials]
    losses = [loss(view, t) if ok else np.nan for t, ok in zip(view.trials, counted, strict=True)]
    return np.asarray(np.fmin.accumulate(losses), dtype=float)


def convergence_figure(view: StudyView) -> Figure:
    """Upper panel: what each trial was worth, and the best so far. Below one panel a limit: its excess, logarithmic beyond 1 unit.

    The lower voltage limit, which a cell meets at rest, has a panel only where a trial broke it. The dotted line is the best that is
    possible on the plant, where that is known (`best_possible`).
    """
    with journal_style():
        from matplotlib.lines import Line2D
        from matplotlib.ticker import MaxNLocator

        limits, words = drawn_limits(view), objective_of_study(view)
        figure, (upper, *lowers) = new_figure(COLUMN_IN, 1.9 + 1.5 * max(1, len(limits)), 1 + max(1, len(limits)), 1, sharex=True)
        numbers = [t.number for t in view.trials]
        worth = [words.factor * loss(view, t) for t in view.trials]
        marks = _marks(view)
        for text, trials, style in marks:
            at = [t.number for t in trials]
            upper.plot(at, [words.factor * loss(view, t) for t in trials], label=text, linestyle="none", **style)
            for axis, limit in zip(lowers, limits, strict=False):
                axis.plot(at, [_excess(limit, t) for t in trials], label=text, linestyle="none", **style)
        foot = []
        for status, label, mark in WITHOUT_VALUE:
            at = [t.number for t in view.trials if t.status is status]
            if at:
                style = {"marker": mark, "color": "black", "markersize": 4, "linestyle": "none", "label": label}
                upper.plot(at, [0.04] * len(at), transform=upper.get_xaxis_transform(), **style)
                foot.append(Line2D([], [], **style))
        handles = [Line2D([], [], linestyle="none", label=text, **style) for text, trials, style in marks if trials]
        handles += foot
        best = words.factor * incumbents(view)
        if np.isfinite(best).any():
            handles += upper.plot(numbers, best, color=ORANGE, drawstyle="steps-post", label="best so far", zorder=2)
        possible = best_possible(view)
        if possible is not None and np.isfinite(worth).any():
            value = words.factor * possible
            handles.append(upper.axhline(value, color="black", linestyle=":", linewidth=1.0, label="best possible"))
            worth.append(value)
        if words.most is not None and np.nanmax([*worth, -np.inf]) > words.most:
            handles.append(upper.axhline(words.most, color=GREY, linestyle="-.", linewidth=0.8, label="above: not reached"))
        _scale(upper, worth)
        _limit_lines(lowers, limits, handles)
        for k, axis in enumerate(lowers):
            within = linear_within(view, limits[k]) if limits else 1.0
            plain_symlog(axis, within)
            low, high = axis.get_ylim()
            axis.set_ylim(min(-within, low), max(within, high))
        upper.xaxis.set_major_locator(MaxNLocator(integer=True))
        # Trial 0 and the last one stand within the axes with their marks.
        upper.set_xlim(min(numbers, default=0) - 0.6, max(numbers, default=0) + 0.6)
        if not any(trials for _, trials, _ in marks):
            upper.set_yticks([])
        upper.set_ylabel(fill(TYPESET.get(words.axis, words.axis), 24))
        for axis, limit in zip(lowers, limits, strict=False):
            axis.set_ylabel(fill(f"{limit.label}{f' ({limit.unit})' if limit.unit else ''}", 22))
        if not limits:
            lowers[0].set_ylabel("worst excess")
        for axis in (upper, *lowers):
            axis.tick_params(labelbottom=True)
        lowers[-1].set_xlabel("trial")
        letter([upper, *lowers])
        figure.align_ylabels()
        legend_above(figure, handles, columns=3)
    return figure


def drawn_limits(view: StudyView) -> list[LimitWords]:
    """The limits that have something to show: all but a lower voltage limit that no trial came near."""
    limits = limits_of_study(view)
    scores = [t.score for t in view.trials if t.score is not None]

    def met(limit: LimitWords) -> bool:
        broken = any(s.excess.get(limit.name, -np.inf) > s.tolerance.get(limit.name, 0.0) for s in scores)
        return limit.name == "voltage_min_V" and not broken

    return [limit for limit in limits if not met(limit)]


def _limit_lines(axes: Sequence[Axes], limits: Sequence[LimitWords], handles: list[Any]) -> None:
    lines = [axis.axhline(0.0, color=RED, linestyle=(0, (4, 2)), linewidth=0.9, label="limit") for axis in axes]
    allowed = [
        axis.axhline(limit.tolerance, color=RED, linestyle=":", linewidth=0.8, label="tolerance")
        for axis, limit in zip(axes, limits, strict=False)
        if limit.tolerance
    ]
    handles += [*lines[:1], *allowed[:1]]


def linear_within(view: StudyView, limit: LimitWords) -> float:
    """Within this on either side of the limit its axis is linear: 1, or where all excesses are smaller, a power of ten below."""
    told = [abs(_excess(limit, t)) for t in view.trials]
    largest = max((v for v in told if np.isfinite(v)), default=0.0)
    if largest >= 1.0 or largest == 0.0:
        return 1.0
    return float(10.0 ** np.ceil(np.log10(limit.tolerance or largest / 10)))


def _excess(limit: LimitWords, trial: Trial) -> float:
    return np.nan if trial.score is None else limit.factor * trial.score.excess.get(limit.name, np.nan)


def _scale(axis: Axes, values: Sequence[float]) -> None:
    positive = np.array(values)[np.isfinite(values)]
    # Below a decade a logarithmic axis says no more than a linear one, and its ticks are harder to read.
    if positive.size and np.all(positive > 0) and np.max(positive) > 10 * np.min(positive):
        axis.set_yscale("log")


def _marks(view: StudyView) -> list[tuple[str, list[Trial], dict[str, Any]]]:
    """Label, trials and marker of each kind; kinds differ in shape, not in colour alone."""
    scored = [t for t in view.trials if t.score is not None]
    kinds: list[tuple[str, list[Trial], dict[str, Any]]] = [
        ("within limits", [t for t in scored if t.feasible], {"marker": "o", "color": GREEN, "markersize": 3.5}),
        ("over a limit", [t for t in scored if not t.feasible], {"marker": "^", "color": RED, "markersize": 3.5, "fillstyle": "none"}),
    ]
    for label, trial, color, marker in ((view.start_label, view.start, BLUE, "s"), (view.tuned_label, view.tuned, ORANGE, "o")):
        if trial is not None and trial.score is not None:
            ring = {"marker": marker, "color": color, "markersize": 8, "fillstyle": "none", "markeredgewidth": 1.4}
            kinds.append((label, [trial], {**ring, "zorder": 4, "clip_on": False}))
    return kinds


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
