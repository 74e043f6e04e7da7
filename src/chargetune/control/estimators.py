"""State estimators, written symbolically so that they run inside the compiled episode as well as step by step.

An estimator is asked twice in each control step. ``correct`` turns the prediction in its memory and the newest
measurement into the estimate the MPC starts from; ``predict`` moves it over the interval with the input that was
applied, using the controller's OWN model. Before the first measurement the memory holds the controller's start state.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from chargetune.model.model import Model

__all__ = ["Estimator", "ExactState", "Propagated", "finite"]


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
