"""SOC, current and voltage of every trial over time."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from chargetune.battery.charging.problem import ChargingProblem
from chargetune.battery.charging.wording import objective_words
from chargetune.episode.episode import Episode
from chargetune.episode.score import Score
from chargetune.report.figures.style import (
    BLUE,
    GREY,
    ORANGE,
    PAGE_IN,
    RED,
    cell_note,
    journal_style,
    legend_above,
    letter,
    new_figure,
    words,
)
from chargetune.report.study_view import StudyView

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

__all__ = ["curves", "episode_figure", "label_of", "near_lower", "panel_names", "trajectories_figure"]

LABELS = {
    "soc": "SOC (%)",
    "current_A": "current (A)",
    "voltage_V": "voltage (V)",
    "near": "voltage near limit (V)",
    "temperature_K": "temperature (K)",
    "anode_potential_V": "anode potential (mV)",
}

# Of a pack these are of one of its cells.
EACH = ("current", "voltage")

Curve = tuple[NDArray[np.float64], NDArray[np.float64]]


def curves(episode: Episode) -> dict[str, Curve]:
    """(minutes, values) of SOC in per cent, current in A, voltage in V and where measured temperature in K and anode potential in mV.

    Current and voltage have two points an interval, at its start and at its end: both jump where the current does.
    """
    start, end = episode.signal("soc")
    step = episode.sampling_time_s
    ends = np.stack([episode.time_s, episode.time_s + step], axis=1).ravel() / 60
    current = episode.input[:, episode.input_names.index("current_A")]
    out = {
        "soc": (np.concatenate([episode.time_s[:1], episode.time_s + step]) / 60, 100 * np.concatenate([start[:1], end])),
        "current_A": (ends, np.repeat(current, 2)),
        "voltage_V": (ends, np.stack(episode.signal("voltage_V"), axis=1).ravel()),
    }
    further = {"temperature_K": 1.0, "anode_potential_V": 1e3}
    measured = {name: factor for name, factor in further.items() if name in episode.output_names}
    return out | {name: (ends, factor * np.stack(episode.signal(name), axis=1).ravel()) for name, factor in measured.items()}


def trajectories_figure(view: StudyView) -> Figure:
    """Panels over time: SOC, current, voltage, the voltage near its upper limit, and further limited signals.

    Raises ValueError without a charging problem.
    """
    if view.problem is None:
        raise ValueError(f"study {view.name!r} is not one of battery charging, there are no such trajectories")
    problem = view.problem
    with journal_style():
        from matplotlib.collections import LineCollection
        from matplotlib.lines import Line2D

        names = panel_names(problem)
        figure, axes = new_figure(PAGE_IN, 2.2 * ((len(names) + 1) // 2), (len(names) + 1) // 2, 2, sharex=True)
        panels = dict(zip(names, axes, strict=False))
        for axis in axes[len(names) :]:
            axis.set_axis_off()
        handles = []
        grey = [curves(episode) for _, episode in view.episodes(view.others)]
        for name, axis in panels.items():
            signal = "voltage_V" if name == "near" else name
            # Rasterised in vector files, where a hundred trials would be tens of thousands of segments.
            lines = LineCollection(
                [np.column_stack(c[signal]) for c in grey if signal in c], colors=GREY, linewidths=0.4, alpha=0.5, rasterized=True
            )
            # Snapped to pixels, the steps of a held current would come out dotted.
            lines.set_snap(False)
            axis.add_collection(lines)
        if grey:
            handles.append(Line2D([], [], color=GREY, linewidth=0.8, label="trials"))
        shown, tuned = [], view.tuned
        for label, trial, color in ((view.start_label, view.start, BLUE), (view.tuned_label, tuned, ORANGE)):
            episode = view.episode(trial)
            if trial is None or episode is None:
                continue
            drawn = curves(episode)
            shown.append(drawn["voltage_V"][1])
            text, dashes = (label, "-") if color == BLUE else (f"{label} (trial {trial.number})", view.tuned_dashes)
            for name, axis in panels.items():
                signal, width = ("voltage_V", 0.7) if name == "near" else (name, 1.2)
                if signal in drawn:
                    axis.plot(*drawn[signal], color=color, linewidth=width, linestyle=dashes, label=text, zorder=3)
            handles.append(panels["soc"].lines[-1])
        # A study that was written by an older version has the worst plant alone.
        spread = view.range_trace(tuned)
        for text, episode, dashes in (("median plant", spread.median, "--"), ("best plant", spread.best, ":")) if spread else ():
            drawn = curves(episode)
            for name, axis in panels.items():
                signal = "voltage_V" if name == "near" else name
                if signal in drawn:
                    axis.plot(*drawn[signal], color=ORANGE, linewidth=0.7, linestyle=dashes, label=text, zorder=2.5)
            handles.append(panels["soc"].lines[-1])
        if tuned is None:
            handles.append(words("tuned: none"))
        handles.append(_limits(panels, problem)[-1])
        _frame(figure, panels, problem, shown or [c["voltage_V"][1] for c in grey])
        letter(axes[: len(names)])
        legend_above(figure, handles)
        cell_note(figure, problem.cell.title, view.remark)
    return figure


def episode_figure(problem: ChargingProblem, episode: Episode, score: Score | None) -> Figure:
    """The same panels of one charge; the note below says what it was worth."""
    with journal_style():
        names = panel_names(problem)
        rows = (len(names) + 1) // 2
        figure, axes = new_figure(PAGE_IN, 2.2 * rows, rows, 2, sharex=True)
        panels = dict(zip(names, axes, strict=False))
        for axis in axes[len(names) :]:
            axis.set_axis_off()
        drawn = curves(episode)
        for name, axis in panels.items():
            signal = "voltage_V" if name == "near" else name
            if signal in drawn:
                axis.plot(*drawn[signal], color=BLUE, linewidth=0.7 if name == "near" else 1.2, label="this run", zorder=3)
        handles = [panels["soc"].lines[-1], _limits(panels, problem)[-1]]
        _frame(figure, panels, problem, [drawn["voltage_V"][1]])
        letter(axes[: len(names)])
        legend_above(figure, handles)
        parts = [problem.cell.remark] if problem.cell.remark else []
        if score is not None:
            words = objective_words(problem)
            parts.insert(
                0,
                f"{words.label}: {words.text(-score.objective)} {words.unit}".rstrip()
                + f", limits {'kept' if score.feasible else 'broken'}",
            )
        cell_note(figure, problem.cell.title, "; ".join(parts))
    return figure


def label_of(problem: ChargingProblem, name: str) -> str:
    """The label of a panel's axis; of a pack, whose numbers are those of one cell, it says so."""
    label = LABELS[name]
    return label.replace(" (", " per cell (") if problem.cell.pack_line and label.startswith(EACH) else label


def panel_names(problem: ChargingProblem) -> list[str]:
    """The panels of a charge: the same four always, and one for each further signal that is limited."""
    further = {"temperature_K": problem.limits.temperature_max_K, "anode_potential_V": problem.limits.anode_min_V}
    return ["soc", "current_A", "voltage_V", "near", *(name for name, limit in further.items() if limit is not None)]


def near_lower(axis: Axes, bound_mV: float) -> None:
    """The anode potential near its limit: at the start of a charge it is some 300 mV higher, and nothing would be seen of the rest."""
    low, high = axis.get_ylim()
    axis.set_ylim(min(low, bound_mV - 10.0), min(high, bound_mV + 100.0))


def _limits(panels: dict[str, Axes], problem: ChargingProblem) -> list[Line2D]:
    style: dict[str, Any] = {"color": RED, "linestyle": (0, (4, 2)), "linewidth": 0.9, "label": "limit", "zorder": 4}
    limits = {
        "current_A": problem.current_max_A,
        "voltage_V": problem.voltage_max_V,
        "near": problem.voltage_max_V,
        "temperature_K": problem.limits.temperature_max_K,
        "anode_potential_V": None if problem.limits.anode_min_V is None else 1e3 * problem.limits.anode_min_V,
    }
    return [panels[name].axhline(value, **style) for name, value in limits.items() if value is not None and name in panels]


def _frame(figure: Figure, panels: dict[str, Axes], problem: ChargingProblem, voltages: list[NDArray[np.float64]]) -> None:
    limit = problem.voltage_max_V
    peak = float(np.nanmax(np.concatenate(voltages))) if voltages else limit
    # Wild trials leave this panel: it is there to show the runs before and after tuning.
    margin = max(0.02, 1.25 * (peak - limit))
    panels["near"].set_ylim(limit - 0.8 * margin, limit + margin)
    if peak < limit - 0.8 * margin:
        said = f"at most {peak:.3f} V: nothing came near the limit"
        panels["near"].text(0.5, 0.3, said, transform=panels["near"].transAxes, ha="center", fontsize=7.5, color="0.35")
    for name, axis in panels.items():
        axis.set_ylabel(label_of(problem, name))
        if name != "near":
            axis.autoscale_view()
        if name == "anode_potential_V" and problem.limits.anode_min_V is not None:
            near_lower(axis, 1e3 * problem.limits.anode_min_V)
    for axis in panels.values():
        axis.tick_params(labelbottom=True)
    for axis in list(panels.values())[-2:]:
        axis.set_xlabel("time (min)")
    figure.align_ylabels()
    panels["soc"].set_xlim(0.0, problem.episode.steps * problem.controller.sampling_time_s / 60)
    panels["soc"].set_ylim(0.0, 105.0)
