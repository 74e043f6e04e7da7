"""Open-circuit voltage over the state of charge, from rests between pulses or from a slow charge and discharge."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from chargetune.battery.identification.pulses import PulseSet, groups
from chargetune.battery.identification.record import Record, segments

__all__ = ["ocv_from_rests", "ocv_from_slow"]

# More of the SOC than this at one end is not extrapolated.
UNCOVERED_MAX = 0.25
# A charge and a discharge farther apart (V) or faster (1/h) are not slow.
OCV_SPREAD_V = 0.1
SLOW_MAX = 0.11
# The charge of each may differ from the capacity by this share; further off it was not the whole curve.
WHOLE_SHARE = 0.1


def ocv_from_rests(record: Record, sets: list[PulseSet], soc: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(SOC, OCV in V) from the rests before the pulses, and from the last discharge towards empty; ValueError where they are too few."""
    order = np.argsort([soc[s.first] for s in sets], kind="stable")
    z, v = (np.array([values[sets[i].first] for i in order]) for values in (soc, record.voltage_V))
    # Rests at nearly one SOC differ by how long they lasted, which is no slope.
    near = groups(z)
    z, v = (np.array([np.mean(values[group]) for group in near]) for values in (z, v))
    low = int(np.argmin(soc[sets[0].first :])) + sets[0].first
    if soc[low] < z[0] - 0.02:
        # At the end of a discharge the cell is polarised as much as at the last rest by the same current.
        parts = [p for p in segments(record) if p[0] <= low < p[1]]
        before = float(record.voltage_V[parts[0][0] - 1] - record.voltage_V[parts[0][0]])
        z = np.concatenate([[soc[low]], z])
        v = np.concatenate([[min(record.voltage_V[low] + max(before, 0.0), v[0] - 1e-3)], v])
    if z.size < 2 or max(z[0], 1 - z[-1]) > UNCOVERED_MAX:
        raise ValueError(
            f"{record.source}: the data do not hold the OCV; they reach from SOC {z[0]:.2f} to {z[-1]:.2f}, and at most "
            f"{UNCOVERED_MAX:g} may be missing at each end; a slow charge and discharge (--ocv) would"
        )
    return _covering(z, v)


def ocv_from_slow(ocv: Record, capacity_Ah: float, remarks: list[str]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(SOC, OCV in V) between the longest charge and discharge at equal charge.

    With V_c = OCV + R I_c and V_d = OCV - R I_d it is (V_c I_d + V_d I_c) / (I_c + I_d): their mean where the currents
    are equal, and right also where the charge tapers at constant voltage.
    """
    longest: dict[int, tuple[int, int]] = {}
    for first, last, sign in segments(ocv):
        if sign and (sign not in longest or last - first > longest[sign][1] - longest[sign][0]):
            longest[sign] = (first, last)
    curves = []
    for sign in (1, -1):
        if sign not in longest:
            raise ValueError(f"{ocv.source}: no {'charge' if sign > 0 else 'discharge'} with current, so it holds no OCV curve")
        part = ocv.part(*longest[sign])
        passed = part.charge_Ah
        if abs(np.ptp(passed) / capacity_Ah - 1) > WHOLE_SHARE:
            raise ValueError(
                f"{ocv.source}: the {'charge' if sign > 0 else 'discharge'} passes {np.ptp(passed):.4g} Ah, allowed is within "
                f"{100 * WHOLE_SHARE:.0f} % of the capacity of {capacity_Ah:.4g} Ah; part of a curve holds no OCV over SOC"
            )
        z = (passed - passed.min()) / (passed.max() - passed.min())
        order = np.argsort(z, kind="stable")
        curves.append((z[order], part.voltage_V[order], np.abs(part.current_A[order])))
    grid = np.concatenate([np.linspace(0.0, 0.1, 11), np.linspace(0.15, 0.95, 17), [1.0]])
    (v_c, i_c), (v_d, i_d) = ([np.interp(grid, z, values) for values in (v, i)] for z, v, i in curves)
    between = (v_c * i_d + v_d * i_c) / (i_c + i_d)
    rate, apart, where = float(max(i_c.max(), i_d.max())) / capacity_Ah, float(np.max(v_c - v_d)), float(grid[np.argmax(v_c - v_d)])
    remarks.append(f"OCV lies between the charge and the discharge in {ocv.source}")
    if rate > SLOW_MAX or apart > OCV_SPREAD_V:
        remarks.append(
            f"these flow at up to {rate:.2g}C and lie up to {1e3 * apart:.0f} mV apart (at SOC {where:.2f}): there OCV is uncertain"
        )
    return _covering(grid, np.maximum.accumulate(between))


def _covering(z: NDArray[np.float64], v: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The table from SOC 0 to 1, strictly increasing; its ends go on with the slope beside them."""
    keep = np.concatenate([[True], np.diff(z) > 1e-4])
    z, v = np.clip(z[keep], 0.0, 1.0), v[keep]
    if z[0] > 0:
        z, v = np.concatenate([[0.0], z]), np.concatenate([[v[0] - z[0] * (v[1] - v[0]) / (z[1] - z[0])], v])
    if z[-1] < 1:
        z, v = np.concatenate([z, [1.0]]), np.concatenate([v, [v[-1] + (1 - z[-1]) * (v[-1] - v[-2]) / (z[-1] - z[-2])]])
    for k, (low, high) in enumerate(pairwise(v.copy())):
        v[k + 1] = max(high, v[k] + 1e-4) if high <= max(low, v[k]) else high
    return z, v
