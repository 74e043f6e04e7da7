"""What differs between the plants that a controller meets: distributions, and what of a plant follows them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

__all__ = ["Choice", "Distribution", "LogNormal", "Normal", "Uniform", "Variation"]


class Distribution(Protocol):
    """A distribution of one number by its quantile function."""

    def at(self, share: NDArray[np.float64]) -> NDArray[np.float64]:
        """Quantiles of these shares in (0, 1), any shape."""
        ...


@dataclass(frozen=True)
class Uniform:
    """Uniform on [lower, upper]."""

    lower: float
    upper: float

    def __post_init__(self) -> None:
        _check_finite("uniform", lower=self.lower, upper=self.upper)
        if self.lower > self.upper:
            raise ValueError(f"uniform: lower = {self.lower!r}, allowed is at most upper = {self.upper!r}")

    def at(self, share: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(self.lower + (self.upper - self.lower) * share)


@dataclass(frozen=True)
class Normal:
    """Normal with this mean and standard deviation."""

    mean: float
    sd: float

    def __post_init__(self) -> None:
        _check_finite("normal", mean=self.mean, sd=self.sd)
        if self.sd < 0:
            raise ValueError(f"normal: sd = {self.sd!r}, allowed is >= 0")

    def at(self, share: NDArray[np.float64]) -> NDArray[np.float64]:
        from scipy.special import ndtri

        return np.asarray(self.mean + self.sd * ndtri(share))


@dataclass(frozen=True)
class LogNormal:
    """exp of a normal: its median, and the standard deviation of its logarithm."""

    median: float
    log_sd: float

    def __post_init__(self) -> None:
        _check_finite("log-normal", median=self.median, log_sd=self.log_sd)
        if self.median <= 0 or self.log_sd < 0:
            raise ValueError(f"log-normal: median = {self.median!r}, log_sd = {self.log_sd!r}, allowed are a median > 0 and a log_sd >= 0")

    def at(self, share: NDArray[np.float64]) -> NDArray[np.float64]:
        from scipy.special import ndtri

        return np.asarray(self.median * np.exp(self.log_sd * ndtri(share)))


@dataclass(frozen=True)
class Choice:
    """One of these values, each as likely."""

    values: tuple[float, ...]

    def __post_init__(self) -> None:
        if not self.values:
            raise ValueError("choice: values = (), allowed is at least one")
        _check_finite("choice", **{f"values[{i}]": value for i, value in enumerate(self.values)})

    def at(self, share: NDArray[np.float64]) -> NDArray[np.float64]:
        index = np.minimum((share * len(self.values)).astype(int), len(self.values) - 1)
        chosen: NDArray[np.float64] = np.asarray(self.values, dtype=np.float64)[index]
        return chosen


@dataclass(frozen=True)
class Variation:
    """A number v that differs from plant to plant or from episode to episode, and what it changes.

    name
        Of the number in tables and figures.
    distribution
        Of v.
    parameters
        Parameter of the plant's model -> its sensitivity s: the parameter is multiplied by 1 + s v. One v may change several, as age
        takes capacity and adds resistance.
    starts, biases
        State -> s: s v is added to its start. Measured output -> s: s v is added by the sensor.
    of
        "plant": what stays with a plant, and can be learnt from its traces. "episode": what is new in each episode, and never is.
    by_entry
        Each entry of each parameter has a v of its own, instead of all together.

    Raises ValueError for a number that is not finite, where nothing is changed, and for entries of what has none.
    """

    name: str
    distribution: Distribution
    parameters: Mapping[str, float] = field(default_factory=dict)
    starts: Mapping[str, float] = field(default_factory=dict)
    biases: Mapping[str, float] = field(default_factory=dict)
    of: Literal["plant", "episode"] = "plant"
    by_entry: bool = False

    def __post_init__(self) -> None:
        if not (self.parameters or self.starts or self.biases):
            raise ValueError(f"variation {self.name}: changes nothing, allowed is at least one of parameters, starts and biases")
        if self.of not in ("plant", "episode"):
            raise ValueError(f"variation {self.name}: of = {self.of!r}, allowed is 'plant' or 'episode'")
        if self.by_entry and (self.starts or self.biases):
            raise ValueError(f"variation {self.name}: by_entry = True, allowed is that only where parameters alone are changed")
        for label in ("parameters", "starts", "biases"):
            _check_finite(f"variation {self.name}: {label}", **getattr(self, label))


def _check_finite(where: str, **values: object) -> None:
    for name, value in values.items():
        if not isinstance(value, (int, float)) or isinstance(value, bool) or not math.isfinite(value):
            raise ValueError(f"{where}: {name} = {value!r}, allowed is a finite number")
