"""Thermal and plating data of a cell: what extends its circuit by a lumped temperature and an anode potential."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated, Any

import casadi as ca
from pydantic import Field

from chargetune.model.splines import pchip
from chargetune.runtime.counted import counted

__all__ = ["GAS_CONSTANT", "Thermal"]

# J / (mol K), exact since the SI of 2019 (CODATA 2018).
GAS_CONSTANT = 8.314462618
# Kelvin outside these was degrees Celsius, or is no battery.
TEMPERATURE_RANGE_K = (200.0, 400.0)


@dataclass(frozen=True)
class Thermal:
    """One temperature T (K) for the whole cell, and how the circuit depends on it.

        C dT/dt = Q - hA (T - T_ambient),   Q = I (V - OCV) + I T dOCV/dT

    ``cooling_W_K`` is hA. All resistances change by the same factor s(T): Arrhenius, exp(E / R (1 / T - 1 / T_ref)), or
    where ``factor`` is given monotone interpolation of that table over ``factor_K`` (constant beyond its ends). The time
    constants R C stay: C changes by 1 / s(T). Source: Bernardi et al., J. Electrochem. Soc. 132 (1985) 5, doi 10.1149/1.2113792.
    """

    heat_capacity_J_K: Annotated[float, Field(description="Heat capacity of one cell, J/K; more than 0, at most 1e6.")]
    cooling_W_K: Annotated[float, Field(description="Heat that one cell loses per kelvin above ambient, W/K; more than 0, at most 1e4.")]
    ambient_K: Annotated[float, Field(description="Temperature of the surroundings and of the cell at its start, K; 200 to 400.")] = 298.15
    reference_K: Annotated[float, Field(description="Temperature at which the circuit's tables hold, K; 200 to 400.")] = 298.15
    activation_J_mol: Annotated[
        float, Field(description="Activation energy of all resistances, J/mol; at most 2e5. Not together with factor.")
    ] = 0.0
    entropic_V_K: Annotated[float, Field(description="Entropic coefficient dOCV/dT, V/K; -0.01 to 0.01.")] = 0.0
    factor_K: Annotated[tuple[float, ...], Field(description="Temperatures of the table factor, K; increasing within 200 to 400.")] = ()
    factor: Annotated[
        tuple[float, ...], Field(description="Factor on all resistances over factor_K, 1; more than 0, at most 100, 1 at reference_K.")
    ] = ()

    def __post_init__(self) -> None:
        for name in ("factor_K", "factor"):
            object.__setattr__(self, name, tuple(getattr(self, name)))
        low, high = TEMPERATURE_RANGE_K
        for name, least, most, unit in (
            ("heat_capacity_J_K", 0.0, 1e6, "J/K"),
            ("cooling_W_K", 0.0, 1e4, "W/K"),
            ("ambient_K", low, high, "K (was it given in degC?)"),
            ("reference_K", low, high, "K (was it given in degC?)"),
        ):
            value = getattr(self, name)
            if not _finite(value) or not least < value <= most:
                raise ValueError(f"thermal: {name} = {value!r}, allowed is more than {least:g} and at most {most:g} {unit}")
        for name, most, unit in (("activation_J_mol", 2e5, "J/mol"), ("entropic_V_K", 0.01, "V/K")):
            value = getattr(self, name)
            if not _finite(value) or abs(value) > most:
                raise ValueError(f"thermal: {name} = {value!r}, allowed is [-{most:g}, {most:g}] {unit}")
        if len(self.factor) != len(self.factor_K) or len(self.factor) == 1:
            raise ValueError(
                f"thermal: factor has {counted(len(self.factor), 'value')} for {counted(len(self.factor_K), 'temperature')}, "
                "allowed are as many, at least 2"
            )
        if self.factor and self.activation_J_mol:
            raise ValueError("thermal: activation_J_mol and factor are given; allowed is one of them")
        for i, value in enumerate(self.factor):
            if not _finite(value) or not 0 < value <= 100:
                raise ValueError(f"thermal: factor[{i}] = {value!r}, allowed is more than 0 and at most 100")
        _increasing("thermal: factor_K", self.factor_K, low, high, "K (was it given in degC?)")

    def resistance_factor(self, temperature: Any, activation: Any, reference: Any) -> Any:
        """s(T), 1 at the reference; ``temperature``, ``activation`` and ``reference`` may be symbols."""
        if self.factor:
            return pchip(ca.fmin(ca.fmax(temperature, self.factor_K[0]), self.factor_K[-1]), self.factor_K, self.factor)
        return ca.exp(activation / GAS_CONSTANT * (1 / temperature - 1 / reference))


def _finite(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def _increasing(name: str, values: tuple[float, ...], low: float, high: float, unit: str) -> None:
    for i, value in enumerate(values):
        if not _finite(value) or not low <= value <= high:
            raise ValueError(f"{name}[{i}] = {value!r}, allowed is [{low:g}, {high:g}] {unit}")
    for i, (a, b) in enumerate(pairwise(values)):
        if b <= a:
            raise ValueError(f"{name}[{i + 1}] = {b:g} must be more than {name}[{i}] = {a:g}")
