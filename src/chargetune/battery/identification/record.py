"""A measurement of one cell over time, and its stretches of rest, charge and discharge."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from chargetune.runtime.counted import counted

__all__ = ["JUMP_SHARE", "Record", "assumptions_told", "segments"]

# Below this share of the largest current a cell rests.
REST_SHARE = 0.02
# A change of current of more than this share of the largest one is a jump.
JUMP_SHARE = 0.2


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
                raise ValueError(
                    f"{self.source}: {name} of shape {np.shape(values)}, allowed: {counted(len(self.time_s), 'finite number')}"
                )
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


@contextmanager
def assumptions_told(record: Record) -> Iterator[None]:
    """Within it, what is refused of the record is followed by what was assumed where an option decides: its cause may be there."""
    try:
        yield
    except ValueError as error:
        assumed = [remark for remark in record.remarks if remark.endswith("decides)")]
        if type(error) is not ValueError or not assumed or str(error).endswith("decides)"):
            raise
        raise ValueError("; ".join([str(error), *assumed])) from error


def segments(record: Record) -> list[tuple[int, int, int]]:
    """(first, last not included, sign of the current) of each stretch of rest (0), charge (1) and discharge (-1)."""
    sign: NDArray[np.int64] = (np.sign(record.current_A) * (np.abs(record.current_A) > record.rest_A)).astype(np.int64)
    edges = [0, *(np.flatnonzero(np.diff(sign)) + 1).tolist(), len(sign)]
    return [(a, b, int(sign[a])) for a, b in pairwise(edges)]
