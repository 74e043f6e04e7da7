"""What a closed loop offers to a search for theta."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from chargetune.control.controller import Controller
from chargetune.episode.episode import Episode
from chargetune.episode.score import Score, in_tolerances

__all__ = ["ClosedLoop", "JudgedLoop", "Simulate", "samples_of", "windows_of"]

Simulate = Callable[[Sequence[NDArray[np.float64]]], list[Episode | None]]
"""thetas -> the episode of each on one simulated plant, None where it fails."""


def windows_of(score: Score, share: float = 1.0) -> NDArray[np.float64]:
    """Excess less this share of the tolerance, in tolerances, one entry a limit, or one a window where there is a profile.

    nan for a window that was not visited. A limit without tolerance counts in its own unit.
    """
    out: list[float] = []
    for name, worst in score.excess.items():
        tolerance = score.tolerance.get(name, 0.0)
        windows = score.profile.get(name, (worst,))
        out += [np.nan if w is None else float(in_tolerances(w, tolerance, share)) for w in windows]
    return np.array(out)


def samples_of(
    score: Score, samples: Mapping[str, tuple[NDArray[np.float64], NDArray[np.int_]]], share: float = 1.0
) -> tuple[NDArray[np.float64], NDArray[np.int_]]:
    """The samples (`JudgedLoop.samples`) that the windows of `windows_of` are the largest of, and the entry of each, shapes (n,)."""
    values, windows, first = [np.zeros(0)], [np.zeros(0, dtype=int)], 0
    for name in score.excess:
        tolerance = score.tolerance.get(name, 0.0)
        excess, window = samples[name]
        values.append(in_tolerances(excess, tolerance, share))
        windows.append(window + first)
        first += len(score.profile.get(name, (0.0,)))
    return np.concatenate(values), np.concatenate(windows)


class ClosedLoop(Protocol):
    """A controller, and the measured counterpart of the limits that it predicts."""

    @property
    def controller(self) -> Controller: ...

    def measured_rows(self, episode: Episode) -> NDArray[np.float64]:
        """By how much each row of the controller's limits was exceeded at both ends of each interval, shape (K, 2, rows).

        The rows are those of ``controller.limits`` in their order, without any backoff: what the plant did, not what the
        controller was told. nan where nothing was measured, or where the row says nothing of the plant.
        """
        ...

    @property
    def row_tolerances(self) -> NDArray[np.float64]:
        """The excess of each row that is still called kept, shape (rows,)."""
        ...


class JudgedLoop(Protocol):
    """Verdicts on episodes, sample by sample."""

    def score(self, episode: Episode) -> Score | None:
        """The verdict on an episode; None when it has none."""
        ...

    def samples(self, episode: Episode) -> Mapping[str, tuple[NDArray[np.float64], NDArray[np.int_]]]:
        """By limit of the score the excess of every sample, in its unit, and the window of its profile that it counts in, 0 without one."""
        ...
