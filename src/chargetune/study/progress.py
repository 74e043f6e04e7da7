"""How far a run is: what is told after each trial."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager

from chargetune.study.trial import Trial, TrialStatus, best_feasible

__all__ = ["Progress", "Tally", "progress_bar"]

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


@contextmanager
def progress_bar(known: Iterable[Trial], trials: int) -> Iterator[Progress]:
    """A bar of tqdm, a widget in a notebook. Raises ImportError without tqdm."""
    try:
        from tqdm.auto import tqdm
    except ImportError as error:
        raise ImportError("progress=True needs tqdm: pip install 'chargetune[notebook]'") from error
    told = sum(t.status is not TrialStatus.RUNNING for t in known)
    with tqdm(total=max(trials, told), initial=told, unit="trial") as bar:

        def show(_: Trial, incumbent: Trial | None, violating: int, failures: int) -> None:
            best = "none" if incumbent is None or incumbent.score is None else f"{incumbent.score.objective:.4g}"
            bar.set_postfix_str(f"best {best}, {violating} over, {failures} failed", refresh=False)
            bar.update()

        yield show
