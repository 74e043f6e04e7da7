"""Plants whose next interval can be tried with any current."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from chargetune.battery.plants.electrochemical import ElectrochemicalPlant
from chargetune.model.model import Signal
from chargetune.plants.plant import Plant
from chargetune.plants.simulated import SimulatedPlant
from chargetune.runtime.numpy_call import numpy_call

__all__ = ["SteppablePlant", "as_steppable"]


class SteppablePlant(Protocol):
    """A plant whose next interval can be tried with any current from any state it was in."""

    @property
    def outputs(self) -> tuple[Signal, ...]: ...

    @property
    def sampling_time_s(self) -> float: ...

    @property
    def start(self) -> Any:
        """The state at rest before the first interval."""
        ...

    def ahead(self, state: Any, current_A: float) -> tuple[NDArray[np.float64], NDArray[np.float64], Any]:
        """(true outputs at the start, at the end, state at the end) of one interval."""
        ...


@dataclass(frozen=True)
class _Circuit:
    """A simulated plant without its sensors and its process noise."""

    plant: SimulatedPlant

    @property
    def outputs(self) -> tuple[Signal, ...]:
        return self.plant.outputs

    @property
    def sampling_time_s(self) -> float:
        return self.plant.sampling_time_s

    @property
    def start(self) -> NDArray[np.float64]:
        return self.plant.start_state

    def ahead(self, state: Any, current_A: float) -> tuple[NDArray[np.float64], NDArray[np.float64], Any]:
        first, last, following = numpy_call(self._interval, state, current_A)
        return first.ravel(), last.ravel(), following.ravel()

    @cached_property
    def _interval(self) -> ca.Function:
        """(state, current) -> (outputs at the start, at the end, state at the end): one call, as a search makes thousands."""
        model = self.plant.model
        x, u, p = ca.SX.sym("x", len(self.start)), ca.SX.sym("u"), model.nominal
        following = model.f(x, u, p)
        results = (model.h(x, u, p), model.h(following, u, p), following)
        return ca.Function("interval", [x, u], [ca.densify(one) for one in results])


def as_steppable(plant: Plant) -> SteppablePlant | None:
    """The plant as one whose next interval can be tried; None when it cannot (an instrument)."""
    if isinstance(plant, SimulatedPlant):
        return _Circuit(plant)
    return plant if isinstance(plant, ElectrochemicalPlant) else None
