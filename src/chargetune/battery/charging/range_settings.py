"""What differs between the charges that a controller meets, as the table [range] of a study file."""

from __future__ import annotations

from dataclasses import dataclass

from chargetune.battery.validation import check_number

__all__ = ["ChargingRangeSettings"]


@dataclass(frozen=True)
class ChargingRangeSettings:
    """Every quantity is drawn uniformly, all independently of each other; what is not given does not differ.

    soc_start
        SOC at the start, [lowest, highest]; new in each charge.
    ambient_K
        Ambient temperature, [lowest, highest] in K, also that of the cell at the start; new in each charge. Only with a [thermal] table.
    resistance, resistance_by_node
        R0 and the R of all R-C pairs times 1 +- this, all in common; each node of each table times 1 +- this.
    capacitance, capacitance_by_node
        The same of the C of all R-C pairs.
    capacity
        The capacity times 1 +- this.
    fade, growth
        Of an age a, uniform in [0, 1]: the capacity times 1 - fade a, all resistances times 1 + growth a.
    voltage_bias_V
        The voltage sensor reads too much by +- this.

    Raises ValueError naming field, value and what is allowed.
    """

    soc_start: tuple[float, float] | None = None
    ambient_K: tuple[float, float] | None = None
    resistance: float = 0.0
    resistance_by_node: float = 0.0
    capacitance: float = 0.0
    capacitance_by_node: float = 0.0
    capacity: float = 0.0
    fade: float = 0.0
    growth: float = 0.0
    voltage_bias_V: float = 0.0

    def __post_init__(self) -> None:
        for name, most in (("resistance", 0.9), ("resistance_by_node", 0.9), ("capacitance", 0.9), ("capacitance_by_node", 0.9)):
            check_number(f"range: {name}", getattr(self, name), 0.0, most)
        check_number("range: capacity", self.capacity, 0.0, 0.5)
        check_number("range: fade", self.fade, 0.0, 0.5)
        check_number("range: growth", self.growth, 0.0, 2.0)
        check_number("range: voltage_bias_V", self.voltage_bias_V, 0.0, 0.1, "V")
        for name, least, most, unit in (("soc_start", 0.0, 1.0, ""), ("ambient_K", 200.0, 400.0, "K")):
            pair = getattr(self, name)
            if pair is None:
                continue
            if len(pair) != 2:
                raise ValueError(f"range: {name} = {list(pair)!r}, allowed is [lowest, highest]")
            low, high = (check_number(f"range: {name}[{k}]", value, least, most, unit) for k, value in enumerate(pair))
            if low > high:
                raise ValueError(f"range: {name} = {list(pair)!r}, allowed is [lowest, highest]")
