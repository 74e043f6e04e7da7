"""Iterative learning without a plant model: after each trial, theta is corrected so that the controller predicts what was measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import savgol_filter

from chargetune.episode.episode import Episode
from chargetune.learning.closed_loop.covering import covering, predicted_rows
from chargetune.learning.closed_loop.loop import ClosedLoop
from chargetune.learning.tuner import TrialLike, check_count
from chargetune.model.parameter_space import ParameterSpace

__all__ = ["IterativeLearning"]


@dataclass(frozen=True)
class IterativeLearning:
    """The theta whose predictions cover what the last trial measured (`covering`).

    At every sample of the newest trace the error of the controller's prediction is e_k - c_k: measured minus predicted excess over a
    limit. It is smoothed (Savitzky-Golay filter, order 2, ``window`` samples), then added to the prediction: in full where it asks for
    more caution, by the share ``relax`` where it allows less. The first theta is ``start``, or theta_0.
    It is fast and promises nothing: it knows only what the last trial went through.
    Raises ValueError for relax outside (0, 1], window below 3, and a controller with given signals.
    Source: Bristow et al., IEEE Control Syst. Mag. 26 (2006) 96.
    """

    loop: ClosedLoop
    relax: float = 0.7
    window: int = 21
    start: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        if isinstance(self.relax, bool) or not 0.0 < self.relax <= 1.0:
            raise ValueError(f"iterative learning: relax = {self.relax!r}, allowed is (0, 1]")
        if isinstance(self.window, bool) or not isinstance(self.window, int) or self.window < 3:
            raise ValueError(f"iterative learning: window = {self.window!r}, allowed is an integer >= 3")
        told = ", ".join(self.loop.controller.given_names)
        if told:
            raise ValueError(f"iterative learning: the controller's given = {told}, allowed is none: episodes do not hold given signals")

    def ask(self, space: ParameterSpace, trials: Sequence[TrialLike], n: int = 1) -> NDArray[np.float64]:
        """The next theta, repeated ``n`` times, because each step needs the trial before it; shape (n, d)."""
        check_count(n)
        first = space.default if self.start is None else space.validate(np.array(self.start))
        for trial in reversed(trials):
            reader = getattr(trial, "episode", None)
            episode = None if reader is None else reader()
            if episode is not None and len(episode) > 1:
                first = self._step(np.array(trial.theta), episode)
                break
        return np.tile(first, (n, 1))

    def _step(self, theta: NDArray[np.float64], episode: Episode) -> NDArray[np.float64]:
        controller = self.loop.controller
        predicted, _ = predicted_rows(controller, episode, theta)
        error = _smooth(self.loop.measured_rows(episode) - predicted, self.window)
        wanted = predicted + np.where(error < 0, self.relax * error, error)
        return covering(controller, episode, theta, wanted)


def _smooth(values: NDArray[np.float64], window: int) -> NDArray[np.float64]:
    """Values (K, ...) smoothed along the first axis; gaps are interpolated for the filter and stay nan in the result."""
    out, at = np.full_like(values, np.nan), np.arange(len(values))
    length = min(window, len(values))
    for index in np.ndindex(*values.shape[1:]):
        column = values[(slice(None), *index)]
        known = np.isfinite(column)
        if known.any():
            bridged = np.interp(at, at[known], column[known])
            smooth = savgol_filter(bridged, length, 2) if length > 2 else bridged
            out[(slice(None), *index)] = np.where(known, smooth, np.nan)
    return out
