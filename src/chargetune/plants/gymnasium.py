"""A Gymnasium environment as plant (extra ``gym``)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from chargetune.model.model import Signal
from chargetune.plants.plant import Measurement, PlantError
from chargetune.runtime.counted import counted

__all__ = ["GymnasiumPlant"]


@dataclass
class GymnasiumPlant:
    """``env`` (gymnasium.Env with Box spaces) under one constant action an interval; what it rewards is not used.

    outputs
        Signals of the observation, in its order, or of what ``observe`` makes of it: observation -> outputs, shape (ny,).

    An output has no direct feedthrough: at the start of an interval it is as at the end of the one before. ``reset`` seeds the
    environment. An environment that ends itself (terminated) or is past its time (truncated) is a `PlantError`.
    """

    env: Any
    inputs: tuple[Signal, ...]
    outputs: tuple[Signal, ...]
    sampling_time_s: float
    observe: Callable[[NDArray[np.float64]], ArrayLike] | None = None
    _seen: NDArray[np.float64] = field(init=False, repr=False, compare=False, default_factory=lambda: np.zeros(0))
    _over: str = field(init=False, repr=False, compare=False, default="the environment was not reset before its first step")

    def __post_init__(self) -> None:
        self.inputs, self.outputs = tuple(self.inputs), tuple(self.outputs)
        shape = getattr(self.env.action_space, "shape", None)
        if getattr(self.env.action_space, "low", None) is None or not shape or int(np.prod(shape)) != len(self.inputs):
            raise ValueError(
                f"environment: action space {self.env.action_space}, allowed is "
                f"a Box of {counted(len(self.inputs), 'number')}: {_named(self.inputs)}"
            )

    def reset(self, seed: int) -> Measurement:
        """The environment's first observation; it has seen no action yet."""
        observation, _ = self.env.reset(seed=seed)
        self._seen, self._over = self._outputs(observation), ""
        return Measurement(self._seen, self._seen, self._seen)

    def step(self, u: NDArray[np.float64]) -> Measurement:
        """One step of the environment. Raises `PlantError` when it has ended."""
        if self._over:
            raise PlantError(self._over)
        space = self.env.action_space
        low, high = (np.asarray(bound, dtype=np.float64).ravel() for bound in (space.low, space.high))
        slack = 1e-6 * (1.0 + np.abs(u))
        if np.any(u < low - slack) or np.any(u > high + slack):
            raise PlantError(f"input = {np.asarray(u).tolist()} is outside the action space [{low.tolist()}, {high.tolist()}]")
        action = np.clip(u, low, high).astype(space.dtype).reshape(space.shape)
        observation, _, terminated, truncated, _ = self.env.step(action)
        before, self._seen = self._seen, self._outputs(observation)
        if terminated:
            self._over = "the environment terminated"
            raise PlantError(self._over)
        # The interval itself was carried out.
        self._over = "the environment is past its time limit (truncated)" if truncated else ""
        return Measurement(before, self._seen, self._seen)

    def close(self) -> None:
        self.env.close()

    def _outputs(self, observation: Any) -> NDArray[np.float64]:
        values = np.asarray(observation, dtype=np.float64).ravel()
        seen = values if self.observe is None else np.asarray(self.observe(values), dtype=np.float64).ravel()
        if seen.shape != (len(self.outputs),):
            raise ValueError(f"environment: observed: {counted(seen.size, 'number')}, expected {len(self.outputs)}: {_named(self.outputs)}")
        return seen


def _named(signals: Sequence[Signal]) -> str:
    return ", ".join(signal.name for signal in signals)
