"""Schedule: which trial of a study begins next."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable

from chargetune.study.trial import Trial

__all__ = ["Schedule"]


class Schedule:
    """First the trials that a dead process left, then new ones: in batches, or with ``workers`` one for each that is free.

    left
        Running trials that nobody works on.
    suspects
        Those of them that lost a worker before. Each runs alone, so that another loss is its own and no other's.
    batch, one
        The next batch of new trials, or the next single one; none when the study has enough.
    workers
        How many trials are under way at once; None: a batch at a time.
    """

    def __init__(
        self,
        left: Iterable[Trial],
        suspects: Iterable[Trial],
        *,
        batch: Callable[[], list[Trial]],
        one: Callable[[], list[Trial]],
        workers: int | None,
    ) -> None:
        self._waiting, self._suspects = deque(left), deque(suspects)
        self._batch, self._one, self._workers = batch, one, workers
        self._alone = False

    def __call__(self, busy: int) -> Trial | None:
        """The trial to begin now that ``busy`` are under way; None: there is none, or it has to wait."""
        if busy and (self._alone or (self._workers is not None and busy >= self._workers)):
            return None
        self._alone = bool(self._suspects)
        if self._suspects:
            return self._suspects.popleft()
        if not self._waiting and (self._workers is not None or not busy):
            self._waiting.extend(self._batch() if self._workers is None else self._one())
        return self._waiting.popleft() if self._waiting else None
