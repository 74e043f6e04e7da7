"""What people do today, on any plant whose next interval can be tried: CC-CV, multi-step charging, and the plant oracle.

All are one law: the largest current that is at most c(z) and keeps a set of limits exactly. CC-CV keeps the voltage
with a constant c; step charging has a c that falls; the oracle has no c and keeps every limit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from chargetune.battery.charging.limits import Limit
from chargetune.battery.plants.steppable import SteppablePlant
from chargetune.episode.episode import Ending, Episode
from chargetune.plants.plant import PlantError

__all__ = ["ATTIA_RATES", "CurrentLaw", "attia_fourth_rate", "charge", "constant_current", "four_step", "multi_step"]

# Shares of the largest current in four equal SOC windows up to 80 %, then 1C: the protocol that Attia et al., Nature 578
# (2020) 397, doi 10.1038/s41586-020-1994-5, found best (4.8C-5.2C-5.2C-4.160C, then 1C), relative to its largest rate.
ATTIA_RATES = (4.8 / 5.2, 1.0, 1.0, 4.16 / 5.2)
# Currents are found to this share of the largest one.
CURRENT_TOLERANCE = 1e-6


# SOC -> largest current (A)
CurrentLaw = Callable[[float], float]


def constant_current(current_A: float) -> CurrentLaw:
    """The CC of CC-CV."""
    return lambda _: current_A


def multi_step(currents_A: Sequence[float]) -> CurrentLaw:
    """Constant currents in as many equal SOC windows."""
    return lambda soc: currents_A[min(int(len(currents_A) * max(soc, 0.0)), len(currents_A) - 1)]


def attia_fourth_rate(rates: Sequence[float], hours: float) -> float:
    """C4 (1/h) with which four windows of 20 % take ``hours`` in all: 0.2 (1/C1 + 1/C2 + 1/C3 + 1/C4) = hours. Raises ValueError."""
    left = hours / 0.2 - sum(1.0 / rate for rate in rates)
    if left <= 0:
        raise ValueError(f"hours = {hours:g}: the first three windows alone take {0.2 * sum(1.0 / rate for rate in rates):.4g} h")
    return 1.0 / left


def four_step(currents_A: Sequence[float], last_A: float) -> CurrentLaw:
    """Four currents in the SOC windows 0-20, 20-40, 40-60, 60-80 %, then ``last_A``."""
    return lambda soc: currents_A[min(int(5 * max(soc, 0.0)), 3)] if soc < 0.8 else last_A


def charge(
    stepped: SteppablePlant, law: CurrentLaw, limits: Sequence[Limit], *, steps: int, soc_target: float, current_max_A: float
) -> Episode:
    """One charge: in each interval the largest current in [0, law] that keeps ``limits`` at both its ends.

    At the target the current is zero. Where not even zero current keeps the limits it is zero. The current is found by
    Brent's method on the worst relative excess, from one state of the plant.
    """
    names = [s.name for s in stepped.outputs]
    rows = [(names.index(limit.signal), limit) for limit in limits]
    soc_at = names.index("soc")
    state, records, ending, message = stepped.start, [], Ending.DONE, ""
    rest, _, _ = stepped.ahead(state, 0.0)
    last = rest

    def excess(current: float) -> float:
        try:
            first, end, _ = stepped.ahead(state, current)
        except PlantError:
            # So far beyond every limit that the plant's model fails.
            return 1.0
        worst = [(max(first[i], end[i]) - b.bound if b.upper else b.bound - min(first[i], end[i])) for i, b in rows]
        return float(max(worst, default=-1.0))

    # Charge that one ampere brings in one interval, so that the target is not passed.
    _, one, _ = stepped.ahead(state, min(1.0, current_max_A))
    per_ampere = (one[soc_at] - rest[soc_at]) / min(1.0, current_max_A)
    for _ in range(steps):
        most = min(law(float(last[soc_at])), current_max_A, max(0.0, soc_target - last[soc_at]) / per_ampere)
        current = _largest(excess, most, current_max_A)
        try:
            first, last, state = stepped.ahead(state, current)
        except PlantError as error:
            ending, message = Ending.PLANT, str(error)
            break
        records.append((current, first, last))
    count = len(records)
    outputs = [np.array([r[k] for r in records], dtype=float).reshape(count, len(names)) for k in (1, 2)]
    return Episode(
        sampling_time_s=stepped.sampling_time_s,
        input_names=("current_A",),
        output_names=tuple(names),
        input_units=("A",),
        output_units=tuple(s.unit for s in stepped.outputs),
        estimate_names=(),
        time_s=np.arange(count, dtype=np.float64) * stepped.sampling_time_s,
        input=np.array([r[0] for r in records], dtype=float).reshape(count, 1),
        output_start=outputs[0],
        output_end=outputs[1],
        estimate=np.zeros((count, 0)),
        status=np.zeros(count, dtype=np.int64),
        kkt=np.zeros(count),
        iterations=np.zeros(count, dtype=np.int64),
        ending=ending,
        message=message,
        true_start=outputs[0],
        true_end=outputs[1],
    )


def _largest(excess: Callable[[float], float], most: float, current_max_A: float) -> float:
    if most <= 0 or excess(most) <= 0:
        return max(most, 0.0)
    if excess(0.0) >= 0:
        return 0.0
    from scipy.optimize import brentq

    tolerance = CURRENT_TOLERANCE * current_max_A
    # The root may lie a tolerance beyond the limit.
    return max(0.0, float(brentq(excess, 0.0, most, xtol=tolerance, rtol=1e-8)) - tolerance)
