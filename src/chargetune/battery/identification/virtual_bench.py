"""A pulse test (HPPC) and a slow cycle on a simulated cell: the measurements that `identify` reads, where there is no cycler."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from chargetune.battery.identification.record import Record
from chargetune.battery.plants.steppable import SteppablePlant
from chargetune.plants.plant import PlantError

__all__ = ["pulse_test", "record_csv", "slow_cycle"]

# A rest after each move, s: the slowest diffusion in a cell of some ampere-hours is over.
REST_S = 3600.0


def pulse_test(
    sampled: Callable[[float], SteppablePlant],
    *,
    capacity_Ah: float,
    voltage_min_V: float,
    points: int = 10,
    pulse_s: float = 30.0,
    rate: float = 1.0,
) -> Record:
    """Pulses at ``points`` SOC from full to empty, as on a cycler.

    At each SOC: rest of an hour, discharge at ``rate`` (1/h) for ``pulse_s``, pause of 40 s, charge at 0.75 ``rate`` for 10 s,
    then discharge at ``rate`` / 3 to the next SOC; the last one to ``voltage_min_V``. ``sampled(seconds)`` is the same full
    plant with another sampling time. Time constants to a few times ``pulse_s`` can be told from it.
    """
    fast, slow = sampled(0.5), sampled(60.0)
    names = [s.name for s in fast.outputs]
    voltage, warm = names.index("voltage_V"), names.index("temperature_K") if "temperature_K" in names else None
    one, state, now = rate * capacity_Ah, fast.start, 0.0
    rows: list[tuple[float, float, float, float]] = []

    def apply(plant: SteppablePlant, current: float, seconds: float, *, until_V: float | None = None) -> bool:
        """Whether the voltage stayed above ``until_V`` throughout."""
        nonlocal state, now
        for _ in range(round(seconds / plant.sampling_time_s)):
            try:
                _, end, following = plant.ahead(state, current)
            except PlantError:
                return False
            if until_V is not None and end[voltage] < until_V:
                return False
            state, now = following, now + plant.sampling_time_s
            rows.append((now, current, float(end[voltage]), float(end[warm]) if warm is not None else np.nan))
        return True

    for k in range(points):
        apply(slow, 0.0, REST_S)
        if not apply(fast, -one, pulse_s, until_V=voltage_min_V):
            break
        apply(fast, 0.0, 40.0)
        apply(fast, 0.75 * one, 10.0)
        share = 1.0 / points if k < points - 1 else 1.0
        if not apply(sampled(10.0), -one / 3, 3 * 3600 * share / rate, until_V=voltage_min_V):
            apply(fast, -one / 3, 600.0, until_V=voltage_min_V)
            break
    table: Any = np.array(rows)
    temperature = None if warm is None else table[:, 3]
    return Record("simulated pulse test", table[:, 0], table[:, 1], table[:, 2], temperature)


def slow_cycle(
    plant: SteppablePlant, *, capacity_Ah: float, voltage_min_V: float, voltage_max_V: float, rate: float = 0.04, last: float = 0.1
) -> Record:
    """One discharge of a full cell at ``rate`` (1/h) to ``voltage_min_V`` and the charge back to ``voltage_max_V``.

    At each limit the current is halved, and again, until it is below the share ``last`` of what it was: the cell is then as empty,
    or as full, as at rest. The OCV lies between both at equal charge (`identify` with ``ocv``). The plant's sampling time is that
    of the record.
    """
    voltage, state, now = [s.name for s in plant.outputs].index("voltage_V"), plant.start, 0.0
    rows: list[tuple[float, float, float]] = []
    for sign in (-1.0, 1.0):
        current = sign * rate * capacity_Ah
        for _ in range(round(2 * 3600 / rate / plant.sampling_time_s)):
            try:
                _, end, following = plant.ahead(state, current)
                within = voltage_min_V <= float(end[voltage]) <= voltage_max_V
            except PlantError:
                within = False
            if within:
                state, now = following, now + plant.sampling_time_s
                rows.append((now, current, float(end[voltage])))
            elif abs(current) > last * rate * capacity_Ah:
                current /= 2
            else:
                break
    table: Any = np.array(rows)
    return Record("simulated slow cycle", table[:, 0], table[:, 1], table[:, 2], None)


def record_csv(record: Record) -> str:
    """The record with the column names of the Battery Data Format (BDF)."""
    warm = record.temperature_K
    head = "Test Time / s,Current / A,Voltage / V" + ("" if warm is None else ",Temperature / degC")
    rows = [f"{t:.2f},{i:.5f},{v:.6f}" for t, i, v in zip(record.time_s, record.current_A, record.voltage_V, strict=True)]
    if warm is not None:
        rows = [f"{row},{value - 273.15:.4f}" for row, value in zip(rows, warm, strict=True)]
    return "\n".join([head, *rows]) + "\n"
