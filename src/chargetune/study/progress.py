"""How far a run is: what is told after each trial."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from chargetune.study.trial import Trial, TrialStatus, best_feasible

__all__ = ["Progress", "Tally"]

# The trial told last, the best feasible trial, the number of done trials that broke a limit, the number of failed trials.
Progress = Callable[[Trial, Trial | None, int, int], None]


class Tally:
    """Incumbent, violations and failures, kept up trial by trial."""

    def __init__(self, known: Iterable[Trial], progress: Progress | None) -> None:
        known = list(known)
        self.incumbent = best_feasible(known)
        self._violating = sum(t.score is not None and not t.score.feasible for t in known)
        self._failures = sum(t.status is TrialStatus.FAILED for t in known)
        self._progress = progress

    def add(self, told: Trial) -> None:
        """Count one more trial and tell of it."""
        self.incumbent = best_feasible([t for t in (self.incumbent, told) if t is not None])
        self._violating += told.score is not None and not told.score.feasible
        self._failures += told.status is TrialStatus.FAILED
        if self._progress is not None:
            self._progress(told, self.incumbent, self._violating, self._failures)
