"""A `Model` with its own parameters as plant, with imperfect sensors and process noise."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from chargetune.model.model import Model, Signal
from chargetune.plants.plant import Measurement, PlantError
from chargetune.plants.sensors import Readout, Sensors
from chargetune.runtime.numeric import is_finite

__all__ = ["SimulatedPlant", "disturbances"]


def disturbances(plant: SimulatedPlant, steps: int, seed: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(additive sensor errors (steps + 1, 2, ny), process noise (steps, nx)) of an episode with this seed.

    Row 0 of the sensor errors belongs to the measurement at rest before the first interval. A longer episode begins
    with the same numbers as a shorter one.
    """
    sd, bias, _ = plant.sensors.vectors(plant.outputs)
    spread = plant.process_sd
    errors = np.tile(bias, (steps + 1, 2, 1))
    process = np.zeros((steps, len(plant.model.states)))
    if not sd.any() and not spread.any():
        # Drawing numbers only to multiply them by zero takes a tenth of the time of an episode.
        return errors, process
    sensor_stream, process_stream = _streams(seed)
    errors += sd * sensor_stream.standard_normal(errors.shape)
    process += spread * process_stream.standard_normal(process.shape)
    return errors, process


@dataclass
class SimulatedPlant:
    """x+ = f(x, u, p) + process noise, y = h(x, u, p), measured through `Sensors`; p are the plant's own parameters.

    ``given`` names scalar parameters of the model that follow given signals in time, as a measured disturbance does;
    ``input_before`` is the input under which the plant is measured before the first interval, 0 by default.
    """

    model: Model
    start: Mapping[str, float]
    sensors: Sensors = field(default_factory=Sensors)
    process_noise_sd: Mapping[str, float] = field(default_factory=dict)
    given: tuple[str, ...] = ()
    input_before: Mapping[str, float] = field(default_factory=dict)
    signals: NDArray[np.float64] | None = field(repr=False, compare=False, default=None)
    _state: NDArray[np.float64] = field(init=False, repr=False, compare=False, default_factory=lambda: np.zeros(0))
    _step: int = field(init=False, repr=False, compare=False, default=0)
    _readout: Readout | None = field(init=False, repr=False, compare=False, default=None)
    _stream: np.random.Generator | None = field(init=False, repr=False, compare=False, default=None)

    def __post_init__(self) -> None:
        states, inputs = self.model.state_names, self.model.input_names
        for label, names, allowed in (
            ("start", self.start, states),
            ("process_noise_sd", self.process_noise_sd, states),
            ("input_before", self.input_before, inputs),
        ):
            unknown = sorted(set(names) - set(allowed))
            if unknown:
                raise ValueError(f"plant: {label} names unknown {unknown}, allowed are {', '.join(allowed)}")
            for name, value in names.items():
                if not is_finite(value) or (label == "process_noise_sd" and value < 0):
                    raise ValueError(f"plant: {label} of {name} = {value!r}, allowed is a finite number{' >= 0' if 'sd' in label else ''}")
        scalars = [name for name, size in self.model.parameter_blocks.items() if size == 1]
        unknown = sorted(set(self.given) - set(scalars))
        if unknown or len(set(self.given)) < len(self.given):
            raise ValueError(f"plant: given = {list(self.given)}, allowed are different ones of {', '.join(scalars) or '(none)'}")
        self.sensors.vectors(self.outputs)

    def following(self, signals: NDArray[np.float64]) -> SimulatedPlant:
        """This plant with the values of its given signals in each interval, shape (steps, signals)."""
        return replace(self, signals=signals)

    @property
    def given_indices(self) -> list[int]:
        """Where the given signals stand in the model's p."""
        first = dict(zip(self.model.parameter_blocks, np.cumsum([0, *self.model.parameter_blocks.values()]), strict=False))
        return [int(first[name]) for name in self.given]

    def _parameters(self) -> NDArray[np.float64]:
        p = self.model.nominal
        if self.given:
            if self.signals is None or self._step >= len(self.signals):
                raise PlantError(f"the plant's given signals {', '.join(self.given)} are not known in interval {self._step}")
            p[self.given_indices] = self.signals[self._step]
        return p

    @property
    def inputs(self) -> tuple[Signal, ...]:
        return self.model.inputs

    @property
    def outputs(self) -> tuple[Signal, ...]:
        return self.model.outputs

    @property
    def sampling_time_s(self) -> float:
        return self.model.sampling_time_s

    @property
    def start_state(self) -> NDArray[np.float64]:
        return np.array([float(self.start.get(n, 0.0)) for n in self.model.state_names])

    @property
    def rest_input(self) -> NDArray[np.float64]:
        """The input before the first interval, shape (nu,)."""
        return np.array([float(self.input_before.get(n, 0.0)) for n in self.model.input_names])

    @property
    def process_sd(self) -> NDArray[np.float64]:
        return np.array([float(self.process_noise_sd.get(n, 0.0)) for n in self.model.state_names])

    def reset(self, seed: int) -> Measurement:
        sensor_stream, self._stream = _streams(seed)
        self._state, self._step = self.start_state, 0
        self._readout = Readout(self.sensors, self.outputs, sensor_stream)
        rest = np.array(self.model.h(self._state, self.rest_input, self._parameters())).ravel()
        return self._readout.read(rest, rest, self._state)

    def step(self, u: NDArray[np.float64]) -> Measurement:
        if self._readout is None or self._stream is None:
            raise PlantError("the plant was not reset before its first step")
        p, spread = self._parameters(), self.process_sd
        before = np.array(self.model.h(self._state, u, p)).ravel()
        noise = spread * self._stream.standard_normal(spread.shape) if spread.any() else 0.0
        self._state = np.array(self.model.f(self._state, u, p)).ravel() + noise
        after = np.array(self.model.h(self._state, u, p)).ravel()
        if not np.all(np.isfinite(self._state)):
            raise PlantError(f"the plant's state is not finite after step {self._step}: {self._state.tolist()}")
        self._step += 1
        return self._readout.read(before, after, self._state)

    def close(self) -> None:
        """Nothing to release."""


def _streams(seed: int) -> tuple[np.random.Generator, np.random.Generator]:
    """Random numbers of an episode: for the sensors and for the process."""
    sensors, process = (np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(2))
    return sensors, process
