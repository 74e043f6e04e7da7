"""Worker processes for a study on this machine."""

from __future__ import annotations

import multiprocessing
import os
import queue
import signal
import sys
import threading
from collections.abc import Callable
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from typing import ParamSpec, TypeVar

__all__ = ["ProcessExecutor", "process_executor"]

_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
# The environment belongs to the whole process, so one worker at a time is started with another one.
_environment = threading.Lock()

P = ParamSpec("P")
T = TypeVar("T")


class ProcessExecutor(Executor):
    """``workers`` processes of which each can die alone: its own call gets `BrokenExecutor`, a new process takes its place.

    Python's ProcessPoolExecutor gives up all calls when one process dies, so that nobody knows which one was to blame.
    """

    def __init__(self, workers: int) -> None:
        self._threads = ThreadPoolExecutor(workers, thread_name_prefix="chargetune-worker")
        self._pools: queue.SimpleQueue[ProcessPoolExecutor] = queue.SimpleQueue()
        for _ in range(workers):
            self._pools.put(_one_process())

    def submit(self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        """Call ``fn`` in the next process that is free."""

        def call() -> T:
            pool = self._pools.get()
            try:
                return pool.submit(fn, *args, **kwargs).result()
            except BrokenExecutor:
                pool.shutdown(wait=False)
                pool = _one_process()
                raise
            finally:
                self._pools.put(pool)

        return self._threads.submit(call)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:  # noqa: FBT001, FBT002 - the base class says so
        """End the processes; what runs is waited for, unless ``wait`` is False."""
        self._threads.shutdown(wait, cancel_futures=cancel_futures)
        while True:
            try:
                self._pools.get_nowait().shutdown(wait, cancel_futures=cancel_futures)
            except queue.Empty:
                return


def process_executor(workers: int) -> ProcessExecutor:
    """An executor with ``workers`` fresh processes, one thread of linear algebra each.

    Fresh (spawned) processes share no locks or threads with this one. They ignore Ctrl-C, which is for the process that
    runs the study, and end when that one dies. Raises ValueError for ``workers`` below 1.
    """
    if isinstance(workers, bool) or not isinstance(workers, int) or workers < 1:
        raise ValueError(f"workers = {workers!r}, allowed is an integer >= 1")
    return ProcessExecutor(workers)


def _one_process() -> ProcessPoolExecutor:
    pool = ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn"), initializer=_prepare)
    with _environment:
        before = {name: os.environ.get(name) for name in _THREADS}
        # A linear algebra library reads these when it is loaded, which may be before the initializer: the process starts with them.
        os.environ.update(dict.fromkeys(_THREADS, "1"))
        try:
            pool.submit(os.getpid)
        finally:
            for name, value in before.items():
                if value is None:
                    del os.environ[name]
                else:
                    os.environ[name] = value
    return pool


def _prepare() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    torch = sys.modules.get("torch")
    if torch is not None:
        torch.set_num_threads(1)


def _end_with_parent() -> None:
    # A worker waits for work on a pipe whose other end it holds itself, so it would outlive a killed parent for ever.
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
