"""What measuring does to an output: bias, noise, quantisation and delay."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from chargetune.model.model import Signal

__all__ = ["Sensors"]


@dataclass(frozen=True)
class Sensors:
    """measured = round((true + bias + noise_sd * standard normal) / resolution) * resolution, per output by name.

    Samples at the start and the end of an interval have independent noise; resolution 0 means no rounding.
    ``delay_steps`` is how many intervals late a sample reaches the controller; the recorded trace is not late.
    """

    noise_sd: Mapping[str, float] = field(default_factory=dict)
    bias: Mapping[str, float] = field(default_factory=dict)
    resolution: Mapping[str, float] = field(default_factory=dict)
    delay_steps: int = 0

    def __post_init__(self) -> None:
        for name in ("noise_sd", "bias", "resolution"):
            for signal, value in getattr(self, name).items():
                number = isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
                if not number or (name != "bias" and value < 0):
                    allowed = "a finite number" if name == "bias" else "a finite number >= 0"
                    raise ValueError(f"sensors: {name} of {signal} = {value!r}, allowed is {allowed}")
        if isinstance(self.delay_steps, bool) or not isinstance(self.delay_steps, int) or not 0 <= self.delay_steps <= 100:
            raise ValueError(f"sensors: delay_steps = {self.delay_steps!r}, allowed is an integer in [0, 100]")

    def vectors(self, outputs: tuple[Signal, ...]) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """(noise_sd, bias, resolution), each of shape (ny,); ValueError names a signal the plant does not have."""
        names = [s.name for s in outputs]
        for field_name in ("noise_sd", "bias", "resolution"):
            unknown = sorted(set(getattr(self, field_name)) - set(names))
            if unknown:
                raise ValueError(f"sensors: {field_name} names unknown {unknown}, allowed are {', '.join(names)}")
        return tuple(np.array([float(getattr(self, f).get(n, 0.0)) for n in names]) for f in ("noise_sd", "bias", "resolution"))  # type: ignore[return-value]
