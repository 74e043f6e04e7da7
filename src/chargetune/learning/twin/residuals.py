"""What was measured of an episode, and residuals averaged over bins because neighbours have one cause."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from chargetune.episode.episode import Episode
from chargetune.learning.twin.twin import Twin

__all__ = ["binned_residuals", "measured"]


def measured(twin: Twin, episode: Episode) -> NDArray[np.float64]:
    """The twin's measured outputs at both ends of every interval, shape (K, 2, number of measured outputs)."""
    return np.stack([np.stack(episode.signal(name), axis=1) for name in twin.noise_sd], axis=2)


def binned_residuals(values: NDArray[np.float64], bins: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Means over so many bins of values (K, 2, n) at both ends of intervals, and how many were finite; shapes (<= bins, n)."""
    parts = min(bins, len(values))
    sizes = np.full(parts, len(values) // parts) + (np.arange(parts) < len(values) % parts)
    starts = np.cumsum(sizes) - sizes
    seen = np.isfinite(values)
    counts = np.add.reduceat(seen.sum(axis=1), starts, axis=0).astype(np.float64)
    totals = np.add.reduceat(np.where(seen, values, 0.0).sum(axis=1), starts, axis=0)
    return np.where(counts > 0, totals / np.maximum(counts, 1.0), np.nan), counts
