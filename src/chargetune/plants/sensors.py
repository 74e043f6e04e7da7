"""What measuring does to an output: bias, noise, quantisation and delay."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from chargetune.model.model import Signal
from chargetune.plants.plant import Measurement
from chargetune.runtime.numeric import is_finite, is_integer

__all__ = ["Readout", "Sensors"]


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
                if not is_finite(value) or (name != "bias" and value < 0):
                    allowed = "a finite number" if name == "bias" else "a finite number >= 0"
                    raise ValueError(f"sensors: {name} of {signal} = {value!r}, allowed is {allowed}")
        if not is_integer(self.delay_steps) or not 0 <= self.delay_steps <= 100:
            raise ValueError(f"sensors: delay_steps = {self.delay_steps!r}, allowed is an integer in [0, 100]")

    def vectors(self, outputs: tuple[Signal, ...]) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """(noise_sd, bias, resolution), each of shape (ny,); ValueError names a signal the plant does not have."""
        names = [s.name for s in outputs]
        for field_name in ("noise_sd", "bias", "resolution"):
            unknown = sorted(set(getattr(self, field_name)) - set(names))
            if unknown:
                raise ValueError(f"sensors: {field_name} names unknown {unknown}, allowed are {', '.join(names)}")
        return tuple(np.array([float(getattr(self, f).get(n, 0.0)) for n in names]) for f in ("noise_sd", "bias", "resolution"))  # type: ignore[return-value]


class Readout:
    """The sensors of one episode of a plant that is stepped: true outputs in, `Measurement` out.

    A standard normal number is drawn from ``stream`` for each output at both ends of each interval, in order of time.
    """

    def __init__(self, sensors: Sensors, outputs: tuple[Signal, ...], stream: np.random.Generator) -> None:
        self._sd, self._bias, self._resolution = sensors.vectors(outputs)
        self._stream = stream
        self._perfect = not (self._sd.any() or self._bias.any() or self._resolution.any())
        self._sent: deque[NDArray[np.float64]] = deque(maxlen=sensors.delay_steps + 1)

    def read(self, before: NDArray[np.float64], after: NDArray[np.float64], state: NDArray[np.float64] | None = None) -> Measurement:
        """What is measured of an interval with these true outputs at its two ends; the first call is the plant at rest."""
        start, end = before, after
        if not self._perfect:
            noise = self._sd * self._stream.standard_normal((2, len(before))) if self._sd.any() else 0.0
            raw = np.array([before, after]) + self._bias + noise
            step = np.where(self._resolution > 0, self._resolution, 1.0)
            start, end = np.where(self._resolution > 0, np.floor(raw / step + 0.5) * step, raw)
        self._sent.extend([end] * (1 if self._sent else self._sent.maxlen or 1))
        return Measurement(start, end, self._sent[0], before, after, state)
