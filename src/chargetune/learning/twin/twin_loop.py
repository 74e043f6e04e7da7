"""What a user's closed loop offers to a tuner that learns a twin of its plant."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from chargetune.episode.episode import Episode
from chargetune.learning.closed_loop.loop import JudgedLoop
from chargetune.learning.twin.discrepancy import DiscrepancySample, NoDiscrepancy
from chargetune.learning.twin.twin import Twin

__all__ = ["Member", "ModelledLoop", "TwinLoop"]

Member = tuple[NDArray[np.float64], NDArray[np.float64], DiscrepancySample | NoDiscrepancy | None]
"""One closed loop: theta of the controller, unknowns of the plant, and what the twin cannot represent of it.

A drawn plant has sensors with noise; the expected one, and one of given unknowns alone (None), have not."""


class ModelledLoop(Protocol):
    """What is unknown of a plant, and what the error of its model depends on."""

    @property
    def twin(self) -> Twin: ...

    @property
    def features(self) -> Mapping[str, tuple[float, float]]:
        """Signals of an episode, with their ranges, that the discrepancy of the twin depends on.

        First the one along which it changes fastest.
        """
        ...


class TwinLoop(JudgedLoop, ModelledLoop, Protocol):
    """The user's closed loop on the twin: what is unknown of the plant, and an episode of any plant of that kind."""

    def simulate(self, members: Sequence[Member]) -> list[Episode | None]:
        """An episode of each member with its true outputs, discrepancy included; None where it fails. Noise is read, not returned."""
        ...

    def violation(self, episode: Episode) -> float:
        """What a measured episode spent of a budget of violation: excess beyond the tolerance, over time, >= 0."""
        ...
