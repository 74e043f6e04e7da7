"""How well predictions of the twin held, and by how much its discrepancy has to be scaled."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

__all__ = ["PredictionCheck", "calibrate_scale"]

# Scales that are told apart.
SCALES = np.geomspace(0.1, 10.0, 61)


class PredictionCheck(NamedTuple):
    """What the prediction of one episode says."""

    chance: NDArray[np.float64]
    """Logarithm of the likelihood of each of `SCALES`."""
    standardised_error: float
    """Root mean square of what it was off by, over noise, unknowns and ``Twin.discrepancy_sd_floor``; several say that the twin is none."""


def calibrate_scale(predicted_before: Sequence[PredictionCheck], sure: float = 0.5) -> float:
    """How many times larger than ``Twin.discrepancy_sd_floor`` states the discrepancy may be where nothing was measured, after these predictions.

    The factor s on that floor, as `Discrepancy.scaled` applies it, that is not exceeded with probability ``sure``; ln s ~ N(0, 1) before
    the first of them.
    """
    chance = -0.5 * np.log(SCALES) ** 2 + sum(one.chance for one in predicted_before)
    known_to = np.cumsum(np.exp(chance - np.max(chance)))
    return float(SCALES[np.searchsorted(known_to, sure * known_to[-1])])
