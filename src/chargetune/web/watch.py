"""A store that others write to, read again when it changed."""

from __future__ import annotations

import os
import threading
from dataclasses import dataclass, field

from chargetune.report.study_view import StudyView, read_studies
from chargetune.study.store.database import database_at

__all__ = ["StoreWatch"]


@dataclass
class StoreWatch:
    """The studies of a store as they are now, for several viewers at a time: an unchanged store is read once.

    Opened read-only for each reading, so a store may be moved away and come back. Raises StoreError as `read_studies` does.
    """

    location: str | os.PathLike[str]
    _known: dict[int | None, tuple[object, list[StudyView]]] = field(default_factory=dict)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def studies(self) -> list[StudyView]:
        """All studies, oldest first. The same list object as long as the store did not change."""
        return self._read(None)

    def study(self, study_id: int) -> StudyView | None:
        """One study; None when there is none of this id. The same object as long as the store did not change."""
        return next(iter(self._read(study_id)), None)

    def _read(self, only: int | None) -> list[StudyView]:
        with self._lock:
            mark, settled = database_at(self.location).mark()
            known = self._known.get(only)
            if known is not None and known[0] == mark:
                return known[1]
            found = read_studies(self.location, only)
            if settled:
                self._known[only] = (mark, found)
            else:
                self._known.pop(only, None)
            return found
