"""Work on all cores of this process, in threads: CasADi and LAPACK let other threads run while they compute."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import TypeVar

__all__ = ["each", "usable_cores"]

Result = TypeVar("Result")

# How the names of these threads begin, by which they are told from a user's.
NAME = "chargetune-core"


def usable_cores() -> int:
    """How many cores this process may use, at least 1."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def each(function: Callable[..., Result], *arguments: Iterable[object]) -> list[Result]:
    """``list(map(function, *arguments))``, in as many threads as there are cores; the first exception is raised.

    Called from one of these threads it goes on in that thread: one that waited for the others could wait for ever.
    """
    if threading.current_thread().name.startswith(NAME):
        return list(map(function, *arguments))
    return list(_threads(usable_cores(), os.getpid()).map(function, *arguments))


@lru_cache(maxsize=1)
def _threads(count: int, process: int) -> ThreadPoolExecutor:
    """Kept, because to start a thread takes as long as a closed loop. By process, because a fork has none of its parent's threads."""
    return ThreadPoolExecutor(count, f"{NAME} of {process}")
