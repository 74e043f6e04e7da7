"""What makes a measurement unfit for use, and what is mended: the sign and the zero of its current, the ends of its rests."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from chargetune.battery.identification.current_sign import Sign, with_sign
from chargetune.battery.identification.record import Record
from chargetune.runtime.counted import counted

__all__ = ["checked"]

# A single cell in V; what is beyond was another unit, a pack or a lost contact.
VOLTAGE_RANGE_V = (0.0, 10.0)
CURRENT_MAX_A = 2000.0
# Longest time between two samples with a current at the second, s: the charge of a longer one is unknown.
GAP_MAX_S = 300.0
# A rest that is logged every so often has such gaps at its end; a gap of more than this many intervals is damage.
REST_INTERVALS = 1.5
# A rest of the current's sensor: at least so many stretches of at least so many s below this share of the largest current.
QUIET_MIN, QUIET_S, QUIET_SHARE = 3, 300.0, 0.06
# A spike of the current, as a share of the usual one; what is the same on both sides, as a share of the spike; a voltage that does not
# answer, as a share of how it answers usually; and at most so many, as a share of the samples.
SPIKE_SHARE, SAME_SHARE, UNSEEN_SHARE, SPIKES_SHARE = 0.5, 0.02, 0.2, 0.01
# A zero of less than this share of the largest current moves the charge less than it is known; of all rests alike, within this share.
# or by as many standard errors as the range of some tens of values has; a noise of more than the last share is no rest.
OFFSET_TOLD, OFFSET_SAME, ERRORS, SAME_LEVEL = 5e-4, 0.2, 6.0, 0.02


def checked(record: Record, *, sign: Sign | None = None, known_sign: bool = False) -> Record:
    """The record with sign and zero of its current settled and its rests ended where the current began.

    ``sign`` says what a positive current does, ``known_sign`` that the file's column of states gave it. Refuses (ValueError)
    what is no cell's voltage, no current, a gap with current, and a current without a sign.
    """
    _refuse_nonsense(record)
    record = _without_offset(_without_current_spikes(record))
    _refuse_gaps(record)
    return _with_ends_of_rests(with_sign(record, sign, known=known_sign))


def _refuse_nonsense(record: Record) -> None:
    low, high = VOLTAGE_RANGE_V
    outside = ~((record.voltage_V > low) & (record.voltage_V <= high))
    if outside.any():
        k = int(np.argmax(outside))
        raise ValueError(
            f"{record.source}, sample {k + 1}: voltage is {record.voltage_V[k]:g} V, allowed is {low:g} to {high:g} V "
            "for one cell (was it given in mV? of a pack: --series and --parallel)"
        )
    largest = float(np.max(np.abs(record.current_A)))
    if not 0 < largest <= CURRENT_MAX_A:
        raise ValueError(
            f"{record.source}: the largest current is {largest:g} A, allowed is more than 0 and at most {CURRENT_MAX_A:g} A (mA?)"
        )


def _without_current_spikes(record: Record) -> Record:
    """The record without single samples whose current the voltage did not see: they were logged wrong, or between two steps."""
    current, voltage = record.current_A, record.voltage_V
    if len(record) < 3:
        return record
    beside, across = np.abs(current[1:-1] - current[:-2]), np.abs(current[2:] - current[:-2])
    answer = np.abs(voltage[1:-1] - (voltage[2:] + voltage[:-2]) / 2)
    usual = float(np.median(np.abs(current[np.abs(current) > record.rest_A])))
    steps = np.abs(np.diff(current))
    jumps = steps > SPIKE_SHARE * usual
    ohms = float(np.median(np.abs(np.diff(voltage))[jumps] / steps[jumps])) if jumps.any() else 0.0
    wrong = 1 + np.flatnonzero((beside > SPIKE_SHARE * usual) & (across < SAME_SHARE * beside) & (answer < UNSEEN_SHARE * ohms * beside))
    # Single samples of hundreds; of more it is how the current was driven.
    if not wrong.size or wrong.size > SPIKES_SHARE * len(record):
        return record
    notes = [
        f"sample {k + 1} was left out: its current is {current[k]:g} A between {current[k - 1]:g} A and {current[k + 1]:g} A, and the "
        "voltage does not show it"
        for k in wrong.tolist()
    ]
    keep = np.ones(len(record), dtype=bool)
    keep[wrong] = False
    warm = None if record.temperature_K is None else record.temperature_K[keep]
    return Record(record.source, record.time_s[keep], current[keep], voltage[keep], warm, (*record.remarks, *notes))


def _without_offset(record: Record) -> Record:
    """The record without what the current reads in all of its rests alike, which is the sensor's zero and not the cell's charge."""
    largest = float(np.max(np.abs(record.current_A)))
    quiet = np.abs(record.current_A) < QUIET_SHARE * largest
    edges = np.flatnonzero(np.diff(quiet, prepend=False, append=False))
    levels = []
    for first, last in edges.reshape(-1, 2):
        if record.time_s[last - 1] - record.time_s[first] >= QUIET_S:
            part = record.current_A[first:last]
            levels.append((float(np.median(part)), float(np.ptp(part)), float(np.std(part)) / part.size**0.5))
    if len(levels) < QUIET_MIN:
        return record
    values, spreads, errors = np.array(levels).T
    zero = float(np.median(values))
    told, same = abs(zero) > OFFSET_TOLD * largest, np.ptp(values) <= max(OFFSET_SAME * abs(zero), ERRORS * float(np.max(errors)))
    if not told:
        return record
    if not same or np.max(spreads) > max(abs(zero), SAME_LEVEL * largest):
        note = (
            f"the current reads {1e3 * values.min():.3g} to {1e3 * values.max():.3g} mA in its {counted(len(levels), 'rest')}: if that is "
            "the sensor's zero, the counted charge is wrong"
        )
        return replace(record, remarks=(*record.remarks, note))
    note = f"the current reads {1e3 * zero:.4g} mA in each of its {counted(len(levels), 'rest')}; it was subtracted from every sample"
    return replace(record, current_A=record.current_A - zero, remarks=(*record.remarks, note))


def _refuse_gaps(record: Record) -> None:
    """A sample's current flowed since the sample before, so a gap matters where the current flows at its end."""
    flowing = np.abs(record.current_A) > record.rest_A
    steps = np.diff(record.time_s)
    allowed = np.full(steps.size, GAP_MAX_S)
    resting = ~flowing[1:-1] & ~flowing[:-2]
    allowed[1:][resting] = np.maximum(GAP_MAX_S, REST_INTERVALS * steps[:-1][resting])
    gap = (steps > allowed) & flowing[1:]
    if gap.any():
        k = int(np.argmax(gap))
        raise ValueError(
            f"{record.source}, sample {k + 2}: a gap of {steps[k]:.0f} s with current, allowed is {allowed[k]:g} s; its charge is unknown"
        )


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
        remarks=(*record.remarks, f"no sample at the end of {counted(late.size, 'rest')}; each was taken to last until its current began"),
    )
