"""Lease: one process works on a study at a time; the operating system takes it back when the process dies, however it dies."""

from __future__ import annotations

import os
import sys
import threading
from dataclasses import dataclass
from pathlib import Path

__all__ = ["Lease", "take_lease"]

# One byte of the file is locked for each study. POSIX drops all locks of a process on a file when ANY of its handles on that
# file is closed, so a process keeps one handle for each file. The process id is part of the key: a forked child inherits this
# table but no lock.
_handles: dict[tuple[int, Path], int] = {}
_counts: dict[tuple[int, Path], dict[int, int]] = {}
_guard = threading.Lock()


@dataclass(frozen=True)
class Lease:
    """A study that this process holds. Within the process it may be taken several times and is free after as many releases."""

    path: Path
    study_id: int

    def release(self) -> None:
        """Give the study back; a lease of before a fork is left alone."""
        key = (os.getpid(), self.path)
        with _guard:
            counts = _counts.get(key, {})
            if self.study_id not in counts:
                return
            counts[self.study_id] -= 1
            if counts[self.study_id] == 0:
                del counts[self.study_id]
                _unlock(_handles[key], self.study_id)
            if not counts:
                os.close(_handles.pop(key))
                del _counts[key]


def take_lease(store_path: Path, study_id: int) -> Lease | None:
    """The lease of a study, None when another process holds it. The lock file lies beside the store and stays there."""
    path = store_path.with_name(store_path.name + "-lock")
    key = (os.getpid(), path)
    with _guard:
        if key not in _handles:
            _handles[key] = os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_CLOEXEC", 0), 0o666)
            _counts[key] = {}
        counts = _counts[key]
        if study_id not in counts and not _lock(_handles[key], study_id):
            if not counts:
                os.close(_handles.pop(key))
                del _counts[key]
            return None
        counts[study_id] = counts.get(study_id, 0) + 1
    return Lease(path, study_id)


if sys.platform == "win32":
    import msvcrt

    def _lock(handle: int, byte: int) -> bool:
        os.lseek(handle, byte, os.SEEK_SET)
        try:
            msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)
        except OSError:
            return False
        return True

    def _unlock(handle: int, byte: int) -> None:
        os.lseek(handle, byte, os.SEEK_SET)
        msvcrt.locking(handle, msvcrt.LK_UNLCK, 1)

else:
    import fcntl

    def _lock(handle: int, byte: int) -> bool:
        try:
            fcntl.lockf(handle, fcntl.LOCK_EX | fcntl.LOCK_NB, 1, byte)
        except (BlockingIOError, PermissionError):
            return False
        return True

    def _unlock(handle: int, byte: int) -> None:
        fcntl.lockf(handle, fcntl.LOCK_UN, 1, byte)
