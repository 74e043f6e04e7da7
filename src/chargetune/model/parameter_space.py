"""The space of the parameters theta that are tuned: names, bounds, scale, units, defaults."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from chargetune.runtime.counted import counted
from chargetune.runtime.numeric import is_finite, is_integer

__all__ = ["Parameter", "ParameterSpace"]

Scale = Literal["linear", "log"]


@dataclass(frozen=True)
class Parameter:
    """One named entry of theta, a scalar (``size=1``) or a vector of spline nodes.

    ``default`` is the untuned value theta_0, one number for all entries or one an entry.
    ``scale="log"`` means that the logarithm is what the tuner sees as uniform. ``shape`` is that of the table whose entries these are,
    the last index fastest; by default they are neighbours in a row.
    """

    name: str
    lower: float
    upper: float
    default: float | tuple[float, ...]
    unit: str = "1"
    scale: Scale = "linear"
    size: int = 1
    shape: tuple[int, ...] = field(default=(), compare=False)

    def __post_init__(self) -> None:
        if not self.name or any(c in self.name for c in "[], \t\n"):
            raise ValueError(f"parameter name {self.name!r}: allowed is a non-empty name without spaces, commas or brackets")
        if not is_integer(self.size) or self.size < 1:
            raise ValueError(f"parameter {self.name}: size = {self.size!r}, allowed is an integer >= 1")
        if self.scale not in ("linear", "log"):
            raise ValueError(f"parameter {self.name}: scale = {self.scale!r}, allowed is 'linear' or 'log'")
        shape = tuple(self.shape) or (self.size,)
        if math.prod(shape) != self.size:
            raise ValueError(f"parameter {self.name}: shape = {shape}, allowed is one of size = {self.size}")
        object.__setattr__(self, "shape", shape)
        for bound in ("lower", "upper"):
            value = getattr(self, bound)
            if not is_finite(value):
                raise ValueError(f"parameter {self.name}: {bound} = {value!r}, allowed is a finite number")
        if self.lower >= self.upper:
            raise ValueError(f"parameter {self.name}: lower = {self.lower:g} must be less than upper = {self.upper:g}")
        if self.scale == "log" and self.lower <= 0:
            raise ValueError(f"parameter {self.name}: lower = {self.lower:g}, a log scale needs lower > 0")
        values = self.default if isinstance(self.default, tuple) else (self.default,) * self.size
        if len(values) != self.size:
            raise ValueError(f"parameter {self.name}: default has {counted(len(values), 'value')}, expected {self.size}")
        for value in values:
            if not is_finite(value) or not self.lower <= value <= self.upper:
                raise ValueError(f"parameter {self.name}: default = {value!r}, allowed is [{self.lower:g}, {self.upper:g}] {self.unit}")
        object.__setattr__(self, "default", tuple(float(v) for v in values))
        # NumPy's numbers become Python's, which JSON knows.
        for name, kind in (("lower", float), ("upper", float), ("size", int)):
            object.__setattr__(self, name, kind(getattr(self, name)))

    @property
    def entries(self) -> tuple[str, ...]:
        """Names of the single numbers: ``("b",)`` or ``("b[0]", "b[1]", ...)``."""
        return (self.name,) if self.size == 1 else tuple(f"{self.name}[{i}]" for i in range(self.size))


@dataclass(frozen=True)
class ParameterSpace:
    """A box of parameters theta in R^d; theta is a float vector in the order of ``entries``.

    The unit cube is where tuners work: linear entries map affinely, log entries map their logarithm.
    """

    parameters: tuple[Parameter, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "parameters", tuple(self.parameters))
        names = [p.name for p in self.parameters]
        double = {n for n in names if names.count(n) > 1}
        if double:
            raise ValueError(f"parameter names must differ; given twice: {sorted(double)}")

    @property
    def dimension(self) -> int:
        return sum(p.size for p in self.parameters)

    @property
    def entries(self) -> tuple[str, ...]:
        return tuple(e for p in self.parameters for e in p.entries)

    @property
    def lower(self) -> NDArray[np.float64]:
        return np.array([p.lower for p in self.parameters for _ in range(p.size)])

    @property
    def upper(self) -> NDArray[np.float64]:
        return np.array([p.upper for p in self.parameters for _ in range(p.size)])

    @property
    def default(self) -> NDArray[np.float64]:
        """theta_0, the untuned controller."""
        return np.array([v for p in self.parameters for v in (p.default if isinstance(p.default, tuple) else (p.default,))])

    @property
    def slices(self) -> dict[str, slice]:
        """Where each parameter stands in theta."""
        out, start = {}, 0
        for p in self.parameters:
            out[p.name] = slice(start, start + p.size)
            start += p.size
        return out

    def validate(self, theta: ArrayLike) -> NDArray[np.float64]:
        """theta as a float vector; ValueError names the entry, its value and the allowed range."""
        values = np.asarray(theta, dtype=float)
        if values.shape != (self.dimension,):
            raise ValueError(f"theta has shape {values.shape}, expected ({self.dimension},): {', '.join(self.entries)}")
        units = [p.unit for p in self.parameters for _ in range(p.size)]
        for name, value, low, high, unit in zip(self.entries, values, self.lower, self.upper, units, strict=True):
            # A rounding error of the unit-cube transform is not a wrong theta.
            slack = 1e-9 * (high - low)
            if not math.isfinite(value) or not low - slack <= value <= high + slack:
                raise ValueError(f"theta: {name} = {value:g}, allowed is [{low:g}, {high:g}] {'' if unit == '1' else unit}".rstrip())
        return np.asarray(np.clip(values, self.lower, self.upper), dtype=np.float64)

    def from_dict(self, values: dict[str, float | Sequence[float]]) -> NDArray[np.float64]:
        """theta from named values (a parameter or a single entry); what is not named stays at its default."""
        theta, slices, entries = self.default, self.slices, self.entries
        for name, value in values.items():
            given = _numbers(name, value)
            if name in slices:
                size = theta[slices[name]].size
                if given.shape not in ((), (1,), (size,)):
                    allowed = f"one or {size} numbers" if size > 1 else "one number"
                    raise ValueError(f"theta: {name} has {counted(given.size, 'value')}, allowed is {allowed}")
                theta[slices[name]] = given
            elif name in entries:
                if given.size != 1:
                    raise ValueError(f"theta: {name} has {counted(given.size, 'value')}, allowed is one number")
                theta[entries.index(name)] = given.item()
            else:
                raise ValueError(f"theta: unknown name {name!r}, allowed are {', '.join(slices) or '(none)'}")
        return self.validate(theta)

    def to_unit(self, theta: ArrayLike) -> NDArray[np.float64]:
        """Map theta, shape (..., d), to the unit cube."""
        t = np.asarray(theta, dtype=float)
        log = self._log
        low, high = self._transformed_bounds()
        return np.asarray((np.where(log, np.log(np.where(log, t, 1.0)), t) - low) / (high - low))

    def from_unit(self, unit: ArrayLike) -> NDArray[np.float64]:
        """Map points of the unit cube, shape (..., d), to theta; inverse of `to_unit`."""
        low, high = self._transformed_bounds()
        t = low + np.asarray(unit, dtype=float) * (high - low)
        theta = np.where(self._log, np.exp(np.where(self._log, t, 0.0)), t)
        return np.asarray(np.clip(theta, self.lower, self.upper), dtype=np.float64)

    @property
    def _log(self) -> NDArray[np.bool_]:
        return np.array([p.scale == "log" for p in self.parameters for _ in range(p.size)], dtype=bool)

    def _transformed_bounds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        log = self._log
        low, high = self.lower, self.upper
        return (
            np.where(log, np.log(np.where(log, low, 1.0)), low),
            np.where(log, np.log(np.where(log, high, 1.0)), high),
        )


def _numbers(name: str, value: object) -> NDArray[np.float64]:
    try:
        return np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        raise ValueError(f"theta: {name} = {value!r}, allowed is a number or a list of numbers") from None
