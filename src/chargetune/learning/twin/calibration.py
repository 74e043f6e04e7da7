"""How well predictions of the twin held, and how far what its discrepancy states can be trusted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from chargetune.episode.episode import Episode
from chargetune.learning.twin.discrepancy import Discrepancy
from chargetune.learning.twin.residuals import binned_residuals, measured
from chargetune.learning.twin.rollout import predict

__all__ = ["SCALES", "PredictionCheck", "check_prediction", "scale_quantile"]

# Scales that are told apart.
SCALES = np.geomspace(0.1, 10.0, 61)


class PredictionCheck(NamedTuple):
    """What the prediction of one episode says."""

    log_likelihood: NDArray[np.float64]
    """Log likelihood of each of `SCALES`."""
    standardised_error: float
    """Root mean square error over the sd of noise, unknowns and ``Twin.discrepancy_sd_floor``; several say that the twin is none."""


def scale_quantile(checks: Sequence[PredictionCheck], prior_sd: float, share: float) -> float:
    """The discrepancy's scale s that this share of its distribution after these checks does not exceed.

    p(s | checks) ~ exp(-ln(s)^2 / (2 prior_sd^2)) prod_k p(check k | s), on `SCALES`.
    """
    log_density = -0.5 * (np.log(SCALES) / prior_sd) ** 2 + sum(one.log_likelihood for one in checks)
    cumulated = np.cumsum(np.exp(log_density - np.max(log_density)))
    return float(SCALES[np.searchsorted(cumulated, share * cumulated[-1])])


def check_prediction(discrepancy: Discrepancy, episode: Episode) -> PredictionCheck:
    """How well an episode that was not learnt from was predicted, at its recorded inputs.

    Each bin of the episode differs by r ~ N(0, d(s)^2 + v) from its prediction: d(s) the standard deviation that the discrepancy with
    the scale s states there, v from noise and unknowns. Neighbouring bins err together, so as many as are correlated count as one; and
    each counts by the share of its prior variance that d(1)^2 still is: what was measured before comes out as it was, however wrong
    the process is elsewhere.
    """
    posterior, settings, twin = discrepancy.posterior, discrepancy.settings, discrepancy.posterior.twin
    under = twin.under(episode)
    predicted = predict(under, posterior.mode, episode.input)
    columns = [episode.output_names.index(name) for name in twin.noise_sd]
    filled = replace(episode, output_start=episode.output_start.copy(), output_end=episode.output_end.copy())
    filled.output_start[:, columns], filled.output_end[:, columns] = predicted[:, 0], predicted[:, 1]
    filled = discrepancy.mean(posterior.mode)(filled)
    error, counts = binned_residuals(measured(twin, episode) - measured(twin, filled), settings.bins)
    known = (counts > 0) & np.isfinite(error)
    if not known.any():
        return PredictionCheck(np.zeros_like(SCALES), 0.0)
    noise = np.array(list(twin.noise_sd.values()))
    own = binned_residuals(posterior.predicted_sd(episode.input, under) ** 2, settings.bins)[0] - posterior.discrepancy_sd**2 - noise**2
    weights, parts = discrepancy.lookup_table.weights(discrepancy.at(episode)), discrepancy.stated
    unmodelled = np.stack([part.variances(weights, np.array([1.0, *SCALES])) for part in parts], axis=2)
    before = np.stack([part.prior_variance(weights) for part in parts], axis=1)
    rest = np.maximum(own, 0.0) + noise**2 / np.maximum(counts, 1.0)
    novel = np.divide(unmodelled[0], before, out=np.zeros_like(before), where=before > 0)
    variance = unmodelled[1:, known] + rest[known]
    log_likelihood = -0.5 * np.sum(novel[known] * (np.log(variance) + error[known] ** 2 / variance), axis=1) / settings.correlated_bins
    stated = np.array([twin.discrepancy_sd_floor.get(name, 0.0) for name in twin.noise_sd])
    return PredictionCheck(log_likelihood, float(np.sqrt(np.mean((error**2 / (rest + stated**2))[known]))))
