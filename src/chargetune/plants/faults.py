"""What goes wrong between a plant and its controller, on purpose: a wrapper that makes any plant faulty."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from chargetune.model.model import Signal
from chargetune.plants.plant import Measurement, Plant, PlantError

__all__ = ["Fault", "FaultKind", "Faulty"]


class FaultKind(StrEnum):
    """What a fault does to the measured signals (``size`` in their unit) or to the input."""

    MISSING = "missing"  # no number arrives: NaN
    STUCK = "stuck"  # the value from before the fault, again and again
    SPIKE = "spike"  # size is added to the sample at the end of the first interval only
    BIAS = "bias"  # size is added
    REVERSED = "reversed"  # the sign is wrong
    LATE = "late"  # the sample of the interval before
    IGNORED = "ignored"  # the plant keeps the input from before the fault
    LOST = "lost"  # the plant does not answer: `PlantError`


@dataclass(frozen=True)
class Fault:
    """A fault in the intervals ``first`` .. ``last`` (0-based, both included), at the named outputs (none named: at all of them)."""

    kind: FaultKind
    first: int
    last: int
    signals: tuple[str, ...] = ()
    size: float = 0.0

    def __post_init__(self) -> None:
        if not isinstance(self.kind, FaultKind):
            raise ValueError(f"fault: kind = {self.kind!r}, allowed are {', '.join(FaultKind)}")
        for name, least in (("first", 0), ("last", self.first)):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or value < least:
                raise ValueError(f"fault {self.kind}: {name} = {value!r}, allowed is an integer >= {least}")
        if isinstance(self.size, bool) or not isinstance(self.size, (int, float)) or not math.isfinite(self.size):
            raise ValueError(f"fault {self.kind}: size = {self.size!r}, allowed is a finite number")

    def active(self, step: int) -> bool:
        """Whether interval ``step`` is touched."""
        return self.first <= step <= (self.first if self.kind is FaultKind.SPIKE else self.last)


@dataclass
class Faulty:
    """``plant`` with faults, applied in their order. What is true of a simulation (true outputs, state) stays true.

    A fault strikes where samples are read out, so the trace and what the controller receives are wrong alike.
    """

    plant: Plant
    faults: Sequence[Fault]
    _step: int = field(init=False, repr=False, compare=False, default=0)
    _input: NDArray[np.float64] = field(init=False, repr=False, compare=False, default_factory=lambda: np.zeros(0))
    _sound: Measurement | None = field(init=False, repr=False, compare=False, default=None)
    _held: dict[int, Measurement] = field(init=False, repr=False, compare=False, default_factory=dict)

    def __post_init__(self) -> None:
        names = [s.name for s in self.plant.outputs]
        for fault in self.faults:
            unknown = sorted(set(fault.signals) - set(names))
            if unknown:
                raise ValueError(f"fault {fault.kind}: signals names unknown {unknown}, allowed are {', '.join(names)}")

    @property
    def inputs(self) -> tuple[Signal, ...]:
        return self.plant.inputs

    @property
    def outputs(self) -> tuple[Signal, ...]:
        return self.plant.outputs

    @property
    def sampling_time_s(self) -> float:
        return self.plant.sampling_time_s

    def reset(self, seed: int) -> Measurement:
        self._step, self._input, self._held = 0, np.zeros(len(self.inputs)), {}
        self._sound = self.plant.reset(seed)
        return self._sound

    def step(self, u: NDArray[np.float64]) -> Measurement:
        active = {i: f for i, f in enumerate(self.faults) if f.active(self._step)}
        kinds = {f.kind for f in active.values()}
        if FaultKind.LOST in kinds:
            raise PlantError(f"no answer from the plant in step {self._step}")
        if FaultKind.IGNORED not in kinds:
            self._input = u
        measured = true = self.plant.step(self._input)
        before = self._sound or true
        for i, fault in active.items():
            held = self._held.setdefault(i, before)
            measured = self._struck(fault, measured, held if fault.kind is FaultKind.STUCK else before)
        self._sound, self._step = true, self._step + 1
        return measured

    def close(self) -> None:
        self.plant.close()

    def _struck(self, fault: Fault, now: Measurement, before: Measurement) -> Measurement:
        rows = np.array([not fault.signals or s.name in fault.signals for s in self.outputs], dtype=bool)
        # The values that a stuck or late sample takes: a stuck sensor shows its last reading at both ends.
        old_start = before.end if fault.kind is FaultKind.STUCK else before.start

        def change(value: NDArray[np.float64], old: NDArray[np.float64], *, spiked: bool = True) -> NDArray[np.float64]:
            match fault.kind:
                case FaultKind.MISSING:
                    wrong = np.full_like(value, np.nan)
                case FaultKind.STUCK | FaultKind.LATE:
                    wrong = old
                case FaultKind.SPIKE if not spiked:
                    wrong = value
                case FaultKind.SPIKE | FaultKind.BIAS:
                    wrong = value + fault.size
                case FaultKind.REVERSED:
                    wrong = -value
                case _:
                    wrong = value
            return np.where(rows, wrong, value)

        return Measurement(
            change(now.start, old_start, spiked=False),
            change(now.end, before.end),
            change(now.received, before.received),
            now.true_start,
            now.true_end,
            now.state,
        )
