"""Limits of a charge as data: scored on the plant in any case, kept by the controller where its model predicts them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from chargetune.battery.cell.cell import Cell
from chargetune.battery.validation import check_number
from chargetune.episode.episode import Episode
from chargetune.episode.score_limits import ScoredLimit

__all__ = ["HARD_FACTOR", "Limit", "LimitSettings"]

# The penalty of a hard limit over that of a soft one: nothing soft is worth a violation of it.
HARD_FACTOR = 1e3

SIGNALS = {
    "voltage_max_V": "voltage_V",
    "voltage_min_V": "voltage_V",
    "temperature_max_K": "temperature_K",
    "anode_min_V": "anode_potential_V",
}

Kind = Literal["soft", "hard", "scored"]


@dataclass(frozen=True)
class Limit:
    """A bound of a measured signal at both ends of every interval: voltage_max_V, voltage_min_V, temperature_max_K, anode_min_V.

    kind
        "soft": the controller keeps it by an exact penalty; "hard": by a penalty a thousand times larger, so that no
        soft limit and no objective is worth breaking it (the problem always has a solution, a limit that cannot be kept
        is broken by as little as possible); "scored": the controller does not see it.
    tolerance
        The excess still called kept, in the unit of the signal.
    """

    name: str
    bound: float
    tolerance: float
    kind: Kind = "soft"

    def __post_init__(self) -> None:
        if self.name not in SIGNALS:
            raise ValueError(f"limit: name = {self.name!r}, allowed are {', '.join(SIGNALS)}")

    @property
    def signal(self) -> str:
        return SIGNALS[self.name]

    @property
    def upper(self) -> bool:
        return "_max_" in self.name

    @property
    def of(self) -> str:
        """What is limited: voltage, temperature or anode."""
        return self.name.split("_", maxsplit=1)[0]

    @property
    def unit(self) -> str:
        return self.name.rpartition("_")[2]

    def scored(self, samples: int = 1, tolerance: float | None = None) -> ScoredLimit:
        """The same for the verdict: on the moving mean of ``samples`` intervals, with another tolerance where one is given.

        The lower voltage limit is met at rest, not along the charge: it has no profile.
        """
        side = {"upper" if self.upper else "lower": self.bound}
        kept = self.tolerance if tolerance is None else tolerance
        return ScoredLimit(self.signal, **side, tolerance=kept, name=self.name, samples=samples, by_window=self.name != "voltage_min_V")

    def excess(self, episode: Episode, samples: int = 1) -> NDArray[np.float64]:
        """By how much each interval is beyond the limit, the worse of its two ends, shape (K,): `ScoredLimit.excess`.

        ``samples`` > 1 judges the moving mean of as many intervals, for measurements with noise: the largest of 720 samples with a
        standard deviation of 2 mV is 6 mV above the truth.
        """
        return self.scored(samples).excess(episode)

    def metrics(self, episode: Episode, samples: int = 1) -> dict[str, float]:
        """Worst excess (signed) and its integral over time, in mV and mV s or K and K s.

        The integral takes the mean of the excess at both ends of an interval.
        """
        factor, unit = (1e3, "mV") if self.unit == "V" else (1.0, self.unit)
        short = self.name.rpartition("_")[0]
        over = self.scored(samples).excess_at_ends(episode)
        return {
            f"{short}_excess_{unit}": float(factor * np.max(over)),
            f"{short}_excess_{unit}s": float(factor * episode.sampling_time_s * np.sum(np.maximum(0.0, over).mean(axis=0))),
        }


@dataclass(frozen=True)
class LimitSettings:
    """Limits; what is not given comes from the cell, or is no limit.

    Limits that the controller's model predicts are kept by it softly. ``hard`` and ``scored_only`` name those that it keeps at any
    price, or does not see.
    """

    current_min_A: float = 0.0
    """Lowest current; 0: the cell is not discharged."""
    current_max_A: float | None = None
    """Largest current; not given: the cell's."""
    voltage_min_V: float | None = None
    """Lower limit of the voltage; not given: the cell's."""
    voltage_max_V: float | None = None
    """Upper limit of the voltage; not given: the cell's."""
    tolerance_V: float = 5e-4
    """Excess over a voltage limit that is still called kept."""
    temperature_max_K: float | None = None
    """Upper limit of the temperature; not given: no limit."""
    tolerance_K: float = 0.05
    """Excess over the temperature limit that is still called kept."""
    anode_min_V: float | None = None
    """Lower limit of the anode potential against lithium, below 0 V lithium plates; not given: no limit."""
    tolerance_anode_V: float = 5e-4
    """Excess beyond the anode's limit that is still called kept."""
    hard: tuple[str, ...] = ()
    """Limits that are worth more than every soft one and the objective: names of limits that are set."""
    scored_only: tuple[str, ...] = ()
    """Limits that are judged but that the controller does not see: names of limits that are set."""

    def __post_init__(self) -> None:
        check_number("tolerance_V", self.tolerance_V, 0.0, 0.1, "V")
        if self.temperature_max_K is not None:
            check_number("temperature_max_K", self.temperature_max_K, 250.0, 400.0, "K (was it given in degC?)")
        if self.anode_min_V is not None:
            check_number("anode_min_V", self.anode_min_V, -0.5, 0.5, "V")
        check_number("tolerance_K", self.tolerance_K, 0.0, 10.0, "K")
        check_number("tolerance_anode_V", self.tolerance_anode_V, 0.0, 0.1, "V")
        for label in ("hard", "scored_only"):
            object.__setattr__(self, label, tuple(getattr(self, label)))
        names = [name for name in SIGNALS if name.startswith("voltage") or getattr(self, name) is not None]
        for label in ("hard", "scored_only"):
            unknown = sorted(set(getattr(self, label)) - set(names))
            if unknown:
                raise ValueError(f"{label} names {', '.join(unknown)}, allowed are the limits that are set: {', '.join(names)}")

    def by_name(self, cell: Cell) -> dict[str, Limit]:
        """Every limit that is set on this cell, in the order of the score."""
        predicted = {"voltage": True, "temperature": cell.thermal is not None, "anode": cell.anode is not None}
        tolerance = {"voltage": self.tolerance_V, "temperature": self.tolerance_K, "anode": self.tolerance_anode_V}
        # The only two limits that a cell has itself.
        own = {"voltage_max_V": cell.voltage_max_V, "voltage_min_V": cell.voltage_min_V}
        out = {}
        for name in SIGNALS:
            given, what = getattr(self, name), name.split("_", maxsplit=1)[0]
            bound = own.get(name) if given is None else given
            unseen = name in self.scored_only or not predicted[what]
            kind: Kind = "scored" if unseen else "hard" if name in self.hard else "soft"
            if bound is not None:
                out[name] = Limit(name, bound, tolerance[what], kind)
        return out
