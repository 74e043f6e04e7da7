"""The controller of a charging problem, and its limits row by row."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from chargetune.battery.cell.equivalent_circuit import ecm_model, overpotentials, start_state
from chargetune.battery.charging.kalman import Kalman
from chargetune.battery.charging.limits import HARD_FACTOR, Limit
from chargetune.battery.charging.observers import Adaptive, OffsetFree, observer_filter, observer_model, voltage_backoff
from chargetune.battery.charging.problem import ChargingProblem
from chargetune.control.controller import Controller, SoftLimit, Stage
from chargetune.control.estimators import Estimator, ExactState, Propagated
from chargetune.episode.episode import Episode
from chargetune.model.model import Model
from chargetune.runtime.cache import Built

__all__ = ["controller_model", "controller_of", "estimator_of", "measured_rows", "row_tolerances", "soft_limits"]

# A violation of a limit that is noticed, in its unit: the solver's tolerance is relative to it.
NOTICED = {"voltage": 0.1, "temperature": 1.0, "anode": 0.01}

_CONTROLLERS = Built(64)


def controller_of(problem: ChargingProblem) -> Controller:
    """The controller, built once for each content of what it depends on: plant, sensors and objective are not part of that."""
    key = (problem.cell, problem.controller, problem.estimator, problem.limits, problem.episode, problem.theta)
    return _CONTROLLERS.get(key, partial(_build, problem))


def _build(problem: ChargingProblem) -> Controller:
    settings, theta, largest, least = problem.controller, problem.theta, problem.current_max_A, problem.limits.current_min_A

    def cost(stage: Stage) -> Any:
        return (stage.x_d["soc"] - stage.x["soc"]) ** 2

    def stage_cost(stage: Stage) -> Any:
        return cost(stage) + (theta.rbf.cost(stage, problem.voltage_max_V) if theta.rbf else 0.0)

    def believed(stage: Stage) -> dict[str, Any]:
        changed = {f"{of}_ohm": stage.p[f"{of}_ohm"] * stage.theta[ratio.name(of)] for of, ratio in theta.ratios.items()}
        if theta.capacity:
            changed["capacity_Ah"] = stage.p["capacity_Ah"] * stage.theta["capacity_ratio"]
        return changed | {name: stage.theta[name] for name in theta.observed if name in stage.p}

    def most(stage: Stage) -> Any:
        bound = largest * theta.current_limit.share(stage) if theta.current_limit else largest
        if settings.current_ramp_A_s is None:
            return bound
        ramp = stage.theta["current_ramp_A_s"] if theta.current_ramp else settings.current_ramp_A_s
        return ca.fmin(bound, ca.fmax(stage.now["last_current_A"], 0.0) + ramp * settings.sampling_time_s)

    # Both models come from the same cell, so that the compiled problem is the same for every mismatch.
    belief = problem.controller_cell
    model = controller_model(problem, settings.sampling_time_s).with_parameters(**{name: getattr(belief, name) for name in belief.tables})
    return Controller.build(
        model,
        problem.base_space,
        horizon=settings.horizon,
        stage_cost=stage_cost,
        terminal_cost=cost,
        parameters=believed,
        input_lower={"current_A": least},
        input_upper={"current_A": most},
        limits=soft_limits(problem, model),
        fallback={"current_A": max(least, 0.0)},
        setpoint={"soc": problem.episode.soc_target},
        start=start_state(problem.cell, problem.episode.soc_start + problem.estimator.soc_start_error),
        estimator=estimator_of(problem, model),
        # Beside the costs' own Hessian little of the Lagrangian's is left, and changed as a whole it leaves 40 times fewer steps unsolved.
        hessian="gauss_newton" if theta.rbf else None,
    )


def controller_model(problem: ChargingProblem, sampling_time_s: float) -> Model:
    """The circuit as the controller has it, with what its filter needs; the numbers are the cell's."""
    observer, ramp = problem.estimator.settings, problem.controller.current_ramp_A_s is not None
    circuit = ecm_model(problem.cell, sampling_time_s, _filter_settings(problem), last_current=ramp)
    return observer_model(circuit, observer) if isinstance(observer, (OffsetFree, Adaptive)) else circuit


def _filter_settings(problem: ChargingProblem) -> dict[str, float]:
    """Parameters of the controller's circuit beside the cell's: the spread that its filter assumes, where theta changes it."""
    observer = problem.estimator.settings
    if isinstance(observer, Adaptive):
        return {"resistance_factor": 1.0}
    return {"voltage_sd_V": observer.voltage_sd_V} if isinstance(observer, Kalman) and problem.theta.voltage_sd else {}


def soft_limits(problem: ChargingProblem, model: Model) -> list[SoftLimit]:
    """The limits that the controller sees, upper and lower bound of the same output together; ``model`` is its own."""
    theta, observer = problem.theta, problem.estimator.settings
    margins: dict[str, Callable[[Stage], Any]] = {of: partial(part.margin, of) for of, part in theta.limit_backoffs.items()}
    if theta.backoff:
        margins["voltage"] = theta.backoff.voltage
    if isinstance(observer, (OffsetFree, Adaptive)):
        tuned, default = margins.get("voltage"), voltage_backoff(problem.cell, model, problem.current_max_A, observer)
        margins["voltage"] = lambda stage: default(stage.u, stage.p) + (tuned(stage) if tuned else 0.0)
    bounds: dict[str, dict[str, Any]] = {}
    for limit in problem.limits_by_name.values():
        what = limit.of
        if limit.kind == "scored":
            continue

        def bound(stage: Stage, limit: Limit = limit, what: str = what) -> Any:
            margin = margins[what](stage)
            return limit.bound - margin if limit.upper else limit.bound + margin

        # A backoff of the voltage belongs to its upper limit.
        simple = what not in margins or limit.name == "voltage_min_V"
        factor = HARD_FACTOR if limit.kind == "hard" else 1.0
        # One unit of any limit's noticed violation costs the same.
        penalty = factor * problem.controller.penalty_per_V * NOTICED["voltage"] / NOTICED[what]
        own = bounds.setdefault(limit.signal, {"at": "both", "scale": NOTICED[what], "penalty": penalty})
        own["penalty"] = max(own["penalty"], penalty)
        own["upper" if limit.upper else "lower"] = limit.bound if simple else bound
    return [SoftLimit(signal, **own) for signal, own in bounds.items()]


def estimator_of(problem: ChargingProblem, model: Model) -> Estimator:
    """The state estimator of the controller, whose model this is."""
    cell, observer = problem.cell, problem.estimator.settings
    thermal = ("temperature_K",) if cell.thermal else ()
    if isinstance(observer, Kalman):
        return observer.estimator(model, overpotentials(cell), thermal=bool(thermal), tuned=problem.theta.voltage_sd is not None)
    if observer is not None:
        return observer_filter(cell, model, observer)
    if problem.estimator.kind == "open_loop":
        return Propagated(("soc", *thermal))
    # The last current is the controller's own, and no output of the plant.
    own = tuple(name for name in model.state_names if name != "last_current_A")
    return ExactState() if own == model.state_names else Propagated(own)


def measured_rows(problem: ChargingProblem, episode: Episode) -> NDArray[np.float64]:
    """By how much the rows of the controller's limits were exceeded on the plant, backoff left out, shape (K, 2, rows)."""
    rows = _rows(problem)
    both = [np.stack(episode.signal(limit.signal), axis=1) for limit in rows]
    return np.stack(
        [values - limit.bound if limit.upper else limit.bound - values for limit, values in zip(rows, both, strict=True)], axis=2
    )


def row_tolerances(problem: ChargingProblem) -> NDArray[np.float64]:
    """The excess still called kept of each of these rows, shape (rows,)."""
    return np.array([limit.tolerance for limit in _rows(problem)])


def _rows(problem: ChargingProblem) -> list[Limit]:
    """Limits that the controller keeps, in the order of its own; of one signal the upper before the lower."""
    by_signal: dict[str, list[Limit]] = {}
    for limit in problem.limits_by_name.values():
        if limit.kind != "scored":
            by_signal.setdefault(limit.signal, []).append(limit)
    return [limit for group in by_signal.values() for limit in sorted(group, key=lambda one: not one.upper)]
