"""Worker processes for a study on this machine."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
from concurrent.futures import ProcessPoolExecutor

__all__ = ["process_executor"]

_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")


def process_executor(workers: int) -> ProcessPoolExecutor:
    """An executor with ``workers`` fresh processes, one thread of linear algebra each.

    Fresh (spawned) processes share no locks or threads with this one. They ignore Ctrl-C, which is for the process that
    runs the study, and end when that one dies. Raises ValueError for ``workers`` below 1.
    """
    if isinstance(workers, bool) or not isinstance(workers, int) or workers < 1:
        raise ValueError(f"workers = {workers!r}, allowed is an integer >= 1")
    pool = ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn"), initializer=_prepare)
    before = {name: os.environ.get(name) for name in _THREADS}
    # A linear algebra library reads these when it is loaded, which may be before the initializer: the processes start with them.
    os.environ.update(dict.fromkeys(_THREADS, "1"))
    try:
        for _ in range(workers):
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
