"""Residuals of whole episodes, averaged over bins because neighbours have one cause."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    pass

__all__ = ["binned_residuals"]

# Stretches of an episode over which residuals are averaged: what a model cannot represent changes slowly.
BINS = 40


# Neighbouring stretches that err together: so many count as one.
CORRELATED_BINS = 4.0


def binned_residuals(values: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Means over `BINS` stretches, of values (K, 2, n) at both ends of intervals, and how many were finite; shapes (<= BINS, n)."""
    parts = min(BINS, len(values))
    sizes = np.full(parts, len(values) // parts) + (np.arange(parts) < len(values) % parts)
    starts = np.cumsum(sizes) - sizes
    seen = np.isfinite(values)
    counts = np.add.reduceat(seen.sum(axis=1), starts, axis=0).astype(np.float64)
    totals = np.add.reduceat(np.where(seen, values, 0.0).sum(axis=1), starts, axis=0)
    return np.where(counts > 0, totals / np.maximum(counts, 1.0), np.nan), counts
