"""Whether the measurements of a nominal episode tell apart what the controller's Kalman filter estimates."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from chargetune.checks.finding import Evidence, Finding
from chargetune.control.controller import Controller
from chargetune.control.kalman import ExtendedKalman
from chargetune.episode.episode import Episode
from chargetune.model.detectability import GROWTH, Unseen, unseen
from chargetune.model.model import Named

__all__ = ["check_detectability"]


def check_detectability(
    controller: Controller, run: Episode, given: NDArray[np.float64] | None = None, along: str | None = None
) -> list[Finding]:
    """States of the filter's model that the measured outputs cannot tell apart along the closed loop ``run`` on a perfect model.

    The rank test of Pannocchia and Rawlings along the episode (`model.detectability`), each state in units of what is unknown of it, the
    filter's start and process standard deviations over the episode, each measurement in units of its own. What the filter does not
    doubt is known. ``given`` (K, signals): the controller's given signals; ``along``: the name of a state that tells the place.
    """
    estimator = controller.estimator
    if not isinstance(estimator, ExtendedKalman) or run.state is None:
        return []
    model, count = controller.model, len(run)
    signals = np.zeros((count, len(controller.given))) if given is None else given
    values = controller.theta_vector(None)
    p = np.array([np.array(controller.parameters(values, model.nominal, one)).ravel() for one in signals]).reshape(count, -1)
    spread, noise = _unknown(controller, estimator, run.state[:-1], run.input, p)
    # Outside of the model's domain nothing is known of it: what is looked at ends there.
    known = np.isfinite(run.state[:-1]).all(axis=1) & np.isfinite(spread[1:]).all(axis=1)
    count = count if known.all() else int(np.argmin(known))
    if not count:
        return []
    names, largest = model.state_names, np.minimum(np.max(spread[: count + 1], axis=0), GROWTH)
    doubted = {name: float(size) for name, size in zip(names, largest, strict=True) if size > 0}
    sure = [name for name in names if name not in doubted]
    x, u, p = run.state[:count], run.input[:count], p[:count]
    found = unseen(model, estimator.measured, x, u, known=sure, scale=doubted, noise=noise, parameters=p)
    steady = unseen(model, estimator.measured, x[-1], u[-1], known=sure, scale=doubted, parameters=p[-1])
    minutes = run.time_s[:count] / 60
    place = f"in the whole episode of {minutes[-1]:.3g} min"
    if along in names:
        place += f" ({along} {x[0, names.index(along)]:.3g} to {x[-1, names.index(along)]:.3g})"
    return [_finding(group, estimator.measured, place, minutes, doubted, steady) for group in found]


def _finding(
    group: Unseen,
    measured: tuple[str, ...],
    place: str,
    minutes: NDArray[np.float64],
    doubted: Mapping[str, float],
    steady: Sequence[Unseen],
) -> Finding:
    several, alike = len(group.states) > 1, ", ".join(group.states)
    neither = ", nor in steady state at its end" if any(set(one.states) & set(group.states) for one in steady) else ""
    return Finding(
        "observer-undetectable",
        "warning",
        f"{alike} cannot be {'told apart' if several else 'seen'} from {', '.join(measured)} {place}{neither}: an error as large as the "
        f"filter thinks possible moves all samples together by {group.seen[-1]:.2g} of their standard deviations",
        f"one more measurement, or start and process standard deviations of 0 for {' or '.join(group.states)}; in steady state each "
        "measured output shows at most one disturbance",
        {"seen_sd": float(group.seen[-1]), "minutes": float(minutes[-1])} | {f"unknown_{name}": doubted[name] for name in group.states},
        Evidence("time (min)", "moved so far (standard deviations)", {alike: (minutes, group.seen)}, {"one of them": 1.0}),
    )


def _unknown(
    controller: Controller, estimator: ExtendedKalman, states: NDArray[np.float64], inputs: NDArray[np.float64], p: NDArray[np.float64]
) -> tuple[NDArray[np.float64], dict[str, float]]:
    """What is unknown of each state without a measurement, sd (K + 1, nx), and the smallest sd of each measured output."""
    model, names = controller.model, estimator.signals(controller.model)
    x, u, q = (ca.SX.sym(n, k) for n, k in (("x", len(model.states)), ("u", len(model.inputs)), ("p", model.nominal.size)))
    named = Named(model.parameter_blocks, q), Named(dict.fromkeys(model.input_names, 1), u)
    sds = [ca.vertcat(*estimator.values(name, *named)) for name in ("start_sd", "process_sd", "measurement_sd")]
    parts = ca.Function("parts", [x, u, q], [ca.densify(part) for part in (ca.jacobian(model.f(x, u, q), x), *sds)])
    covariance: NDArray[np.float64] | None = None
    spread, noise = [], []
    with np.errstate(all="ignore"):
        for at in zip(states, inputs, p, strict=True):
            a, start, process, measurement = (np.array(part) for part in parts(*at))
            if covariance is None:
                covariance = np.diag(start.ravel() ** 2)
                spread.append(np.sqrt(np.diag(covariance)))
            covariance = a @ covariance @ a.T + np.diag(process.ravel() ** 2)
            spread.append(np.sqrt(np.diag(covariance)))
            noise.append(measurement.ravel())
    return np.array(spread), dict(zip(names, np.min(noise, axis=0), strict=True))
