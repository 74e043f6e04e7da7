"""Score: what one episode was worth, and how far it went beyond each limit."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from chargetune.episode.html_repr import facts, table

__all__ = ["Score", "in_tolerances"]


@dataclass(frozen=True)
class Score:
    """The verdict on one closed-loop episode.

    objective
        To be maximised; finite. What a constrained tuner improves, penalties not included.
    performance
        The scalar G(theta) of the paper's Algorithm 1, penalties included; finite.
    excess
        For each limit the worst signed excess over the episode in the unit of the limit:
        positive is a violation, negative the smallest distance that was kept.
    tolerance
        For each limit the excess still called "kept" (measurement resolution, solver tolerance), same unit.
    profile
        Optional, for a limit of ``excess``: its worst excess in each of several windows of the episode (SOC, position),
        None where the episode never was. The largest entry is the limit's excess. A tuner learns much more from it.
    metrics
        Named figures with the unit in the name (``t80_min``); None where the episode never got there.
    """

    objective: float
    performance: float
    excess: Mapping[str, float]
    tolerance: Mapping[str, float]
    metrics: Mapping[str, float | None] = field(default_factory=dict)
    profile: Mapping[str, tuple[float | None, ...]] = field(default_factory=dict)

    @property
    def beyond(self) -> dict[str, float]:
        """Excess less tolerance of each limit, in tolerances, so that limits of different units can be compared."""
        return {name: float(in_tolerances(value, self.tolerance.get(name, 0.0))) for name, value in self.excess.items()}

    @property
    def worst(self) -> float:
        """The largest of `beyond`: more than 0 when a limit is broken; inf where one is no number, -inf where there is no limit."""
        return max((math.inf if math.isnan(value) else value for value in self.beyond.values()), default=-math.inf)

    @property
    def feasible(self) -> bool:
        """Whether every limit was kept within its tolerance."""
        return all(value <= self.tolerance.get(name, 0.0) for name, value in self.excess.items())

    def _repr_html_(self) -> str:
        limits = [(n, e, self.tolerance.get(n, 0.0), e <= self.tolerance.get(n, 0.0)) for n, e in self.excess.items()]
        head = facts("Score", {"limits kept": self.feasible, "objective": self.objective, "performance": self.performance, **self.metrics})
        return head + (table(("limit", "worst excess", "tolerance", "kept"), limits) if limits else "")


def in_tolerances(excess: ArrayLike, tolerance: float, share: float = 1.0) -> NDArray[np.float64]:
    """(excess - share tolerance) / tolerance, any shape; a limit without tolerance counts in its own unit."""
    return np.asarray((np.asarray(excess, dtype=float) - share * tolerance) / (tolerance or 1.0), dtype=np.float64)
