"""What of a charging controller can be tuned: the parts of theta, each with its bounds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from math import prod
from typing import Any, Literal

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from chargetune.battery.charging.conditions import Over, ScheduleSettings
from chargetune.battery.charging.radial_basis import RadialBasis
from chargetune.battery.validation import check_count, check_number
from chargetune.control.controller import Stage
from chargetune.model.parameter_space import Parameter, ParameterSpace
from chargetune.model.splines import natural_spline, piecewise_linear

__all__ = [
    "Backoff",
    "CapacityRatio",
    "CurrentLimit",
    "CurrentRamp",
    "LimitBackoff",
    "MeasurementSpread",
    "ObserverSetting",
    "ResistanceRatio",
    "Tunables",
]

Resistance = Literal["R0", "R1", "R2", "R3"]
RESISTANCES: tuple[Resistance, ...] = ("R0", "R1", "R2", "R3")
# What a margin to a limit beside the voltage's may be at most, and its unit.
WIDEST = {"temperature": (50.0, "K"), "anode": (0.5, "V")}


@dataclass(frozen=True)
class Backoff:
    """theta in the set Y: the controller keeps V <= v_max - b(z), b a natural cubic spline on equidistant SOC nodes.

    ``at="measured"`` takes b at the measured z_k for the whole horizon (the paper's text), ``"predicted"`` at each z_i.
    A signed backoff (lower < 0) lets the controller also correct a model that is too pessimistic. With ``over`` its node values are a
    table over temperature or estimated resistance too.
    """

    nodes: int = 7
    """Equidistant SOC nodes of the spline, the number of values in theta."""
    lower_V: float = -0.25
    """Lowest margin; below 0 the limit is exceeded in the model."""
    upper_V: float = 0.25
    """Largest margin."""
    at: Literal["measured", "predicted"] = "measured"
    """Where the spline is read: at the "measured" SOC for the whole horizon, or at each "predicted" one."""
    over: Over | None = None
    """Conditions that the margin depends on beside the SOC: nodes of temperature_K or of resistance_factor."""

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
        shape = (*(self.over.shape if self.over else ()), self.nodes)
        return Parameter("backoff_V", self.lower_V, self.upper_V, 0.0, unit="V", size=prod(shape), shape=shape)

    def voltage(self, stage: Stage) -> Any:
        z = stage.now["soc"] if self.at == "measured" else stage.x["soc"]
        values = stage.theta["backoff_V"]
        return natural_spline(z, self.grid, self.over.at(stage, values) if self.over else values)


@dataclass(frozen=True)
class LimitBackoff:
    """theta in the sets X, Y: the controller keeps another limit by a margin b, T <= T_max - b or anode >= minimum + b.

    One node is a constant margin; more are a natural cubic spline over the measured SOC. Signed, and with ``over``, like `Backoff`.
    """

    lower: float
    """Lowest margin, in the unit of the limit."""
    upper: float
    """Largest margin, in the unit of the limit."""
    nodes: int = 1
    """1: a constant margin; more: SOC nodes of a spline."""
    over: Over | None = None
    """Conditions that the margin depends on beside the SOC: nodes of temperature_K or of resistance_factor."""

    def __post_init__(self) -> None:
        widest = max(most for most, _ in WIDEST.values())
        check_number("limit backoff: lower", self.lower, -widest, 0.0)
        check_number("limit backoff: upper", self.upper, 0.0, widest, open_low=True)
        check_count("limit backoff: nodes", self.nodes, 1, 50)

    def name(self, of: str) -> str:
        """Its name in theta as margin to the limit ``of`` temperature or anode."""
        return f"{of}_backoff_{WIDEST[of][1]}"

    def parameter(self, of: str) -> Parameter:
        shape = (*(self.over.shape if self.over else ()), self.nodes)
        return Parameter(self.name(of), self.lower, self.upper, 0.0, unit=WIDEST[of][1], size=prod(shape), shape=shape)

    def margin(self, of: str, stage: Stage) -> Any:
        values = stage.theta[self.name(of)]
        values = self.over.at(stage, values) if self.over else values
        return values if self.nodes == 1 else natural_spline(stage.now["soc"], np.linspace(0.0, 1.0, self.nodes), values)


@dataclass(frozen=True)
class ResistanceRatio:
    """theta in the model f and h: a resistance as ratio to the controller's (wrong) own, log scale.

    One factor for each node of the cell's tables, or with ``scale=True`` one for the whole table.
    """

    lower: float = 0.1
    """Smallest factor on the controller's own resistance."""
    upper: float = 6.0
    """Largest factor."""
    scale: bool = False
    """true: one factor for the whole table; false: one for each SOC node."""

    def __post_init__(self) -> None:
        # The untuned controller's own resistance lies between them.
        check_number("resistance ratio: lower", self.lower, 0.001, 0.999, "below 1, the untuned ratio")
        check_number("resistance ratio: upper", self.upper, 1.001, 100.0, "above 1, the untuned ratio")
        if not isinstance(self.scale, bool):
            raise ValueError(f"resistance ratio: scale = {self.scale!r}, allowed is true or false")

    def name(self, of: str) -> str:
        """Its name in theta as factor on the resistance ``of`` R0, R1, R2 or R3."""
        return f"{of}_{'scale' if self.scale else 'ratio'}"

    def parameter(self, of: str, nodes: int) -> Parameter:
        return Parameter(self.name(of), self.lower, self.upper, 1.0, scale="log", size=1 if self.scale else nodes)


@dataclass(frozen=True)
class CapacityRatio:
    """theta in the model f: the capacity as ratio to the controller's own, log scale. A SOC that is counted is counted with it."""

    lower: float = 0.5
    """Smallest factor on the controller's own capacity."""
    upper: float = 1.5
    """Largest factor."""

    def __post_init__(self) -> None:
        check_number("capacity ratio: lower", self.lower, 0.1, 0.999, "below 1, the untuned ratio")
        check_number("capacity ratio: upper", self.upper, 1.001, 10.0, "above 1, the untuned ratio")

    @property
    def parameter(self) -> Parameter:
        return Parameter("capacity_ratio", self.lower, self.upper, 1.0, scale="log")


@dataclass(frozen=True)
class CurrentLimit:
    """theta in the set U: I <= min(I_max, c(z)), c piecewise linear on equidistant SOC nodes from 0 to 1.

    It holds what the controller's model cannot predict: lithium plating, and a temperature without a thermal model. Its
    nodes run from ``lower`` to 1 as shares of the largest current; untuned it changes nothing.
    """

    nodes: int = 6
    """Equidistant SOC nodes from 0 to 1, the number of values in theta."""
    lower: float = 0.1
    """Lowest value of a node, as share of the largest current."""

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
class CurrentRamp:
    """theta in the set U: by how much the current may rise per second, I_k <= I_{k-1} + ramp Ts, log scale.

    Untuned it is the controller's own ``current_ramp_A_s``.
    """

    lower_A_s: float
    """Smallest ramp."""
    upper_A_s: float
    """Largest ramp, more than lower_A_s."""

    def __post_init__(self) -> None:
        check_number("current ramp: lower_A_s", self.lower_A_s, 1e-6, 1e4, "A/s")
        check_number("current ramp: upper_A_s", self.upper_A_s, self.lower_A_s, 1e4, "A/s", open_low=True)

    def parameter(self, default_A_s: float) -> Parameter:
        return Parameter("current_ramp_A_s", self.lower_A_s, self.upper_A_s, default_A_s, unit="A/s", scale="log")


@dataclass(frozen=True)
class MeasurementSpread:
    """theta in the estimator: the standard deviation that the Kalman filter assumes of the measured voltage, log scale.

    Untuned it is the filter's own.
    """

    lower_V: float = 1e-3
    """Smallest standard deviation."""
    upper_V: float = 0.2
    """Largest standard deviation, more than lower_V."""

    def __post_init__(self) -> None:
        check_number("voltage spread: lower_V", self.lower_V, 1e-6, 1.0, "V")
        check_number("voltage spread: upper_V", self.upper_V, self.lower_V, 10.0, "V", open_low=True)

    def parameter(self, default_V: float) -> Parameter:
        return Parameter("voltage_sd_V", self.lower_V, self.upper_V, default_V, unit="V", scale="log")


@dataclass(frozen=True)
class ObserverSetting:
    """theta in the observer: one of its standard deviations, by its name in `OffsetFree` or `Adaptive`, log scale.

    Untuned it is the observer's own.
    """

    name: str
    """Key of [estimator.offset_free] or [estimator.adaptive] that is tuned."""
    lower: float
    """Smallest value, in the unit of that key."""
    upper: float
    """Largest value, more than lower."""

    def __post_init__(self) -> None:
        check_number(f"observer: lower of {self.name}", self.lower, 1e-9, 1e3)
        check_number(f"observer: upper of {self.name}", self.upper, self.lower, 1e3, open_low=True)

    def parameter(self, default: float) -> Parameter:
        return Parameter(self.name, self.lower, self.upper, default, scale="log")


@dataclass(frozen=True)
class Tunables:
    """What theta consists of, each part by its place in the controller, and values for it to simulate with.

    ``R0`` to ``R3`` are resistances of the controller's model, ``capacity`` its capacity; with a ``schedule`` the parts are tables over
    contexts. ``values`` are of theta by name, what they do not name is untuned. They are no part of what is tuned, so two that differ in
    nothing else are equal.
    """

    backoff: Backoff | None = None
    """Margin to the upper voltage limit over the SOC."""
    R0: ResistanceRatio | None = None
    """Factors on R0 of the controller's model."""
    R1: ResistanceRatio | None = None
    """Factors on R1."""
    R2: ResistanceRatio | None = None
    """Factors on R2."""
    R3: ResistanceRatio | None = None
    """Factors on R3."""
    capacity: CapacityRatio | None = None
    """Factor on the capacity of the controller's model."""
    current_limit: CurrentLimit | None = None
    """Upper limit of the current over the SOC."""
    current_ramp: CurrentRamp | None = None
    """How fast the current may rise."""
    rbf: RadialBasis | None = None
    """Weights of a radial-basis stage cost."""
    temperature_backoff: LimitBackoff | None = None
    """Margin to the temperature limit."""
    anode_backoff: LimitBackoff | None = None
    """Margin to the anode's limit."""
    voltage_sd: MeasurementSpread | None = None
    """The voltage's standard deviation in the Kalman filter."""
    observer: tuple[ObserverSetting, ...] = ()
    """Numbers of the observer, a list of tables [[theta.observer]]."""
    schedule: ScheduleSettings | None = None
    """Contexts of a charge over which parts of theta are interpolated."""
    values: Mapping[str, float | list[float]] = field(default_factory=dict, compare=False)
    """Values of theta by name to simulate with; what is not named is untuned."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "observer", tuple(self.observer))
        names = [part.name for part in self.observer]
        if len(set(names)) < len(names):
            raise ValueError(f"theta.observer names {', '.join(names)}, allowed are different names")
        for of, part in self.limit_backoffs.items():
            widest, unit = WIDEST[of]
            check_number(f"{of}_backoff: lower", part.lower, -widest, 0.0, unit)
            check_number(f"{of}_backoff: upper", part.upper, 0.0, widest, unit, open_low=True)

    @property
    def ratios(self) -> dict[Resistance, ResistanceRatio]:
        """The resistances that are tuned, by name."""
        return {of: part for of in RESISTANCES if (part := getattr(self, of)) is not None}

    @property
    def limit_backoffs(self) -> dict[str, LimitBackoff]:
        """The margins that are tuned beside the voltage's, by what is limited: temperature, anode."""
        parts = {"temperature": self.temperature_backoff, "anode": self.anode_backoff}
        return {of: part for of, part in parts.items() if part is not None}

    @property
    def observed(self) -> tuple[str, ...]:
        """Names of the filter's numbers that are tuned."""
        return (*(["voltage_sd_V"] if self.voltage_sd else []), *(part.name for part in self.observer))

    @property
    def over(self) -> dict[str, Over]:
        """The tables over conditions, by the part of theta that is one."""
        parts = {"backoff": self.backoff, **{f"{of}_backoff": part for of, part in self.limit_backoffs.items()}}
        return {name: part.over for name, part in parts.items() if part is not None and part.over is not None}

    @property
    def curves(self) -> Tunables:
        """What of it is a curve over the SOC alone: nothing with a schedule, and no table over conditions."""
        tables: dict[str, Any] = dict.fromkeys(self.over)
        return Tunables() if self.schedule else replace(self, **tables)

    def space(self, nodes: int, observer: Mapping[str, float], ramp_A_s: float | None) -> ParameterSpace:
        """The space of theta for a cell with so many SOC nodes, a filter with these numbers by name, and this ramp of the current."""
        base = self.base_space(nodes, observer, ramp_A_s)
        return self.schedule.space(base) if self.schedule else base

    def base_space(self, nodes: int, observer: Mapping[str, float], ramp_A_s: float | None) -> ParameterSpace:
        """The space of the theta of one context, which is what the controller has."""
        return ParameterSpace(
            (
                *([self.backoff.parameter] if self.backoff else []),
                *(part.parameter(of, nodes) for of, part in self.ratios.items()),
                *([self.capacity.parameter] if self.capacity else []),
                *(part.parameter(of) for of, part in self.limit_backoffs.items()),
                *([self.current_limit.parameter] if self.current_limit else []),
                *([self.current_ramp.parameter(ramp_A_s)] if self.current_ramp and ramp_A_s is not None else []),
                *([self.rbf.parameter] if self.rbf else []),
                *([self.voltage_sd.parameter(observer["voltage_sd_V"])] if self.voltage_sd else []),
                *(part.parameter(observer[part.name]) for part in self.observer),
            )
        )
