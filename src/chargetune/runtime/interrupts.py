"""Signals that stop a program in order and soon, also where compiled code loses the exception that their handler raises.

The wrapper of a compiled library that tries one conversion after the other clears every error in between, a KeyboardInterrupt too.
Without a note of it the program would go on as if nothing had come. And a call of compiled code may take minutes until Python's
handler gets its turn. So a thread watches, too: it learns of a signal at once, says so, and ends a process that does not end.
"""

from __future__ import annotations

import os
import select
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from types import FrameType

__all__ = ["INTERRUPTED", "Watch", "handled_interrupts", "raise_lost_interrupt", "unwatched"]

NUMBERS = (signal.SIGINT, signal.SIGTERM)
# How long a process has to end in order after a signal.
PATIENCE_S = 2.0
# `timeout` and some terminals send one signal to the process and once more to its group.
SAME_S = 0.3
# 128 and the number of SIGINT, as a shell says it.
INTERRUPTED = 130

_came: list[float] = []


@dataclass(frozen=True)
class Watch:
    """What is said where the first signal comes, and where the process is ended because it did not end in time."""

    stopping: Callable[[], None]
    ended: Callable[[], None]


@contextmanager
def handled_interrupts(watch: Watch | None = None) -> Iterator[None]:
    """SIGINT and SIGTERM raise KeyboardInterrupt within, and are noted. In other threads than the main one it changes nothing.

    With ``watch`` a second signal ends the process at once, and so do `PATIENCE_S` after the first one, with exit code 130.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    # The watch first: a signal that comes between the two is said, too.
    with nullcontext() if watch is None else _watched(watch):
        before = {number: signal.signal(number, _interrupt) for number in NUMBERS}
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


@contextmanager
def unwatched() -> Iterator[None]:
    """Within it nothing is said and nobody ended: for a server, which handles signals itself."""
    before = signal.set_wakeup_fd(-1)
    try:
        yield
    finally:
        signal.set_wakeup_fd(before)


def _interrupt(_: int, __: FrameType | None) -> None:
    now = time.monotonic()
    if _came and now - _came[0] < SAME_S:
        return
    _came.append(now)
    raise KeyboardInterrupt


@contextmanager
def _watched(watch: Watch) -> Iterator[None]:
    reader, writer = socket.socketpair()
    # As the system asks for of a descriptor that a signal handler writes to.
    os.set_blocking(writer.fileno(), False)
    thread = threading.Thread(target=_look, args=(reader, watch), name="chargetune-signals", daemon=True)
    before = signal.set_wakeup_fd(writer.fileno(), warn_on_full_buffer=False)
    thread.start()
    try:
        yield
    finally:
        signal.set_wakeup_fd(before)
        writer.close()
        thread.join()
        reader.close()


def _look(reader: socket.socket, watch: Watch) -> None:
    first: float | None = None
    while True:
        left = None if first is None else max(0.0, first + PATIENCE_S - time.monotonic())
        if not select.select([reader], [], [], left)[0]:
            watch.ended()
            os._exit(INTERRUPTED)
        came = reader.recv(64)
        if not came:
            return
        if not set(came) & set(NUMBERS):
            continue
        if first is None:
            first = time.monotonic()
            watch.stopping()
        elif time.monotonic() - first >= SAME_S:
            os._exit(INTERRUPTED)
