"""What was learned: the voltage backoff and the resistances of the controller's model, over SOC."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from chargetune.battery.cell.cell import Cell
from chargetune.battery.cell.equivalent_circuit import FLOOR, table_nodes
from chargetune.battery.charging.problem import ChargingProblem
from chargetune.battery.charging.tunables import Backoff
from chargetune.report.figures.style import (
    BLUE,
    COLUMN_IN,
    GREEN,
    GREY,
    ORANGE,
    RED,
    cell_note,
    journal_style,
    legend_above,
    new_figure,
    words,
)
from chargetune.report.study_view import StudyView

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = [
    "SOC", "backoff_figure", "backoff_values", "current_limit_figure", "current_limit_values", "resistance_figure",
    "resistance_values", "violated_soc",
]  # fmt: skip

SOC = np.linspace(0.0, 1.0, 201)
# What the tuned curve is held against, in `_thetas`.
START = "start"


def backoff_values(backoff: Backoff, nodes_V: ArrayLike, soc: ArrayLike = SOC) -> NDArray[np.float64]:
    """b(z) in the unit of its node values: a natural cubic spline."""
    from scipy.interpolate import CubicSpline

    return np.asarray(CubicSpline(backoff.grid, np.asarray(nodes_V, dtype=float), bc_type="natural")(soc))


def resistance_values(own: tuple[float, ...], nodes_ohm: ArrayLike, soc: ArrayLike = SOC) -> NDArray[np.float64]:
    """R(z) in ohm of a circuit with these values at the SOC nodes ``own``: natural cubic spline, constant beyond, kept positive."""
    from scipy.interpolate import CubicSpline

    values = np.asarray(nodes_ohm, dtype=float)
    nodes = table_nodes(own)
    spline = CubicSpline(nodes, np.interp(nodes, own, values), bc_type="natural")(soc)
    return np.asarray((spline + np.hypot(spline, FLOOR * values.mean())) / 2)


def current_limit_values(problem: ChargingProblem, nodes: ArrayLike, soc: ArrayLike = SOC) -> NDArray[np.float64]:
    """The current limit in A with these node values, shares of the largest current: piecewise linear. Raises ValueError without one."""
    if problem.theta.current_limit is None:
        raise ValueError("current_limit is not part of this problem's theta")
    share = np.interp(np.asarray(soc, dtype=float), problem.theta.current_limit.grid, np.asarray(nodes, dtype=float))
    return np.asarray(problem.current_max_A * share, dtype=np.float64)


def violated_soc(view: StudyView) -> list[tuple[float, float]]:
    """The SOC ranges in which the start was above the upper voltage limit by more than the tolerance."""
    episode = view.episode(view.start)
    if episode is None or view.problem is None or view.problem.voltage_max_V is None:
        return []
    voltage, soc = np.stack(episode.signal("voltage_V")), np.stack(episode.signal("soc"))
    over = np.any(voltage > view.problem.voltage_max_V + view.problem.limits.tolerance_V, axis=0)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], over, [False]])))
    return [(float(soc[0, first]), float(soc[1, beyond - 1])) for first, beyond in edges.reshape(-1, 2)]


def backoff_figure(view: StudyView) -> Figure:
    """b(z) of all trials in mV, with the OCV beside it. Raises ValueError when theta has no backoff."""
    problem = view.problem
    if problem is None or problem.theta.backoff is None:
        raise ValueError(f"study {view.name!r} does not tune a backoff")
    cell, part = problem.cell, view.space.slices["backoff_V"]
    grid = problem.theta.backoff.grid
    with journal_style():
        from scipy.interpolate import PchipInterpolator

        figure, (axis,) = new_figure(COLUMN_IN, 2.7)
        nodes = {label: 1e3 * np.array(theta[part]) for label, theta in _thetas(view).items()}
        drawn = {label: backoff_values(problem.theta.backoff, values) for label, values in nodes.items()}
        handles = _grey(axis, [1e3 * backoff_values(problem.theta.backoff, t.theta[part]) for t in view.others])
        for label, color in ((START, BLUE), ("tuned", ORANGE)):
            if label in drawn:
                text, dashes = (view.tuned_label, view.tuned_dashes) if label == "tuned" else (view.start_label, "-")
                handles += axis.plot(100 * SOC, drawn[label], color=color, linestyle=dashes, label=text, zorder=3)
                axis.plot(100 * grid, nodes[label], "o", color=color, markersize=3.5, zorder=4, clip_on=False)
        if not np.ptp(list(drawn.values())):
            # b = 0 alone spans no range; that of the trials says what was tried.
            axis.set_ylim(1e3 * problem.theta.backoff.lower_V - 10, 1e3 * problem.theta.backoff.upper_V + 10)
        beside = axis.twinx()
        beside.spines["right"].set_visible(True)
        handles += beside.plot(100 * SOC, PchipInterpolator(cell.ocv_soc, cell.ocv_V)(SOC), color="black", linestyle=":", label="OCV")
        beside.set_ylabel("OCV (V)")
        axis.set_ylabel("backoff $b$ (mV)")
        _finish(figure, axis, view, problem.cell, handles)
    return figure


def resistance_figure(view: StudyView, of: str) -> Figure:
    """A resistance over SOC in milliohm: of plant, untuned and tuned controller. Raises ValueError when theta has none."""
    problem = view.problem
    ratio = None if problem is None else getattr(problem.theta, of, None)
    if problem is None or ratio is None:
        raise ValueError(f"study {view.name!r} does not tune {of}")
    part = view.space.slices[ratio.name(of)]
    believed = np.array(getattr(problem.controller_cell, f"{of}_ohm"))
    with journal_style():
        figure, (axis,) = new_figure(COLUMN_IN, 2.7)
        handles = _grey(axis, [1e3 * resistance_values(problem.cell.soc, believed * t.theta[part]) for t in view.others])
        nodes = {label: (problem.cell.soc, believed * theta[part]) for label, theta in _thetas(view).items()}
        plant = problem.plant_cell
        if plant is not None and len(true := getattr(plant, f"{of}_ohm")):
            nodes["plant"] = plant.soc, np.array(true)
        for label, color, marker in (("plant", GREEN, "s"), (START, BLUE, "o"), ("tuned", ORANGE, "o")):
            if label in nodes:
                text = {"tuned": view.tuned_label, START: view.start_label}.get(label, label)
                dashes = view.tuned_dashes if label == "tuned" else "-"
                own, ohms = nodes[label]
                values = 1e3 * resistance_values(own, ohms)
                handles += axis.plot(100 * SOC, values, color=color, linestyle=dashes, label=text, zorder=3)
                axis.plot(100 * np.array(own), 1e3 * ohms, marker, color=color, markersize=3.5, zorder=4)
        axis.set_ylim(bottom=0.0)
        axis.set_ylabel(f"${of[0]}_{of[1]}$ (mΩ)")
        _finish(figure, axis, view, problem.cell, handles)
    return figure


def current_limit_figure(view: StudyView) -> Figure:
    """The current limit over SOC in A of all trials. Raises ValueError when theta has none."""
    problem = view.problem
    if problem is None or problem.theta.current_limit is None:
        raise ValueError(f"study {view.name!r} does not tune a current limit")
    part, largest = view.space.slices["current_limit"], problem.current_max_A

    def values(theta: Any) -> NDArray[np.float64]:
        return current_limit_values(problem, np.array(theta[part]))

    with journal_style():
        figure, (axis,) = new_figure(COLUMN_IN, 2.7)
        handles = _grey(axis, [values(t.theta) for t in view.others])
        for label, theta in _thetas(view).items():
            color, text, dashes = (ORANGE, view.tuned_label, view.tuned_dashes) if label == "tuned" else (BLUE, view.start_label, "-")
            handles += axis.plot(100 * SOC, values(theta), color=color, linestyle=dashes, label=text, zorder=3)
        axis.set_ylim(0.0, 1.05 * largest)
        axis.set_ylabel("current limit (A)")
        _finish(figure, axis, view, problem.cell, handles)
    return figure


def _thetas(view: StudyView) -> dict[str, NDArray[np.float64]]:
    """theta of the start and of the tuned controller; without any trial the start is the untuned one."""
    start, tuned = view.start, view.tuned
    first = view.space.default if start is None else np.array(start.theta)
    return {START: first, **({} if tuned is None else {"tuned": np.array(tuned.theta)})}


def _grey(axis: Axes, rows: list[NDArray[np.float64]]) -> list[Any]:
    from matplotlib.collections import LineCollection
    from matplotlib.lines import Line2D

    lines = LineCollection([np.column_stack([100 * SOC, row]) for row in rows], colors=GREY, linewidths=0.4, alpha=0.5)
    axis.add_collection(lines, autolim=False)
    return [Line2D([], [], color=GREY, linewidth=0.8, label="trials")] if rows else []


def _finish(figure: Figure, axis: Axes, view: StudyView, cell: Cell, handles: list[Any]) -> None:
    if view.tuned is None:
        handles.append(words("tuned: none"))
    spans = [axis.axvspan(100 * low, 100 * high, color=RED, alpha=0.1, linewidth=0) for low, high in violated_soc(view)]
    if spans:
        spans[0].set_label(f"{view.start_label} over limit")
        handles.append(spans[0])
    axis.set_xlim(0.0, 100.0)
    axis.set_xlabel("SOC (%)")
    legend_above(figure, handles, columns=3)
    cell_note(figure, cell.name, view.remark)
