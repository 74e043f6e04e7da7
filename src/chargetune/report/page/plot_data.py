"""What a page draws of one trial, as plain data for JSON: signals over time, and what theta means over SOC."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from chargetune.battery.charging.problem import ChargingProblem
from chargetune.episode.episode import Episode
from chargetune.report.figures.trajectories import curves, label_of
from chargetune.report.figures.tuned_curves import SOC, backoff_values, current_limit_values, resistance_values
from chargetune.report.study_view import ReadStudy, StudyView

__all__ = ["POINTS", "profiles", "rounded", "signals", "thin", "trial_drawing"]

# Points of one curve on a screen: more are not seen, and a hundred trials of a day each would not fit on a page.
POINTS = 1500
NEAR_V = (0.06, 0.08)


def trial_drawing(view: StudyView, reading: ReadStudy, points: int = POINTS) -> dict[str, Any]:
    """``panels`` over time and ``profiles`` over SOC of one trial; ``message`` says why there is no curve."""
    trial, episode = reading.trial, reading.episode
    return {
        "number": trial.number,
        "message": reading.message,
        "panels": [] if episode is None else signals(view.problem, episode, points),
        "profiles": profiles(view, np.array(trial.theta)),
        "theta": dict(zip(view.space.entries, trial.theta, strict=True)),
    }


def signals(problem: ChargingProblem | None, episode: Episode, points: int = POINTS) -> list[dict[str, Any]]:
    """One panel a signal: key, label with unit, limits, the range first shown (None: all of it), and the curve, or ``of`` whose it is.

    Of a charge: SOC, current, voltage, the voltage near its upper limit, temperature and anode potential where measured. Of
    another system: every input and output.
    """
    if problem is None or "soc" not in episode.output_names:
        return [_panel(*entry, points, time="time (s)") for entry in _everything(episode)]
    drawn = curves(episode)
    anode, highest = problem.limits.anode_min_V, problem.voltage_max_V
    limits: dict[str, list[float | None]] = {
        "current_A": [problem.current_max_A],
        "voltage_V": [problem.voltage_min_V, highest],
        "temperature_K": [problem.limits.temperature_max_K],
        "anode_potential_V": [None if anode is None else 1e3 * anode],
    }
    out = []
    for key, (x, y) in drawn.items():
        known = [value for value in limits.get(key, []) if value is not None]
        out.append(_panel(key, label_of(problem, key), x, y, points, limits=known))
        if key == "voltage_V":
            shown = [highest - NEAR_V[0], highest + NEAR_V[1]]
            near = _panel("near", label_of(problem, "near"), x[:0], y[:0], points, limits=[highest], shown=shown)
            out.append(near | {"of": key})
    return out


def profiles(view: StudyView, theta: NDArray[np.float64]) -> list[dict[str, Any]]:
    """What theta means over SOC in per cent: backoff in mV, current limit in A, resistances in milliohm; empty without a battery.

    Each with its nodes; ``beside`` is what it is held against: the plant's resistance.
    """
    problem, out = view.problem, []
    if problem is None:
        return []
    from scipy.interpolate import CubicSpline

    curves = problem.theta.curves
    slices, soc = view.space.slices, 100 * SOC[::2]
    if curves.backoff is not None:
        nodes = theta[slices["backoff_V"]]
        curve = 1e3 * backoff_values(curves.backoff, nodes)[::2]
        out.append(_profile("backoff", "backoff b (mV)", soc, curve, 100 * curves.backoff.grid, 1e3 * nodes))
    for of, part in curves.limit_backoffs.items():
        factor, unit = (1.0, "K") if of == "temperature" else (1e3, "mV")
        nodes, grid = factor * theta[slices[part.name(of)]], np.linspace(0.0, 1.0, part.nodes)
        spline = CubicSpline(grid, nodes, bc_type="natural")(SOC[::2]) if part.nodes > 1 else np.full(SOC[::2].size, nodes[0])
        out.append(_profile(part.name(of), f"{of} backoff ({unit})", soc, spline, 100 * grid, nodes))
    if curves.current_limit is not None:
        largest, grid = problem.current_max_A, curves.current_limit.grid
        nodes = theta[slices["current_limit"]]
        curve = current_limit_values(problem, nodes)[::2]
        out.append(_profile("current_limit", "current limit (A)", soc, curve, 100 * grid, largest * nodes))
    for of, ratio in curves.ratios.items():
        believed = np.array(getattr(problem.controller_cell, f"{of}_ohm"))
        nodes = 1e3 * believed * theta[slices[ratio.name(of)]]
        curve = 1e3 * resistance_values(problem.cell.soc, nodes / 1e3)[::2]
        entry = _profile(of, f"{of} (mΩ)", soc, curve, 100 * np.array(problem.cell.soc), nodes)
        plant = problem.plant_cell
        if plant is not None and len(true := getattr(plant, f"{of}_ohm")):
            entry |= {"beside": {"label": "plant", "x": rounded(soc), "y": rounded(1e3 * resistance_values(plant.soc, true)[::2])}}
        out.append(entry)
    return out


def thin(x: NDArray[np.float64], y: NDArray[np.float64], points: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """At most ``points`` points of a curve: first and last, and of each of equal stretches between the smallest and the largest.

    So a curve on the screen touches what the measurement touched. A value that is no number counts as neither.
    """
    if len(x) <= points:
        return x, y
    keep = {0, len(x) - 1}
    for stretch in np.array_split(np.arange(len(x)), max(1, (points - 2) // 2)):
        known = stretch[np.isfinite(y[stretch])]
        if known.size:
            keep |= {int(known[np.argmin(y[known])]), int(known[np.argmax(y[known])])}
    at = sorted(keep)
    return x[at], y[at]


def rounded(values: NDArray[np.float64], digits: int = 6) -> list[float | None]:
    """Numbers of ``digits`` significant digits, None for what is none: JSON knows no NaN."""
    return [float(f"{v:.{digits}g}") if np.isfinite(v) else None for v in values]


def _panel(
    key: str,
    label: str,
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    points: int,
    *,
    limits: list[float] | None = None,
    shown: list[float] | None = None,
    time: str = "time (min)",
) -> dict[str, Any]:
    few_x, few_y = thin(x, y, points)
    curve = {"x": rounded(few_x), "y": rounded(few_y)}
    return {"key": key, "of": key, "label": label, "time": time, "limits": limits or [], "shown": shown, **curve}


def _profile(
    key: str, label: str, x: NDArray[np.float64], y: NDArray[np.float64], at: NDArray[np.float64], nodes: NDArray[np.float64]
) -> dict[str, Any]:
    return {
        "key": key,
        "label": label,
        "x": rounded(x),
        "y": rounded(y, 5),
        "nodes_x": rounded(at),
        "nodes_y": rounded(nodes, 5),
    }


def _everything(episode: Episode) -> list[tuple[str, str, NDArray[np.float64], NDArray[np.float64]]]:
    ends = np.stack([episode.time_s, episode.time_s + episode.sampling_time_s], axis=1).ravel()
    out = [
        (name, f"{name} ({unit})", ends, np.repeat(episode.input[:, i], 2))
        for i, (name, unit) in enumerate(zip(episode.input_names, episode.input_units, strict=True))
    ]
    out += [
        (name, f"{name} ({unit})", ends, np.stack(episode.signal(name), axis=1).ravel())
        for name, unit in zip(episode.output_names, episode.output_units, strict=True)
    ]
    return out
