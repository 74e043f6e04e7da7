"""Discretisation of continuous-time equations."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

__all__ = ["rk4"]


def rk4(rate: Callable[[Any], Any], x: Any, duration: float, substeps: int = 1) -> Any:
    """Advance dx/dt = rate(x) over ``duration`` (s) with the classical Runge-Kutta method of order 4.

    The input is held constant within ``rate``; the global error falls with substeps^-4. Works on numbers and CasADi.
    """
    if substeps < 1:
        raise ValueError(f"substeps = {substeps}, allowed is an integer >= 1")
    step = duration / substeps
    for _ in range(substeps):
        k1 = rate(x)
        k2 = rate(x + step / 2 * k1)
        k3 = rate(x + step / 2 * k2)
        k4 = rate(x + step * k3)
        x = x + step / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return x
