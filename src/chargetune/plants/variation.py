"""What differs between the plants that a controller meets: distributions, and what of a plant follows them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from chargetune.runtime.counted import counted

__all__ = ["Choice", "Distribution", "LogNormal", "Normal", "StudentT", "Uniform", "Variation"]

# What rounding may take below 0 of an eigenvalue of a correlation, or off 1 of its diagonal.
ROUNDING = 1e-9


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
class StudentT:
    """Student's t with so many degrees of freedom (more than 0): what a mean and a spread of few samples say of the next one."""

    degrees: float

    def __post_init__(self) -> None:
        _check_finite("student", degrees=self.degrees)
        if self.degrees <= 0:
            raise ValueError(f"student: degrees = {self.degrees!r}, allowed is more than 0")

    def at(self, share: NDArray[np.float64]) -> NDArray[np.float64]:
        from scipy.special import stdtrit

        return np.asarray(stdtrit(self.degrees, share), dtype=np.float64)


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
        Parameter of the plant's model -> its sensitivity s, one number or one for each entry: the parameter is multiplied by 1 + s v.
        One v may change several, as age takes capacity and adds resistance.
    starts, biases
        State -> s: s v is added to its start. Measured output -> s: s v is added by the sensor.
    of
        "plant": what stays with a plant, and can be learnt from its traces. "episode": what is new in each episode, and never is.
    by_entry
        Each entry of each parameter has a v of its own, instead of all together.
    log
        The parameter is multiplied by exp(s v) instead of 1 + s v. With a normal v it is log-normal.
    correlation
        Of the numbers of ``by_entry``, of their normal scores e (v = quantile(Phi(e)), Phi the normal distribution): a number c in [0, 1)
        gives c^|i - j| between the entries i and j of one parameter, and none between parameters; a matrix has a row and a column for
        each number, parameter after parameter. The distribution of each number stays as stated (a Gaussian copula).

    Raises ValueError for a number that is not finite, where nothing is changed, for entries of what has none, and for a matrix that is no
    correlation.
    """

    name: str
    distribution: Distribution
    parameters: Mapping[str, float | Sequence[float]] = field(default_factory=dict)
    starts: Mapping[str, float] = field(default_factory=dict)
    biases: Mapping[str, float] = field(default_factory=dict)
    of: Literal["plant", "episode"] = "plant"
    by_entry: bool = False
    log: bool = False
    correlation: float | tuple[tuple[float, ...], ...] = 0.0

    def __post_init__(self) -> None:
        if not (self.parameters or self.starts or self.biases):
            raise ValueError(f"variation {self.name}: changes nothing, allowed is at least one of parameters, starts and biases")
        if self.of not in ("plant", "episode"):
            raise ValueError(f"variation {self.name}: of = {self.of!r}, allowed is 'plant' or 'episode'")
        if self.by_entry and (self.starts or self.biases):
            raise ValueError(f"variation {self.name}: by_entry = True, allowed is that only where parameters alone are changed")
        for name, value in self.parameters.items():
            entries = {name: value} if np.ndim(value) == 0 else {f"{name}[{i}]": one for i, one in enumerate(value)}  # type: ignore[arg-type]
            _check_finite(f"variation {self.name}: parameters", **entries)
        for label in ("starts", "biases"):
            _check_finite(f"variation {self.name}: {label}", **getattr(self, label))
        self._check_correlation()

    def _check_correlation(self) -> None:
        c, where = self.correlation, f"variation {self.name}: correlation"
        if np.ndim(c) == 0:
            if isinstance(c, bool) or not isinstance(c, (int, float)) or not 0 <= c < 1:
                raise ValueError(f"{where} = {c!r}, allowed is [0, 1), or a matrix")
        else:
            matrix = np.asarray(c, dtype=np.float64)
            square = matrix.ndim == 2 and matrix.shape[0] == matrix.shape[1]
            if not square or not np.allclose(matrix, matrix.T) or not np.allclose(np.diag(matrix), 1.0, atol=ROUNDING):
                raise ValueError(f"{where} has the shape {matrix.shape}, allowed is a symmetric matrix with ones on its diagonal")
            if (least := float(np.linalg.eigvalsh(matrix)[0])) < -ROUNDING * len(matrix):
                raise ValueError(f"{where} has an eigenvalue {least:.3g}, allowed are none below 0")
        if not self.by_entry and self.correlated:
            raise ValueError(f"{where} is given, allowed is that only with by_entry = True")

    @property
    def correlated(self) -> bool:
        """Whether its numbers depend on each other."""
        return np.ndim(self.correlation) > 0 or self.correlation != 0

    def factor(self, parameter: str, value: ArrayLike) -> NDArray[np.float64]:
        """What the parameter is multiplied by at these v, one or one for each entry."""
        moved = np.asarray(self.parameters[parameter]) * np.asarray(value)
        return np.asarray(np.exp(moved) if self.log else 1.0 + moved)

    def log_factor(self, parameter: str, value: ArrayLike) -> NDArray[np.float64]:
        """Its natural logarithm."""
        moved = np.asarray(self.parameters[parameter]) * np.asarray(value)
        return np.asarray(moved if self.log else np.log1p(moved))

    def mixing(self, blocks: Mapping[str, int]) -> NDArray[np.float64]:
        """L of this variation's numbers: with e ~ N(0, I) the normal scores L e have the correlation. ``blocks``: entries by parameter.

        The symmetric root of the correlation, which is the same on every machine, also where it is singular. Raises ValueError where a
        matrix does not have a row for each number.
        """
        from scipy.linalg import block_diag

        if not self.by_entry:
            return np.eye(1)
        if np.ndim(self.correlation) == 0:
            places = [np.arange(blocks[name]) for name in self.parameters]
            matrix = block_diag(*(float(self.correlation) ** np.abs(i[:, None] - i) for i in places))  # type: ignore[arg-type]
        else:
            matrix = np.asarray(self.correlation, dtype=np.float64)
        numbers = sum(blocks[name] for name in self.parameters)
        if len(matrix) != numbers:
            raise ValueError(
                f"variation {self.name}: correlation has {counted(len(matrix), 'row')}, allowed is one for each of {numbers} numbers"
            )
        values, vectors = np.linalg.eigh(matrix)
        return np.asarray((vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T)


def _check_finite(where: str, **values: object) -> None:
    for name, value in values.items():
        if not isinstance(value, (int, float)) or isinstance(value, bool) or not math.isfinite(value):
            raise ValueError(f"{where}: {name} = {value!r}, allowed is a finite number")
