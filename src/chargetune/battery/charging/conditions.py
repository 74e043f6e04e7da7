"""What a backoff, or theta as a whole, may depend on beside the SOC: measured and estimated states, and declared contexts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from chargetune.battery.validation import check_count, check_interval, check_number
from chargetune.control.controller import Stage
from chargetune.model.parameter_space import ParameterSpace
from chargetune.model.schedule import Axis, Schedule

__all__ = ["Over", "ScheduleSettings"]

RESISTANCE_STATE = "resistance_log_factor"


@dataclass(frozen=True)
class Over:
    """A table of a backoff over what is known when the input is chosen, beside the SOC; linear in between, held beyond.

    The values at a temperature and a factor are those over the SOC next to each other, the factor's nodes one after the other, then the
    temperature's.
    """

    temperature_K: tuple[float, float] | None = None
    """[lowest, highest] of the cell's temperature in the table."""
    temperature_nodes: int = 2
    """Equidistant nodes from one to the other."""
    resistance_factor: tuple[float, float] | None = None
    """[lowest, highest] of the factor of the resistances that the observer "adaptive" estimates."""
    resistance_nodes: int = 2
    """Equidistant nodes from one to the other."""

    def __post_init__(self) -> None:
        if self.temperature_K is None and self.resistance_factor is None:
            raise ValueError("over: nothing is given, allowed is at least one of temperature_K and resistance_factor")
        for name, nodes, least, most, unit in (
            ("temperature_K", "temperature_nodes", 200.0, 400.0, "K"),
            ("resistance_factor", "resistance_nodes", 0.01, 100.0, ""),
        ):
            check_count(f"over: {nodes}", getattr(self, nodes), 2, 20)
            pair = getattr(self, name)
            if pair is not None:
                check_interval(f"over: {name}", pair, least, most, unit, wide=True)

    @property
    def shape(self) -> tuple[int, int]:
        """Nodes of the table over temperature and factor."""
        return self.temperature_nodes if self.temperature_K else 1, self.resistance_nodes if self.resistance_factor else 1

    @property
    def count(self) -> int:
        """How many times the values over the SOC are in the table."""
        return self.shape[0] * self.shape[1]

    def at(self, stage: Stage, values: Any) -> Any:
        """The values over the SOC at what is estimated now, shape (SOC nodes, 1), from those of the table."""
        shares = ca.SX(1)
        if self.temperature_K:
            shares = ca.kron(shares, _hats(stage.now["temperature_K"], self.temperature_K, self.temperature_nodes))
        if self.resistance_factor:
            shares = ca.kron(shares, _hats(ca.exp(stage.now[RESISTANCE_STATE]), self.resistance_factor, self.resistance_nodes))
        return ca.mtimes(ca.reshape(values, values.shape[0] // self.count, self.count), shares)

    def check(self, label: str, *, thermal: bool, adaptive: bool) -> None:
        """ValueError where the controller does not know one of them."""
        if self.temperature_K and not thermal:
            raise ValueError(f"{label}: over temperature_K is given, allowed only for a cell with a [thermal] table")
        if self.resistance_factor and not adaptive:
            raise ValueError(f'{label}: over resistance_factor is given, allowed only with estimator.kind = "adaptive", which estimates it')


def _hats(value: Any, pair: tuple[float, float], nodes: int) -> Any:
    """The share of each of the equidistant nodes, shape (nodes, 1)."""
    low, high = pair
    place = ca.fmin(ca.fmax((value - low) / (high - low), 0.0), 1.0) * (nodes - 1)
    return ca.vertcat(*(ca.fmax(1.0 - ca.fabs(place - k), 0.0) for k in range(nodes)))


@dataclass(frozen=True)
class ScheduleSettings:
    """theta by context (`Schedule`): what is known of a charge before it begins, as nodes of a table.

    A charge in a context outside the nodes is refused.
    """

    ambient_K: tuple[float, ...] | None = None
    """Nodes of the ambient temperature; only with a [thermal] table in the cell file."""
    age: tuple[float, ...] | None = None
    """Nodes of the age from 0 to 1 that range.fade and range.growth speak of."""
    parts: tuple[str, ...] = ()
    """Names of theta's parts that differ by context, such as "backoff_V"; none: all do."""

    def __post_init__(self) -> None:
        for name, least, most, unit in (("ambient_K", 200.0, 400.0, "K"), ("age", 0.0, 1.0, "")):
            for k, value in enumerate(getattr(self, name) or ()):
                check_number(f"schedule: {name}[{k}]", value, least, most, unit)
        # Its own checks name what is wrong.
        _ = self.schedule

    @property
    def schedule(self) -> Schedule:
        nodes = (("ambient_K", self.ambient_K, "K"), ("age", self.age, ""))
        return Schedule(tuple(Axis(name, tuple(values), unit) for name, values, unit in nodes if values is not None), tuple(self.parts))

    def space(self, base: ParameterSpace) -> ParameterSpace:
        """The space of the table."""
        return self.schedule.space(base)

    def check_span(self, name: str, pair: tuple[float, float]) -> None:
        """ValueError where a range of use leaves the span of the table."""
        for axis in self.schedule.axes:
            if axis.name == name:
                for k, value in enumerate(np.asarray(pair, dtype=float)):
                    axis.check(float(value), f"range[{k}]")
