"""A store that others write to, read again when it changed."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, field
from pathlib import Path

from chargetune.report.reading import StudyView, read_studies

__all__ = ["StoreWatch"]

# A file system may give two writes within some milliseconds the same time: what is younger than this is read again.
SETTLED_S = 1.0

Fingerprint = tuple[tuple[int, int, int], ...]


@dataclass
class StoreWatch:
    """The studies of a store as they are now, for several viewers at a time: an unchanged store is read once.

    Opened read-only for each reading, so a store may be moved away and come back. Raises StoreError as `read_studies` does.
    """

    path: Path
    _known: dict[int | None, tuple[Fingerprint, list[StudyView]]] = field(default_factory=dict)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def studies(self) -> list[StudyView]:
        """All studies, oldest first. The same list object as long as the store did not change."""
        return self._read(None)

    def study(self, study_id: int) -> StudyView | None:
        """One study; None when there is none of this id. The same object as long as the store did not change."""
        return next(iter(self._read(study_id)), None)

    def _read(self, only: int | None) -> list[StudyView]:
        with self._lock:
            mark, settled = self._fingerprint()
            known = self._known.get(only)
            if known is not None and known[0] == mark:
                return known[1]
            found = read_studies(self.path, only)
            if settled:
                self._known[only] = (mark, found)
            else:
                self._known.pop(only, None)
            return found

    def _fingerprint(self) -> tuple[Fingerprint, bool]:
        """Identity, size and time of the database and of its log, and whether the newest of them has some age."""
        marks: list[tuple[int, int, int]] = []
        newest = 0.0
        for path in (self.path, self.path.with_name(self.path.name + "-wal")):
            try:
                found = path.stat()
            except OSError:
                continue
            # An empty log says nothing, and comes and goes with those who only read.
            if found.st_size:
                marks.append((found.st_ino, found.st_size, found.st_mtime_ns))
                newest = max(newest, found.st_mtime)
        return tuple(marks), time.time() - newest > SETTLED_S
