"""State estimators, written symbolically so that they run inside the compiled episode as well as step by step.

An estimator is asked twice in each control step. ``correct`` turns the prediction in its memory and the newest
measurement into the estimate the MPC starts from; ``predict`` moves it over the interval with the input that was
applied, using the controller's OWN model. Before the first measurement the memory holds the controller's start state.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from chargetune.model.model import Model, Named
from chargetune.runtime.split import split

__all__ = ["Estimator", "ExactState", "ExtendedKalman", "Propagated", "finite"]


def finite(value: Any) -> Any:
    """Whether a CasADi scalar is neither NaN nor infinite (x - x would be simplified to zero)."""
    return ca.fabs(value) <= np.finfo(float).max


class Estimator(Protocol):
    """x_hat from measured signals; ``y`` maps the names of `signals` to CasADi scalars."""

    def signals(self, model: Model) -> tuple[str, ...]:
        """Names of the plant's outputs that are read."""
        ...

    def initial(self, model: Model, state: NDArray[np.float64]) -> NDArray[np.float64]:
        """The memory before the first measurement."""
        ...

    def correct(self, model: Model, memory: Any, y: Mapping[str, Any], u: Any, p: Any) -> tuple[Any, Any]:
        """(x_hat, memory) from the measurement at the end of the interval in which u was applied."""
        ...

    def predict(self, model: Model, x_hat: Any, memory: Any, u: Any, p: Any) -> Any:
        """The memory at the end of the interval in which u is applied."""
        ...


@dataclass(frozen=True)
class ExactState:
    """Every state of the controller's model is measured: the plant has an output of the same name."""

    def signals(self, model: Model) -> tuple[str, ...]:
        return model.state_names

    def initial(self, model: Model, state: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.zeros(0)

    def correct(self, model: Model, memory: Any, y: Mapping[str, Any], u: Any, p: Any) -> tuple[Any, Any]:
        return ca.vertcat(*(y[name] for name in model.state_names)), memory

    def predict(self, model: Model, x_hat: Any, memory: Any, u: Any, p: Any) -> Any:
        return memory


@dataclass(frozen=True)
class Propagated:
    """The ``measured`` states are read from the plant, the others follow the controller's own model open loop.

    The case studies measure the state of charge (coulomb counting) and propagate the R-C overpotential. A measurement
    that is not finite is left out: the model's prediction stands in for it.
    """

    measured: tuple[str, ...] = ()

    def signals(self, model: Model) -> tuple[str, ...]:
        unknown = sorted(set(self.measured) - set(model.state_names))
        if unknown:
            raise ValueError(f"estimator: measured = {unknown}, allowed are {', '.join(model.state_names)}")
        return tuple(self.measured)

    def initial(self, model: Model, state: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.array(state, dtype=float)

    def correct(self, model: Model, memory: Any, y: Mapping[str, Any], u: Any, p: Any) -> tuple[Any, Any]:
        read = (ca.if_else(finite(y[n]), y[n], memory[i]) if n in self.measured else memory[i] for i, n in enumerate(model.state_names))
        return ca.vertcat(*read), memory

    def predict(self, model: Model, x_hat: Any, memory: Any, u: Any, p: Any) -> Any:
        return model.f(x_hat, u, p)


@dataclass(frozen=True)
class ExtendedKalman:
    """Extended Kalman filter on the ``measured`` outputs of the controller's model.

    With A = df/dx, C = dh/dx at the prediction, R = diag(measurement_sd^2), Q = diag(process_sd^2) per interval:
    K = P C' (C P C' + R)^-1, x_hat = x + K (y - h(x, u)), P = (I - K C) P, then x = f(x_hat, u), P = A P A' + Q.
    The measurement of index k is the output at the end of interval k - 1, so h is taken with the input applied there
    (zero before the first). ``measurement_sd`` should hold the model's error as well as the sensor's: in fast charging
    the model error dominates. An entry may be the name of a model parameter, which theta can set. A sample that is not
    finite is left out. Outputs are processed one by one, which is exact for a diagonal R.
    Source: Plett, Battery Management Systems, vol. 2, ch. 3; Simon, Optimal State Estimation, sec. 6.1 and 13.2.
    """

    measured: tuple[str, ...]
    measurement_sd: tuple[float | str, ...]
    process_sd: tuple[float, ...]
    start_sd: tuple[float, ...]

    def __post_init__(self) -> None:
        if len(self.measured) != len(self.measurement_sd) or not self.measured:
            raise ValueError(
                f"estimator: measurement_sd has {len(self.measurement_sd)} values, expected one for each of {list(self.measured)}"
            )
        for name, least in (("measurement_sd", 0.0), ("process_sd", 0.0), ("start_sd", 0.0)):
            values = [v for v in getattr(self, name) if not isinstance(v, str)]
            strict = name == "measurement_sd"
            if not all(math.isfinite(v) and (v > least if strict else v >= least) for v in values):
                raise ValueError(f"estimator: {name} = {list(values)}, allowed are finite numbers {'>' if strict else '>='} 0")

    def signals(self, model: Model) -> tuple[str, ...]:
        unknown = sorted(set(self.measured) - set(model.output_names))
        if unknown:
            raise ValueError(f"estimator: measured = {unknown}, allowed are {', '.join(model.output_names)}")
        named = [sd for sd in self.measurement_sd if isinstance(sd, str)]
        if any(model.parameter_blocks.get(sd) != 1 for sd in named):
            raise ValueError(f"estimator: measurement_sd names {named}, allowed are scalar parameters of model {model.name}")
        for name in ("process_sd", "start_sd"):
            if len(getattr(self, name)) != len(model.states):
                raise ValueError(
                    f"estimator: {name} has {len(getattr(self, name))} values, expected one for each of {list(model.state_names)}"
                )
        return self.measured

    def initial(self, model: Model, state: NDArray[np.float64]) -> NDArray[np.float64]:
        covariance = np.diag(np.square(self.start_sd))
        return np.concatenate([np.asarray(state, dtype=float), covariance.ravel(order="F")])

    def correct(self, model: Model, memory: Any, y: Mapping[str, Any], u: Any, p: Any) -> tuple[Any, Any]:
        nx = len(model.states)
        x, packed = split(memory, (nx, nx * nx))
        covariance = ca.reshape(packed, nx, nx)
        at = ca.SX.sym("at", nx)
        outputs = model.h(at, u, p)
        for name, sd in zip(self.measured, self.measurement_sd, strict=True):
            output = outputs[model.output_names.index(name)]
            row, value = ca.substitute([ca.jacobian(output, at), output], [at], [x])
            spread = ca.mtimes(covariance, row.T)
            usable = finite(y[name])
            noise = Named(model.parameter_blocks, p)[sd] if isinstance(sd, str) else sd
            gain = ca.if_else(usable, 1, 0) * spread / (ca.mtimes(row, spread) + noise**2)
            x = x + gain * ca.if_else(usable, y[name] - value, 0)
            covariance = covariance - ca.mtimes(gain, spread.T)
        covariance = (covariance + covariance.T) / 2
        return x, ca.vertcat(x, ca.vec(covariance))

    def predict(self, model: Model, x_hat: Any, memory: Any, u: Any, p: Any) -> Any:
        nx = len(model.states)
        _, packed = split(memory, (nx, nx * nx))
        covariance = ca.reshape(packed, nx, nx)
        at = ca.SX.sym("at", nx)
        (transition,) = ca.substitute([ca.jacobian(model.f(at, u, p), at)], [at], [x_hat])
        ahead = ca.mtimes([transition, covariance, transition.T]) + ca.DM(np.diag(np.square(self.process_sd)))
        return ca.vertcat(model.f(x_hat, u, p), ca.vec(ahead))
