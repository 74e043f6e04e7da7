"""What a controller is connected to."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from chargetune.model.model import Signal

__all__ = ["Measurement", "Plant", "PlantError", "SetUpError"]


class PlantError(RuntimeError):
    """The plant could not carry out the interval (solver failure, lost connection); the episode ends with this reason."""


class SetUpError(ValueError):
    """What is evaluated can never work, whatever theta is: a study ends with it, and no trial is recorded as failed.

    ``details`` is the traceback of what led to it, as text, where that is known.
    """

    def __init__(self, message: str, details: str = "") -> None:
        super().__init__(message, details)
        self.message, self.details = message, details

    def __str__(self) -> str:
        return self.message


@dataclass(frozen=True)
class Measurement:
    """Outputs of one interval as measured, each of shape (ny,).

    ``start`` just after the input jumped, ``end`` just before it jumps again, ``received`` the newest sample that has
    reached the controller (``end``, or an older one where the connection has a delay). ``true_start``, ``true_end``
    and ``state`` are known for simulations only.
    """

    start: NDArray[np.float64]
    end: NDArray[np.float64]
    received: NDArray[np.float64]
    true_start: NDArray[np.float64] | None = None
    true_end: NDArray[np.float64] | None = None
    state: NDArray[np.float64] | None = None


class Plant(Protocol):
    """A simulation, an electrochemical model or a real cell; stepped with one constant input an interval."""

    @property
    def inputs(self) -> tuple[Signal, ...]: ...

    @property
    def outputs(self) -> tuple[Signal, ...]: ...

    @property
    def sampling_time_s(self) -> float: ...

    def reset(self, seed: int) -> Measurement:
        """Bring the plant to its start and measure it at rest (zero input)."""
        ...

    def step(self, u: NDArray[np.float64]) -> Measurement:
        """Apply u, shape (nu,), for one interval. Raises `PlantError` when the interval cannot be carried out."""
        ...

    def close(self) -> None:
        """Leave the plant safe; called once, also after an error."""
        ...
