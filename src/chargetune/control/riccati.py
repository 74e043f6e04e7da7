"""What a Kalman filter knows in steady state: its gain and the spread of its predictions, from its Riccati recursion."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from chargetune.control.kalman import ExtendedKalman
from chargetune.model.model import Model, Named

__all__ = ["SteadyFilter", "steady_filter"]

# Measurements until a filter is called settled: a direction that cannot be seen grows for ever, and is not seen either.
STEPS = 400


@dataclass(frozen=True)
class SteadyFilter:
    """A (nx, nx) and C (ny, nx) of the model, gain K (nx, ny), prediction_sd (ny,) of the measured outputs without their noise."""

    transition: NDArray[np.float64]
    output: NDArray[np.float64]
    gain: NDArray[np.float64]
    prediction_sd: NDArray[np.float64]


def steady_filter(model: Model, estimator: ExtendedKalman, x: NDArray[np.float64], u: NDArray[np.float64]) -> SteadyFilter:
    """The filter that has settled at a constant state and input, its settings as ``model.nominal`` has them.

    P <- A (P - K C P) A' + Q,   K = P C' (C P C' + R)^-1,   prediction_sd = sqrt(diag(C P C'))
    """
    names = estimator.signals(model)
    state, push, p = (ca.SX.sym(n, k) for n, k in (("x", len(model.states)), ("u", len(model.inputs)), ("p", model.nominal.size)))
    given = Named(model.parameter_blocks, p), Named(dict.fromkeys(model.input_names, 1), push)
    y = model.h(state, push, p)
    seen = ca.vertcat(*(y[model.output_names.index(name)] for name in names))
    spreads = [ca.vertcat(*estimator.values(name, *given)) for name in ("start_sd", "process_sd", "measurement_sd")]
    parts = [ca.jacobian(model.f(state, push, p), state), ca.jacobian(seen, state), *spreads]
    evaluate = ca.Function("parts", [state, push, p], [ca.densify(part) for part in parts])
    a, c, start, process, noise = (np.array(part) for part in evaluate(x, u, model.nominal))
    covariance, added, noise = np.diag(start.ravel() ** 2), np.diag(process.ravel() ** 2), np.diag(noise.ravel() ** 2)
    gain: NDArray[np.float64] = np.zeros((len(model.states), len(names)))
    for _ in range(STEPS):
        gain = np.asarray(np.linalg.solve(c @ covariance @ c.T + noise, c @ covariance).T, dtype=np.float64)
        rest = np.eye(len(model.states)) - gain @ c
        covariance = a @ (rest @ covariance @ rest.T + gain @ noise @ gain.T) @ a.T + added
    return SteadyFilter(a, c, gain, np.sqrt(np.diag(c @ covariance @ c.T)))
