"""What of a charging controller can be tuned: the parts of theta, each with its bounds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from chargetune.battery.validation import check_count, check_number
from chargetune.control.controller import Stage
from chargetune.model.parameter_space import Parameter
from chargetune.model.splines import natural_spline, piecewise_linear

__all__ = ["Backoff", "CurrentLimit", "LimitBackoff", "MeasurementSpread", "ResistanceRatio"]


@dataclass(frozen=True)
class Backoff:
    """theta in the set Y: the controller keeps V <= v_max - b(z), b a natural cubic spline on equidistant SOC nodes.

    ``at="measured"`` takes b at the measured z_k for the whole horizon (the paper's text), ``"predicted"`` at each z_i.
    A signed backoff (lower < 0) lets the controller also correct a model that is too pessimistic.
    """

    nodes: int = 7
    lower_V: float = -0.25
    upper_V: float = 0.25
    at: Literal["measured", "predicted"] = "measured"

    def __post_init__(self) -> None:
        check_count("backoff: nodes", self.nodes, 2, 50)
        check_number("backoff: lower_V", self.lower_V, -1.0, 0.0, "V")
        check_number("backoff: upper_V", self.upper_V, 0.0, 1.0, "V", open_low=True)
        if self.at not in ("measured", "predicted"):
            raise ValueError(f"backoff: at = {self.at!r}, allowed is 'measured' or 'predicted'")

    @property
    def grid(self) -> NDArray[np.float64]:
        return np.linspace(0.0, 1.0, self.nodes)

    @property
    def parameter(self) -> Parameter:
        return Parameter("backoff_V", self.lower_V, self.upper_V, 0.0, unit="V", size=self.nodes)

    def voltage(self, stage: Stage) -> Any:
        z = stage.now["soc"] if self.at == "measured" else stage.x["soc"]
        return natural_spline(z, self.grid, stage.theta["backoff_V"])


@dataclass(frozen=True)
class LimitBackoff:
    """theta in the sets X, Y: the controller keeps another limit by a margin b, T <= T_max - b or anode >= minimum + b.

    One node is a constant margin; more are a natural cubic spline over the measured SOC. Signed like `Backoff`.
    """

    of: Literal["temperature", "anode"]
    lower: float
    upper: float
    nodes: int = 1

    def __post_init__(self) -> None:
        if self.of not in ("temperature", "anode"):
            raise ValueError(f"limit backoff: of = {self.of!r}, allowed is 'temperature' or 'anode'")
        widest, unit = (50.0, "K") if self.of == "temperature" else (0.5, "V")
        check_number(f"{self.of} backoff: lower", self.lower, -widest, 0.0, unit)
        check_number(f"{self.of} backoff: upper", self.upper, 0.0, widest, unit, open_low=True)
        check_count(f"{self.of} backoff: nodes", self.nodes, 1, 50)

    @property
    def name(self) -> str:
        return f"{self.of}_backoff_{'K' if self.of == 'temperature' else 'V'}"

    @property
    def parameter(self) -> Parameter:
        return Parameter(self.name, self.lower, self.upper, 0.0, unit=self.name[-1], size=self.nodes)

    def margin(self, stage: Stage) -> Any:
        values = stage.theta[self.name]
        return values if self.nodes == 1 else natural_spline(stage.now["soc"], np.linspace(0.0, 1.0, self.nodes), values)


@dataclass(frozen=True)
class ResistanceRatio:
    """theta in the model f and h: a resistance as ratio to the controller's (wrong) own, log scale.

    One factor for each node of the cell's tables, or with ``scale=True`` one for the whole table.
    """

    of: Literal["R0", "R1", "R2", "R3"]
    lower: float = 0.1
    upper: float = 6.0
    scale: bool = False

    def __post_init__(self) -> None:
        if self.of not in ("R0", "R1", "R2", "R3"):
            raise ValueError(f"resistance ratio: of = {self.of!r}, allowed is 'R0' or 'R1' (or 'R2', 'R3' of a cell that has them)")
        check_number(f"resistance ratio of {self.of}: lower", self.lower, 0.001, 0.999)
        check_number(f"resistance ratio of {self.of}: upper", self.upper, 1.001, 100.0)
        if not isinstance(self.scale, bool):
            raise ValueError(f"resistance ratio of {self.of}: scale = {self.scale!r}, allowed is true or false")

    @property
    def name(self) -> str:
        return f"{self.of}_{'scale' if self.scale else 'ratio'}"

    def parameter(self, nodes: int) -> Parameter:
        return Parameter(self.name, self.lower, self.upper, 1.0, scale="log", size=1 if self.scale else nodes)


@dataclass(frozen=True)
class CurrentLimit:
    """theta in the set U: I <= min(I_max, c(z)), c piecewise linear on equidistant SOC nodes from 0 to 1.

    It holds what the controller's model cannot predict: lithium plating, and a temperature without a thermal model. Its
    nodes run from ``lower`` to 1 as shares of the largest current; untuned it changes nothing.
    """

    nodes: int = 6
    lower: float = 0.1

    def __post_init__(self) -> None:
        check_count("current limit: nodes", self.nodes, 2, 50)
        check_number("current limit: lower", self.lower, 0.0, 0.99)

    @property
    def grid(self) -> NDArray[np.float64]:
        return np.linspace(0.0, 1.0, self.nodes)

    @property
    def parameter(self) -> Parameter:
        return Parameter("current_limit", self.lower, 1.0, 1.0, size=self.nodes)

    def share(self, stage: Stage) -> Any:
        return piecewise_linear(ca.fmin(ca.fmax(stage.now["soc"], 0.0), 1.0), self.grid, stage.theta["current_limit"])


@dataclass(frozen=True)
class MeasurementSpread:
    """theta in the estimator: the standard deviation that the Kalman filter assumes of the measured voltage, log scale."""

    lower_V: float = 1e-3
    upper_V: float = 0.2
    default_V: float = 0.05

    def __post_init__(self) -> None:
        check_number("voltage spread: lower_V", self.lower_V, 1e-6, 1.0, "V")
        check_number("voltage spread: upper_V", self.upper_V, self.lower_V, 10.0, "V", open_low=True)
        check_number("voltage spread: default_V", self.default_V, self.lower_V, self.upper_V, "V")

    @property
    def parameter(self) -> Parameter:
        return Parameter("voltage_sd_V", self.lower_V, self.upper_V, self.default_V, unit="V", scale="log")
