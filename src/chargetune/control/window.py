"""Which numbers of q a stage reads."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca

from chargetune.runtime.split import split

__all__ = ["Window"]


@dataclass(frozen=True)
class Window:
    """q = (what is fixed over an episode; g_{-1}, g_0 .. g_N), the given signals over the horizon."""

    fixed: int
    signals: int
    horizon: int

    @property
    def length(self) -> int:
        return self.fixed + self.signals * (self.horizon + 2)

    def at(self, q: Any, stage: int) -> Any:
        """What stage i of 0 .. N reads: the fixed numbers, the signals at its start and at its end; -1 is the interval before."""
        if not self.signals:
            return q
        fixed, *signals = split(q, (self.fixed, *[self.signals] * (self.horizon + 2)))
        return ca.vertcat(fixed, signals[stage + 1], signals[min(stage + 2, self.horizon + 1)])

    def of_stage(self, function: ca.Function, stage: int) -> ca.Function:
        """A function whose last argument is what a stage reads, as one of the whole q."""
        if not self.signals:
            return function
        *arguments, _ = function.mx_in()
        q = ca.MX.sym("q", self.length)
        return ca.Function(function.name(), [*arguments, q], list(function.call([*arguments, self.at(q, stage)])))
