"""Signals that stop a program in order, also where compiled code loses the exception that their handler raises.

The wrapper of a compiled library that tries one conversion after the other clears every error in between, a KeyboardInterrupt too.
Without a note of it the program would go on as if nothing had come.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

__all__ = ["handled_interrupts", "raise_lost_interrupt"]

_came: list[int] = []


@contextmanager
def handled_interrupts() -> Iterator[None]:
    """SIGINT and SIGTERM raise KeyboardInterrupt within, and are noted. In other threads than the main one it changes nothing."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, _interrupt) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        _came.clear()


def raise_lost_interrupt() -> None:
    """Raises KeyboardInterrupt where a signal has come within `handled_interrupts`; for who is between two pieces of work."""
    if _came:
        raise KeyboardInterrupt


def _interrupt(number: int, _: FrameType | None) -> None:
    _came.append(number)
    raise KeyboardInterrupt
