"""chargetune verify, of a store."""

from __future__ import annotations

from chargetune.cli.output import shown, steps
from chargetune.report.sensitivity import evaluation_in
from chargetune.report.study_view import StudyView, read_studies
from chargetune.runtime.counted import counted
from chargetune.study.recompute import recompute
from chargetune.study.store.store import Store
from chargetune.study.trial import Trial, TrialStatus
from chargetune.verify import Difference

__all__ = ["differences"]

TOLD = (TrialStatus.DONE, TrialStatus.FAILED)


def differences(location: str, study: str | None, number: int | None, *, quiet: bool) -> tuple[list[Difference], str]:
    """Every difference, and what was evaluated."""
    views = [view for view in read_studies(location) if study in (None, view.name)]
    if study is not None and not views:
        raise ValueError(f"study = {study!r}, allowed are {', '.join(view.name for view in read_studies(location))}")
    for view in views:
        if view.record is not None and view.record.hardware:
            raise ValueError(f"study {view.name!r} is on hardware, allowed is one whose plant is simulated: nothing can be evaluated again")
    # A trial that left neither score nor trace was lost with its worker, or failed before its first interval.
    work = [(view, one) for view in views for one in view.trials if one.status in TOLD and (one.score or one.trace_sha256)]
    if number is not None:
        work = [(view, one) for view, one in work if one.number == number]
        if len(work) != 1:
            found = f"{counted(len(work), 'study', 'studies')} of {shown(location)} with such a told trial"
            raise ValueError(f"--trial {number}: {found}, allowed is one; --study names it")
    out: list[Difference] = []
    with Store(location, read_only=True) as store, steps("trials", quiet=quiet) as step:
        for done, (view, one) in enumerate(work):
            step(done, len(work))
            where = f"study {view.name!r}, trial {one.number}"
            out += [Difference(f"{where}: {d.name}", d.stated, d.recomputed) for d in _one(store, view, one)]
    return out, f"{shown(location)}: {counted(len(work), 'trial')} evaluated again"


def _one(store: Store, view: StudyView, trial: Trial) -> list[Difference]:
    trace = None if trial.trace_sha256 is None or view.record is None else store.trace(view.record.id, trial.number)
    return recompute(evaluation_in(view), trial, trace)
