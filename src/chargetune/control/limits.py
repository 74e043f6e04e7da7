"""Limits on outputs and states: as they are declared, and as rows of the control problem."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import casadi as ca

from chargetune.runtime.numeric import is_finite

__all__ = ["Bound", "LimitRows", "SoftLimit"]

At = Literal["start", "end", "both", "terminal"]
# A number, or an expression of a `Stage`.
Bound = float | Callable[[Any], Any]


@dataclass(frozen=True)
class SoftLimit:
    """A limit on an output or a state, kept by an exact penalty; each side is a number or an expression of a `Stage`.

    of
        Name of an output or state of the controller's model.
    lower, upper, equals
        lower <= value <= upper, either of them alone, or value = equals alone, which is both sides at once.
    at
        Where in the interval outputs are limited: h(x_i, u_i), h(x_{i+1}, u_i), both, or only at the end of the horizon.
        A state is limited at ``end`` or ``terminal``, since x_0 is given. ``stage.given`` is that of the sample's instant:
        of stage i at ``start``, of stage i + 1 at ``end``, of stage N at ``terminal``.
    penalty
        Cost per unit of the largest violation over the horizon, weighted 1 at its start to 2 at its end. The penalty is
        exact (no violation where none is needed) when it exceeds the sum of the limit's multipliers.
    scale
        A noticeable violation, in the unit of the limit; the solver's tolerance is relative to it.
    """

    of: str
    lower: Bound | None = None
    upper: Bound | None = None
    at: At = "both"
    penalty: float = 1e3
    scale: float = 1.0
    equals: Bound | None = None

    def __post_init__(self) -> None:
        if self.equals is not None and (self.lower is not None or self.upper is not None):
            raise ValueError(f"limit of {self.of}: equals = {self.equals!r} beside lower or upper, allowed is one or the other")
        if self.lower is None and self.upper is None and self.equals is None:
            raise ValueError(f"limit of {self.of}: neither lower nor upper nor equals is given")
        for name in ("lower", "upper", "equals"):
            value = getattr(self, name)
            if value is not None and not callable(value) and not is_finite(value):
                raise ValueError(f"limit of {self.of}: {name} = {value!r}, allowed is a finite number or an expression")
        if is_finite(self.lower) and is_finite(self.upper) and self.lower >= self.upper:  # type: ignore[operator]
            raise ValueError(f"limit of {self.of}: lower = {self.lower} must be less than upper = {self.upper}")
        if self.at not in ("start", "end", "both", "terminal"):
            raise ValueError(f"limit of {self.of}: at = {self.at!r}, allowed is start, end, both or terminal")
        for name in ("penalty", "scale"):
            if not is_finite(getattr(self, name)) or getattr(self, name) <= 0:
                raise ValueError(f"limit of {self.of}: {name} = {getattr(self, name)!r}, allowed is a finite number > 0")

    @property
    def sides(self) -> tuple[tuple[Bound, float], ...]:
        """(bound, sign) of each row sign (value - bound) <= 0."""
        pairs = ((self.upper, 1.0), (self.lower, -1.0), (self.equals, 1.0), (self.equals, -1.0))
        return tuple((bound, sign) for bound, sign in pairs if bound is not None)


@dataclass(frozen=True)
class LimitRows:
    """A `SoftLimit` as a CasADi function (x, u, theta, p, now, u_last, given) -> rows that are <= 0 when it is kept."""

    of: str
    rows: ca.Function
    at: At
    penalty: float
    scale: float
