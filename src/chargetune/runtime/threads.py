"""Work on all cores of this process, in threads: CasADi and LAPACK let other threads run while they compute."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import lru_cache
from typing import TypeVar

__all__ = ["parallel_map", "submit", "usable_cores"]

Result = TypeVar("Result")

# How the names of these threads begin, by which they are told from a user's.
NAME = "chargetune-core"


def usable_cores() -> int:
    """How many cores this process may use, at least 1."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def parallel_map(function: Callable[..., Result], *arguments: Iterable[object]) -> list[Result]:
    """``list(map(function, *arguments))``, in as many threads as there are cores; the first exception is raised.

    Called from one of these threads it goes on in that thread: one that waited for the others could wait for ever.
    """
    if _within():
        return list(map(function, *arguments))
    return list(_threads(usable_cores(), os.getpid()).map(function, *arguments))


def submit(function: Callable[..., Result], *arguments: object) -> Future[Result]:
    """Begins ``function(*arguments)`` in one of the threads of `parallel_map` and returns at once; ``result()`` waits for what it returns.

    From one of these threads it is what ``result()`` is ready with: the others may all wait for this one.
    """
    if not _within():
        return _threads(usable_cores(), os.getpid()).submit(function, *arguments)
    done: Future[Result] = Future()
    try:
        done.set_result(function(*arguments))
    except Exception as error:  # noqa: BLE001  it comes out where the result is asked for
        done.set_exception(error)
    return done


def _within() -> bool:
    return threading.current_thread().name.startswith(NAME)


@lru_cache(maxsize=1)
def _threads(count: int, process: int) -> ThreadPoolExecutor:
    """Kept, because to start a thread takes as long as a closed loop. By process, because a fork has none of its parent's threads."""
    return ThreadPoolExecutor(count, f"{NAME} of {process}")
