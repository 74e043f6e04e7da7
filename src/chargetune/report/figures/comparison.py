"""Ways of charging the same plant, side by side."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from chargetune.battery.baselines.comparison import FEEDBACK, Row
from chargetune.battery.charging.problem import ChargingProblem
from chargetune.report.figures.style import BLUE, GREEN, GREY, ORANGE, PAGE_IN, RED, cell_note, journal_style, letter, new_figure
from chargetune.report.figures.trajectories import curves, label_of, near_lower, panel_names

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["comparison_figure"]

COLOURS = {
    "plant oracle": GREEN,
    "nominal MPC": BLUE,
    FEEDBACK: "#8c564b",
    "tuned": ORANGE,
    "MPC with the true model": "#56B4E9",
    "best constant backoff": "#CC79A7",
}
DASHES = ("-", (0, (5, 1)), (0, (3, 1)), (0, (1, 1)), (0, (5, 1, 1, 1)), (0, (8, 2, 1, 2, 1, 2)))


def comparison_figure(problem: ChargingProblem, rows: Sequence[Row]) -> Figure:
    """SOC, current, voltage and every further limited signal over time; the red line is the limit."""
    names = [name for name in panel_names(problem) if name != "near"]
    if len(names) % 2:
        names.append("near")
    limits = {
        "current_A": problem.current_max_A,
        "voltage_V": problem.voltage_max_V,
        "near": problem.voltage_max_V,
        "temperature_K": problem.limits.temperature_max_K,
        "anode_potential_V": None if problem.limits.anode_min_V is None else 1e3 * problem.limits.anode_min_V,
    }
    with journal_style():
        count = (len(names) + 1) // 2
        figure, axes = new_figure(PAGE_IN, 2.1 * count + 0.5, count, 2, sharex=True)
        for axis in axes[len(names) :]:
            axis.set_axis_off()
        dashes, limit_line = iter(DASHES), None
        for row in rows:
            if not len(row.episode):
                continue
            drawn = curves(row.episode)
            own = row.name in COLOURS
            style: dict[str, Any] = (
                {"color": COLOURS[row.name], "linewidth": 2.6 if row.name == "plant oracle" else 1.3}
                if own
                else {"color": GREY, "linewidth": 0.8}
            )
            if not own:
                style["linestyle"] = next(dashes, "-")
            label = f"{row.name}{' (breaks a limit)' if row.breaks_limit else ''}"
            for name, axis in zip(names, axes, strict=False):
                signal = "voltage_V" if name == "near" else name
                if signal in drawn:
                    # The oracle is wide and below, for what lies on it is as good.
                    axis.plot(*drawn[signal], label=label, zorder=1 if row.name == "plant oracle" else 3 if own else 2, **style)
        for name, axis in zip(names, axes, strict=False):
            bound = limits.get(name)
            if bound is not None:
                limit_line = axis.axhline(bound, color=RED, linestyle=(0, (4, 2)), linewidth=0.9, zorder=4)
            axis.set_ylabel(label_of(problem, name))
            if name == "near":
                limit = problem.voltage_max_V
                axis.set_ylim(limit - 0.1, limit + 0.1)
            if name == "anode_potential_V" and bound is not None:
                near_lower(axis, bound)
        for axis in axes[max(len(names) - 2, 0) : len(names)]:
            axis.set_xlabel("time (min)")
            axis.tick_params(labelbottom=True)
        axes[0].set_xlim(0.0, problem.episode.steps * problem.controller.sampling_time_s / 60)
        letter(axes[: len(names)])
        for axis in axes[: len(names)]:
            axis.tick_params(labelbottom=True)
        handles, labels = axes[0].get_legend_handles_labels()
        if limit_line is not None:
            handles, labels = [*handles, limit_line], [*labels, "limit"]
        figure.legend(handles, labels, loc="outside upper center", ncols=3, columnspacing=1.1)
        figure.align_ylabels()
        cell_note(figure, problem.cell.title, problem.cell.remark)
    return figure
