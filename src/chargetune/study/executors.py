"""Worker processes for a study on this machine."""

from __future__ import annotations

import multiprocessing
import os
import queue
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from types import FrameType, TracebackType
from typing import ParamSpec, TypeVar

from chargetune.runtime.counted import counted
from chargetune.runtime.notes import say_warnings_as_notes

__all__ = ["ProcessExecutor", "bounded_workers", "process_executor"]

_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
# The environment belongs to the whole process, so one worker at a time is started with another one.
_environment = threading.Lock()
# How long a worker has to leave its evaluation in order, in seconds, before its process is ended.
GRACE_S = 0.7

P = ParamSpec("P")
T = TypeVar("T")


class ProcessExecutor(Executor):
    """``workers`` processes of which each can die alone: its own call gets `BrokenExecutor`, a new process takes its place.

    Python's ProcessPoolExecutor gives up all calls when one process dies, so that nobody knows which one was to blame.
    As a context manager that is left by an interrupt it does not wait for what runs: see `kill`.
    """

    def __init__(self, workers: int) -> None:
        self._threads = ThreadPoolExecutor(workers, thread_name_prefix="chargetune-worker")
        self._pools: queue.SimpleQueue[ProcessPoolExecutor] = queue.SimpleQueue()
        self._living = {_one_process() for _ in range(workers)}
        self._busy: set[ProcessPoolExecutor] = set()
        self._ending = False
        for pool in self._living:
            self._pools.put(pool)

    def submit(self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        """Call ``fn`` in the next process that is free."""

        def call() -> T:
            pool = self._pools.get()
            self._busy.add(pool)
            try:
                return pool.submit(_called, fn, args, kwargs).result()
            except BrokenExecutor:
                pool.shutdown(wait=False)
                self._living.discard(pool)
                self._busy.discard(pool)
                if not self._ending:
                    pool = _one_process()
                    self._living.add(pool)
                raise
            finally:
                self._busy.discard(pool)
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

    def kill(self) -> None:
        """End the processes now. What waits is cancelled; what runs has `GRACE_S` to leave its evaluation in order."""
        self._ending = True
        self._threads.shutdown(wait=False, cancel_futures=True)
        living = list(self._living)
        processes = [process for pool in living for process in list((getattr(pool, "_processes", None) or {}).values())]
        for process in processes:
            process.terminate()
        end = time.monotonic() + GRACE_S
        while self._busy and time.monotonic() < end:
            time.sleep(0.01)
        for process in processes:
            process.kill()
        managers = [getattr(pool, "_executor_manager_thread", None) for pool in living]
        for pool in living:
            pool.shutdown(wait=False, cancel_futures=True)
        # Python wakes these threads when it ends, and shows a traceback where one is just closing what it is woken by.
        for manager in managers:
            if manager is not None:
                manager.join(GRACE_S)

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, traceback: TracebackType | None) -> None:
        if kind is None or issubclass(kind, Exception):
            self.shutdown()
        else:
            self.kill()


def bounded_workers(wanted: int, work: int | None = None, what: tuple[str, str] = ("trial", "trials")) -> tuple[int, str]:
    """So many workers as can have something to do, and what to say where that is fewer than are wanted, else nothing.

    Each needs a core of this machine, and one of ``work`` pieces, called ``what`` (of one, of several).
    Raises ValueError for fewer than one.
    """
    if isinstance(wanted, bool) or not isinstance(wanted, int) or wanted < 1:
        raise ValueError(f"workers = {wanted!r}, allowed is an integer >= 1")
    cores = _cores()
    count = max(1, min(wanted, cores, wanted if work is None else work))
    if count == wanted:
        return count, ""
    reason = f"this machine has {counted(cores, 'core')}" if count == cores else f"{counted(work or 0, *what)} to run"
    return count, f"workers = {wanted} lowered to {count}: {reason}"


def process_executor(workers: int, work: int | None = None, what: tuple[str, str] = ("trial", "trials")) -> ProcessExecutor:
    """An executor with ``workers`` fresh processes, one thread of linear algebra each; not more than `bounded_workers`.

    Fresh (spawned) processes share no locks or threads with this one. They ignore Ctrl-C, which is for the process that
    runs the study, and end when that one dies. Raises ValueError for ``workers`` below 1. Warns where fewer are enough.
    """
    count, said = bounded_workers(workers, work, what)
    if said:
        warnings.warn(said, RuntimeWarning, stacklevel=2)
    return ProcessExecutor(count)


def _cores() -> int:
    # Those that this process may use, which a container or a scheduler may have made fewer.
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:
        return os.cpu_count() or 1


def _one_process() -> ProcessPoolExecutor:
    pool = ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn"), initializer=_prepare)
    with _environment:
        before = {name: os.environ.get(name) for name in _THREADS}
        # A linear algebra library reads these when it is loaded, which may be before the initializer: the process starts with them.
        os.environ.update(dict.fromkeys(_THREADS, "1"))
        # Nor is Ctrl-C for it before it can ignore it.
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT]) if hasattr(signal, "pthread_sigmask") else set()
        try:
            pool.submit(os.getpid)
        finally:
            if hasattr(signal, "pthread_sigmask"):
                signal.pthread_sigmask(signal.SIG_SETMASK, mask)
            for name, value in before.items():
                if value is None:
                    del os.environ[name]
                else:
                    os.environ[name] = value
    return pool


# Whether this process, a worker, is in a call.
_in_call: list[bool] = []


def _called(fn: Callable[..., T], args: tuple[object, ...], kwargs: dict[str, object]) -> T:
    _in_call.append(True)
    try:
        return fn(*args, **kwargs)
    finally:
        _in_call.clear()


def _prepare() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, _leave)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    say_warnings_as_notes()
    torch = sys.modules.get("torch")
    if torch is not None:
        torch.set_num_threads(1)


def _leave(_: int, __: FrameType | None) -> None:
    # An evaluation gives back what it holds; a worker that waits for one holds nothing.
    if _in_call:
        # What compiled code says of an exception that it loses is of no use: the one who ended this says so.
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
        raise KeyboardInterrupt
    os._exit(1)


def _end_with_parent() -> None:
    # A worker waits for work on a pipe whose other end it holds itself, so it would outlive a killed parent for ever.
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
