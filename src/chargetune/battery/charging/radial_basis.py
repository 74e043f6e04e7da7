"""theta in the stage cost: the weights of a radial-basis network."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from chargetune.battery.validation import check_count, check_interval, check_number
from chargetune.control.controller import Stage
from chargetune.model.parameter_space import Parameter

__all__ = ["RadialBasis"]

# The outer voltage centres of a radial-basis cost beyond the upper voltage limit, and how many centres there may be over one quantity.
RBF_BEYOND_V = (-0.2, 0.1)
RBF_MAX = 20


@dataclass(frozen=True)
class RadialBasis:
    """A radial-basis network over the predicted SOC and voltage, added to the stage cost.

        l(z, V) = (z_d - z)^2 + sum_jk w_jk exp(-(z - z_j)^2 / (2 s_z^2) - (V - v_k)^2 / (2 s_V^2)),

    with the weights w as theta, those of one SOC centre next to each other. Untuned they are 0. Centres are equidistant, and a width
    is their spacing, with which Gaussians still follow any smooth cost. A centre above the limit makes a slope that grows towards the
    limit: its weight is the price of coming near. The cost is not convex; what the solver finds is a local solution.

    The default bounds of a weight: at 0.05 the steepest slope of one Gaussian, 0.6 w / s_V = 0.3 / V, is that of the lack of charge at
    SOC 0.1 for a cell of 2 Ah and 40 mOhm over five intervals of 10 s.

    Source of the idea: Hirt et al., "Safe Learning-Based Optimization of Model Predictive Control: Application to Battery
    Fast-Charging", arXiv 2410.04982 (2024), 16 weights. What they are functions of, with which centres and widths, is assumed here.
    """

    soc_nodes: int = 4
    """Centres of the network from SOC 0 to 1."""
    voltage_nodes: int = 4
    """Centres over the voltage."""
    voltage_V: tuple[float, float] | None = None
    """Lowest and highest centre; without it 0.2 V below the upper voltage limit and 0.1 V above it."""
    lower: float = -0.05
    """Lowest value of each weight."""
    upper: float = 0.05
    """Highest value of each weight."""

    def __post_init__(self) -> None:
        check_count("rbf: soc_nodes", self.soc_nodes, 2, RBF_MAX)
        check_count("rbf: voltage_nodes", self.voltage_nodes, 2, RBF_MAX)
        if self.voltage_V is not None:
            check_interval("rbf: voltage_V", self.voltage_V, 0.0, 10.0, "V", wide=True)
        check_number("rbf: lower", self.lower, -10.0, 0.0)
        check_number("rbf: upper", self.upper, 0.0, 10.0, open_low=True)

    @property
    def parameter(self) -> Parameter:
        shape = (self.soc_nodes, self.voltage_nodes)
        return Parameter("rbf_weight", self.lower, self.upper, 0.0, size=self.soc_nodes * self.voltage_nodes, shape=shape)

    def centres(self, voltage_max_V: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Those over the SOC and those over the voltage in V."""
        low, high = self.voltage_V or tuple(voltage_max_V + beyond for beyond in RBF_BEYOND_V)
        return np.linspace(0.0, 1.0, self.soc_nodes), np.linspace(low, high, self.voltage_nodes)

    def cost(self, stage: Stage, voltage_max_V: float) -> Any:
        """The network's value at a stage, with its weights from theta."""
        bumps = []
        for value, centres in zip((stage.x["soc"], stage.y["voltage_V"]), self.centres(voltage_max_V), strict=True):
            width = centres[1] - centres[0]
            bumps.append(ca.vertcat(*(ca.exp(-((value - centre) ** 2) / (2 * width**2)) for centre in centres)))
        by_voltage = ca.reshape(stage.theta["rbf_weight"], self.voltage_nodes, self.soc_nodes)
        return ca.dot(bumps[1], ca.mtimes(by_voltage, bumps[0]))
