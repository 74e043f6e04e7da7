"""The sign of a current: from a column of states, from how the voltage answers it, or as the person says."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from chargetune.battery.identification.record import JUMP_SHARE, Record, segments
from chargetune.runtime.counted import counted

__all__ = ["Sign", "signed_by_state", "with_sign"]

Sign = Literal["charge", "discharge", "unsigned"]
# Share of the jumps that a voltage may answer the other way before the sign of the current is in doubt.
DOUBT_SHARE = 0.2
# A voltage that moves against the others by more than this share of what they say contradicts them.
CONTRARY_SHARE = 0.25
# Below this share of the largest current the sign of a sample does not matter.
SMALL_SHARE = 0.02


def signed_by_state(name: str, current: NDArray[np.float64], states: Sequence[str], remarks: list[str]) -> NDArray[np.float64]:
    """The current, positive where it charges, from states such as C and D, CHA and DCH, "CC Chg" and "CC DChg".

    Left as it is where the states name neither. Raises ValueError where a current flows in a state that is neither.
    """
    kinds = {state: _kind(state) for state in set(states)}
    sign = np.array([kinds[state] for state in states])
    if not sign.any():
        return current
    flowing = np.abs(current) > SMALL_SHARE * np.max(np.abs(current))
    if (current < 0).any() and (current[flowing] > 0).any():
        return current
    lost = flowing & (sign == 0)
    if lost.any():
        k = int(np.argmax(lost))
        if sign[flowing].any():
            # The last sample of a step may have the state of the next one.
            near = sign[max(k - 1, 0)] or sign[min(k + 1, sign.size - 1)]
            if lost.sum() > 0.01 * flowing.sum() or not near:
                raise ValueError(
                    f"{name}, sample {k + 1}: a current of {current[k]:g} A without a sign in the state {states[k]!r}; "
                    "allowed are states that charge or discharge (--sign decides)"
                )
            sign[lost] = [sign[max(i - 1, 0)] or sign[min(i + 1, sign.size - 1)] for i in np.flatnonzero(lost).tolist()]
        else:
            return current
    signed = np.where(sign == 0, 1, sign) * np.abs(current)
    if not np.array_equal(signed, current):
        remarks.append("the current has no sign; it was taken from the column of states")
    return np.asarray(signed, dtype=np.float64)


def _kind(state: str) -> int:
    word = re.sub(r"[\s_-]", "", state).upper()
    begins = state.strip().upper()[:2]
    if begins in {"C_", "D_"}:
        return 1 if begins == "C_" else -1
    if word == "D" or re.search(r"DIS|DCH|DSCH|ENTLAD|放", word):
        return -1
    if word == "C" or re.search(r"CHA|CHG|CHRG|LADEN|充", word):
        return 1
    return 0


def with_sign(record: Record, sign: Sign | None, *, known: bool = False) -> Record:
    """The record with a current that is positive when it charges; ``known`` says that the file's states gave its sign.

    Raises ValueError where the voltage contradicts the sign, or rises and falls with a current that has none.
    """
    if sign == "charge":
        return replace(record, remarks=(*record.remarks, "positive current charges, as --sign says"))
    if sign == "discharge":
        return _turned(record, "positive current discharges, as --sign says; its sign was changed")
    if sign == "unsigned":
        return _by_stretch(record)
    if not known and (np.min(record.current_A) > -record.rest_A or np.max(record.current_A) < record.rest_A):
        return _one_sided(record)
    down = _discharge_positive(record)
    if down and known:
        raise ValueError(
            f"{record.source}: the voltage falls where the column of states says charge; allowed is one meaning (--sign charge, discharge "
            "or unsigned decides)"
        )
    return _turned(record, "current was positive when discharging; its sign was changed") if down else record


def _turned(record: Record, note: str) -> Record:
    return replace(record, current_A=-record.current_A, remarks=(*record.remarks, note))


def _discharge_positive(record: Record) -> bool:
    """Whether the voltage falls where the current jumps up or, in a record without a jump, while a positive current flows."""
    change, answer = np.diff(record.current_A), np.diff(record.voltage_V)
    large = np.abs(change) > JUMP_SHARE * np.max(np.abs(record.current_A))
    if not large.any():
        return bool(np.sum(record.current_A[1:] * answer) < 0)
    products = (change * answer)[large]
    up, down = float(np.sum(products[products > 0])), -float(np.sum(products[products < 0]))
    if min(up, down) > DOUBT_SHARE * (up + down):
        raise _unsigned(
            record, f"the voltage rises with the current in {counted(np.sum(products > 0), 'jump')} and falls in {np.sum(products < 0)}"
        )
    return down > up


def _one_sided(record: Record) -> Record:
    """A current that never changes its sign: right if every stretch moves the voltage the same way, else it has none."""
    down = _discharge_positive(record)
    answers = _answers(record)
    most = float(np.median(np.abs([v for *_, v in answers]))) if answers else 0.0
    way = float(np.sign(sum(np.sign(v) for *_, v in answers)))
    contrary = [a for a in answers if a[2] * way < -CONTRARY_SHARE * most]
    if contrary:
        first, _, volts = contrary[0]
        raise _unsigned(
            record,
            f"it is never {'negative' if np.max(record.current_A) > record.rest_A else 'positive'}, but the voltage "
            f"{'rises' if volts > 0 else 'falls'} in {len(contrary)} of {counted(len(answers), 'stretch', 'stretches')} "
            f"(first at {record.time_s[first]:.0f} s)",
        )
    return _turned(record, "current was positive when discharging; its sign was changed") if down else record


def _answers(record: Record) -> list[tuple[int, int, float]]:
    """(first, last, volts by which the voltage moves with the current) of each stretch of current, by its begin, end and course."""
    found = []
    v = record.voltage_V
    for first, last, kind in segments(record):
        if not kind:
            continue
        jump = (v[first] - v[first - 1] if first else 0.0) + (v[last - 1] - v[last] if last < len(record) else 0.0)
        course = v[last - 1] - v[first]
        found.append((first, last, float(jump + course if (first or last < len(record)) else course)))
    return found


def _by_stretch(record: Record) -> Record:
    current = np.abs(record.current_A)
    for first, last, volts in _answers(record):
        if not volts:
            raise ValueError(f"{record.source}: at {record.time_s[first]:.0f} s the voltage does not tell whether the current charges")
        current[first:last] *= np.sign(volts)
    note = "each stretch of current has the sign that its voltage shows, as --sign unsigned says"
    return replace(record, current_A=current, remarks=(*record.remarks, note))


def _unsigned(record: Record, seen: str) -> ValueError:
    return ValueError(
        f"{record.source}: {seen}; needed is a current with a sign, positive when it charges (some cyclers write it without). "
        "--sign unsigned takes it from the voltage of each stretch; --sign charge or discharge says what a positive current does"
    )
