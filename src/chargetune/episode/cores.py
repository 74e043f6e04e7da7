"""Work on all cores of this process, in threads: CasADi and LAPACK let other threads run while they compute."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

__all__ = ["each", "usable_cores"]

Result = TypeVar("Result")


def usable_cores() -> int:
    """How many cores this process may use, at least 1."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def each(function: Callable[..., Result], *arguments: Iterable[object]) -> list[Result]:
    """``list(map(function, *arguments))``, in as many threads as there are cores; the first exception is raised."""
    with ThreadPoolExecutor(usable_cores()) as threads:
        return list(threads.map(function, *arguments))
