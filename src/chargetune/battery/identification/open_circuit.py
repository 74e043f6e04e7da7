"""Open-circuit voltage over the state of charge, from rests between pulses or from a slow charge and discharge."""

from __future__ import annotations

from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

from chargetune.battery.identification.pulses import PulseSet, groups, rest_level
from chargetune.battery.identification.record import Record, segments

__all__ = ["Branch", "ocv_from_rests", "ocv_from_slow"]

Branch = Literal["charge", "discharge", "middle"]

# More of the SOC than this at one end is not extrapolated.
UNCOVERED_MAX = 0.25
# A charge and a discharge farther apart (V) or faster (1/h) are not slow.
OCV_SPREAD_V = 0.1
SLOW_MAX = 0.11
# The charge of each may differ from the capacity by this share; further off it was not the whole curve.
WHOLE_SHARE = 0.1
# Rests after charge and after discharge that are this far apart, V, at SOC that both have over at least this range, show hysteresis.
HYSTERESIS_V, OVERLAP_MIN = 3e-3, 0.05
# Less charge than this share of the capacity between two sets does not turn the hysteresis round.
TURN_SHARE, FULL_SHARE = 0.005, 0.02
# A rest whose voltage is below that at a lower SOC by more than this, V, is told.
DISORDER_V = 2e-3


def ocv_from_rests(
    record: Record,
    sets: list[PulseSet],
    soc: NDArray[np.float64],
    remarks: list[str],
    branch: Branch = "middle",
    within: NDArray[np.bool_] | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(SOC, OCV in V) from the rests before the pulses, and from the discharge towards empty.

    Rests after charge lie above rests after discharge where the cell has hysteresis; ``branch`` is which of them, or their
    ``middle``, the OCV is, and a remark says how far they are apart. ``within`` are the samples that may tell the empty end.
    Raises ValueError where the rests are too few.
    """
    z = np.array([float(soc[part.first]) for part in sets])
    v = np.array([rest_level(record, part.first)[0] for part in sets])
    z, v, shift = _one_branch(record, z, v, _directions(record, sets, soc), branch, remarks)
    falls = np.flatnonzero(np.diff(v) < -DISORDER_V)
    if falls.size:
        at = ", ".join(f"{z[k + 1]:.2f} ({1e3 * (v[k] - v[k + 1]):.0f} mV)" for k in falls[:5])
        remarks.append(f"OCV out of order: the rests at SOC {at} are below the rest before them in SOC; the table holds the higher value")
    usable = np.arange(len(record)) if within is None else np.flatnonzero(within)
    low = int(usable[np.argmin(soc[usable])])
    if soc[low] < z[0] - 0.02:
        # At the end of a discharge the cell is polarised as much as at the last rest by the same current.
        first = next(a for a, b, _ in segments(record) if a <= low < b)
        before = float(record.voltage_V[first - 1] - record.voltage_V[first]) if first else 0.0
        z = np.concatenate([[soc[low]], z])
        v = np.concatenate([[min(record.voltage_V[low] + max(before, 0.0) + shift, v[0] - 1e-3)], v])
    if z.size < 2 or max(z[0], 1 - z[-1]) > UNCOVERED_MAX:
        raise ValueError(
            f"{record.source}: the data do not hold the OCV; they reach from SOC {z[0]:.2f} to {z[-1]:.2f}, and at most "
            f"{UNCOVERED_MAX:g} may be missing at each end; a slow charge and discharge (--ocv) would"
        )
    return _covering(z, v)


def _directions(record: Record, sets: list[PulseSet], soc: NDArray[np.float64]) -> NDArray[np.int64]:
    """1 for a rest that a charge led to, -1 for a discharge, 0 where nothing or only a full charge did."""
    moves = [(b, kind) for a, b, kind in segments(record) if kind and abs(soc[b - 1] - soc[max(a - 1, 0)]) > TURN_SHARE]
    moves = [(b, kind) for b, kind in moves if not any(part.first < b < part.last for part in sets)]
    ways = [next((kind for b, kind in reversed(moves) if b <= part.first), 0) for part in sets]
    # A full cell is where both branches meet.
    return np.array([0 if soc[part.first] > 1 - FULL_SHARE else way for part, way in zip(sets, ways, strict=True)], dtype=np.int64)


def _one_branch(
    record: Record, z: NDArray[np.float64], v: NDArray[np.float64], way: NDArray[np.int64], branch: Branch, remarks: list[str]
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """(SOC, OCV, shift of what a discharge tells, in V) on one branch of the hysteresis or in its middle."""
    up, down = (_merged(z[(way == sign) | (way == 0)], v[(way == sign) | (way == 0)]) for sign in (1, -1))
    both = [(way == sign).sum() >= 2 for sign in (1, -1)]
    if all(both):
        low, high = max(up[0][0], down[0][0]), min(up[0][-1], down[0][-1])
        nodes = np.unique(np.concatenate([part[0] for part in (up, down)]))
        shared = nodes[(nodes >= low) & (nodes <= high)]
        if high - low >= OVERLAP_MIN and shared.size >= 2:
            curves = [PchipInterpolator(*part) for part in (up, down)]
            apart = curves[0](shared) - curves[1](shared)
            if float(np.median(apart)) > HYSTERESIS_V:
                # Beyond what both have the branches are as far apart as at the nearest SOC that they share.
                gap = np.interp(nodes, shared, apart)
                share = {"charge": 0.0, "middle": 0.5, "discharge": 1.0}[branch]
                on_up = [curves[0](x) - share * g if up[0][0] <= x <= up[0][-1] else np.nan for x, g in zip(nodes, gap, strict=True)]
                on_down = [
                    curves[1](x) + (1 - share) * g if down[0][0] <= x <= down[0][-1] else np.nan for x, g in zip(nodes, gap, strict=True)
                ]
                table = np.nanmean([on_up, on_down], axis=0)
                remarks.append(
                    f"hysteresis: at equal SOC ({low:.2f} to {high:.2f}) rests after charge lie {1e3 * np.median(apart):.1f} mV (at most "
                    f"{1e3 * np.max(apart):.1f} mV) above rests after discharge; OCV is "
                    f"{'the middle of both' if branch == 'middle' else f'that after {branch}'} (--branch charge, discharge or middle)"
                )
                return *_merged(nodes, table), float((1 - share) * gap[0])
    if branch != "middle":
        raise ValueError(
            f"{record.source}: branch = {branch!r}, but its rests do not show a hysteresis (needed are rests after charge and after "
            "discharge at the same SOC); allowed is 'middle'"
        )
    return *_merged(z, v), 0.0


def _merged(z: NDArray[np.float64], v: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """In the order of SOC; rests at nearly one SOC differ by how long they lasted, which is no slope, and are averaged."""
    order = np.argsort(z, kind="stable")
    z, v = z[order], v[order]
    if not z.size:
        return z, v
    near = groups(z)
    return np.array([np.mean(z[group]) for group in near]), np.array([np.mean(v[group]) for group in near])


def ocv_from_slow(
    ocv: Record, capacity_Ah: float, remarks: list[str], branch: Branch = "middle"
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(SOC, OCV in V) between the longest charge and discharge at equal charge.

    With V_c = OCV + R I_c and V_d = OCV - R I_d it is (V_c I_d + V_d I_c) / (I_c + I_d): their mean where the currents
    are equal, and right also where the charge tapers at constant voltage. With ``branch`` it is the charge or the discharge itself.
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
    remarks += [f"{ocv.source}: {remark}" for remark in ocv.remarks]
    grid = np.concatenate([np.linspace(0.0, 0.1, 11), np.linspace(0.15, 0.95, 17), [1.0]])
    (v_c, i_c), (v_d, i_d) = ([np.interp(grid, z, values) for values in (v, i)] for z, v, i in curves)
    between = (v_c * i_d + v_d * i_c) / (i_c + i_d)
    rate, apart, where = float(max(i_c.max(), i_d.max())) / capacity_Ah, float(np.max(v_c - v_d)), float(grid[np.argmax(v_c - v_d)])
    if branch == "middle":
        remarks.append(f"OCV lies between the charge and the discharge in {ocv.source}")
    else:
        between = v_c if branch == "charge" else v_d
        remarks.append(
            f"OCV is the {branch} in {ocv.source}, with its polarisation; charge and discharge lie "
            f"{1e3 * np.median(v_c - v_d):.0f} mV apart"
        )
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
