"""A measurement of one cell over time, and what makes it unfit for use."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

__all__ = ["Record", "checked"]

# A single cell in V; what is beyond was another unit, a pack or a lost contact.
VOLTAGE_RANGE_V = (0.0, 10.0)
CURRENT_MAX_A = 2000.0
# Longest time between two samples where a current flows at either, s: the charge of a longer one is unknown.
GAP_MAX_S = 300.0
# Below this share of the largest current a cell rests.
REST_SHARE = 0.02
# A change of current of more than this share of the largest one is a jump.
JUMP_SHARE = 0.2
# Share of the jumps that a voltage may answer the other way before the sign of the current is in doubt.
DOUBT_SHARE = 0.2


@dataclass(frozen=True)
class Record:
    """A measurement: time (s, not falling), current (A, positive charges), voltage (V), temperature (K) or None; each (n,).

    Raises ValueError for arrays of other shapes, numbers that are not finite and time that falls.
    """

    source: str
    time_s: NDArray[np.float64]
    current_A: NDArray[np.float64]
    voltage_V: NDArray[np.float64]
    temperature_K: NDArray[np.float64] | None = None
    remarks: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name in ("time_s", "current_A", "voltage_V", "temperature_K"):
            if (values := getattr(self, name)) is None:
                continue
            if np.shape(values) != (len(self.time_s),) or not np.all(np.isfinite(values)):
                raise ValueError(f"{self.source}: {name} of shape {np.shape(values)}, allowed are {len(self.time_s)} finite numbers")
        falls = np.diff(self.time_s) < 0
        if falls.any():
            k = int(np.argmax(falls))
            raise ValueError(
                f"{self.source}, sample {k + 2}: time_s = {self.time_s[k + 1]:g} after {self.time_s[k]:g}, allowed is an increasing time"
            )

    def __len__(self) -> int:
        return len(self.time_s)

    @property
    def rest_A(self) -> float:
        """Currents smaller than this are rest."""
        return REST_SHARE * float(np.max(np.abs(self.current_A)))

    @property
    def charge_Ah(self) -> NDArray[np.float64]:
        """Charge since the first sample; a sample's current flowed since the sample before. Shape (n,)."""
        steps = np.diff(self.time_s, prepend=self.time_s[0])
        return np.asarray(np.cumsum(steps * self.current_A) / 3600, dtype=np.float64)

    def part(self, first: int, last: int) -> Record:
        """Samples ``first`` .. ``last`` (last not included)."""
        warm = None if self.temperature_K is None else self.temperature_K[first:last]
        return Record(self.source, self.time_s[first:last], self.current_A[first:last], self.voltage_V[first:last], warm, self.remarks)


def checked(record: Record) -> Record:
    """The record with the sign of its current settled and its rests ended where the current began.

    Refuses (ValueError) what is no cell's voltage, no current, a gap with current, and a current without a sign.
    """
    _refuse_nonsense(record)
    if _discharge_positive(record):
        note = "current was positive when discharging; its sign was changed"
        record = replace(record, current_A=-record.current_A, remarks=(*record.remarks, note))
    return _with_ends_of_rests(record)


def _refuse_nonsense(record: Record) -> None:
    low, high = VOLTAGE_RANGE_V
    outside = ~((record.voltage_V > low) & (record.voltage_V <= high))
    if outside.any():
        k = int(np.argmax(outside))
        raise ValueError(
            f"{record.source}, sample {k + 1}: voltage is {record.voltage_V[k]:g} V, allowed is {low:g} to {high:g} V "
            "(was it given in mV? is it a pack?)"
        )
    largest = float(np.max(np.abs(record.current_A)))
    if not 0 < largest <= CURRENT_MAX_A:
        raise ValueError(
            f"{record.source}: the largest current is {largest:g} A, allowed is more than 0 and at most {CURRENT_MAX_A:g} A (mA?)"
        )
    flowing = np.abs(record.current_A) > record.rest_A
    gap = (np.diff(record.time_s) > GAP_MAX_S) & (flowing[1:] | flowing[:-1])
    if gap.any():
        k = int(np.argmax(gap))
        seconds = record.time_s[k + 1] - record.time_s[k]
        raise ValueError(
            f"{record.source}, sample {k + 2}: a gap of {seconds:.0f} s with current, allowed is {GAP_MAX_S:g} s; its charge is unknown"
        )


def _discharge_positive(record: Record) -> bool:
    """Whether the voltage falls where the current jumps up or, in a record without a jump, while a positive current flows."""
    change, answer = np.diff(record.current_A), np.diff(record.voltage_V)
    large = np.abs(change) > JUMP_SHARE * np.max(np.abs(record.current_A))
    if not large.any():
        return bool(np.sum(record.current_A[1:] * answer) < 0)
    products = (change * answer)[large]
    up, down = float(np.sum(products[products > 0])), -float(np.sum(products[products < 0]))
    if min(up, down) > DOUBT_SHARE * (up + down):
        raise ValueError(
            f"{record.source}: the voltage rises with the current in {np.sum(products > 0)} jumps and falls in {np.sum(products < 0)}; "
            "needed is a current with a sign, positive when it charges (some cyclers write it without)"
        )
    return down > up


def _with_ends_of_rests(record: Record) -> Record:
    """The record with one more sample at the end of each rest that was logged too seldom to show when the current began.

    A step's first sample comes one logging interval after its start, so the rest lasted until then.
    """
    steps = np.diff(record.time_s)
    flowing = np.abs(record.current_A) > record.rest_A
    late = np.flatnonzero(~flowing[:-2] & flowing[1:-1] & flowing[2:] & (steps[1:] > 0) & (steps[:-1] > 2 * steps[1:]))
    if not late.size:
        return record
    begins = record.time_s[late + 1] - steps[late + 1]

    def longer(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.insert(values, late + 1, values[late])

    return replace(
        record,
        time_s=np.insert(record.time_s, late + 1, begins),
        current_A=longer(record.current_A),
        voltage_V=longer(record.voltage_V),
        temperature_K=None if record.temperature_K is None else longer(record.temperature_K),
        remarks=(*record.remarks, f"{late.size} rests have no sample at their end; each was taken to last until its current began"),
    )
