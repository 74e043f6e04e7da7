"""What a figure needs of a stored study."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from chargetune.battery.charging.problem import ChargingProblem, judged_exactly
from chargetune.battery.studies.study_file import problem_of_document
from chargetune.episode.episode import Episode
from chargetune.learning.range_of_use.range_trace import RangeTrace
from chargetune.model.parameter_space import ParameterSpace
from chargetune.study.result import StudyResult, by_newest, read_result
from chargetune.study.serialization import space_from_json
from chargetune.study.store.store import Store, StoreError, StudyRecord
from chargetune.study.trial import Trial, TrialStatus

__all__ = ["ReadStudy", "StudyView", "read_studies", "read_study"]

WORST_PLANT = "each trial is a theta on drawn plants of the range of use, its trace that of the plant with the largest excess"


@dataclass(frozen=True)
class ReadStudy:
    """A trial and its stored episode; without an episode ``message`` says why."""

    trial: Trial
    episode: Episode | None
    message: str


@dataclass(frozen=True)
class StudyView:
    """A study as it stood when it was read from the store at ``location``.

    ``problem`` is None when the study is not one of battery charging.

    ``tuner`` is the tuner's name in the configuration, empty when that names none. ``record`` is what the store says of the
    study as a whole, None only for trials that come from no store. ``result`` is the study's result as the store has it.
    """

    location: str
    name: str
    tuner: str
    space: ParameterSpace
    trials: tuple[Trial, ...]
    problem: ChargingProblem | None
    result: StudyResult
    record: StudyRecord | None = None

    @property
    def over_range(self) -> bool:
        """Whether a trial is a theta on drawn plants of a range of use, of which the trace is that of one."""
        return self.problem is not None and self.tuner == "range"

    @property
    def comparable(self) -> bool:
        """Whether one trial's objective says that it is better than another: not where each is under a condition of its own."""
        return self.record is None or not by_newest(self.record.identity)

    @property
    def judged(self) -> ChargingProblem | None:
        """The problem as the stored traces are judged: those of a range of use hold true outputs."""
        return judged_exactly(self.problem) if self.problem is not None and self.over_range else self.problem

    @property
    def remark(self) -> str:
        """What must be said of the study wherever it is shown: its cell's remark, and whose the traces are."""
        if self.problem is None:
            return ""
        parts = [self.problem.cell.remark] if self.problem.cell.remark else []
        return "; ".join([*parts, WORST_PLANT] if self.over_range else parts)

    @property
    def untuned(self) -> Trial | None:
        """The first trial of theta_0, which a tuner asks for first."""
        default = self.space.default
        return next((t for t in self.trials if t.status is not TrialStatus.APART and np.array_equal(t.theta, default)), None)

    @property
    def start(self) -> Trial | None:
        """What the tuned trial is held against: the untuned one, else the first, which a safe study begins with."""
        return self.untuned or next((t for t in self.trials if t.number == 0), None)

    @property
    def start_label(self) -> str:
        """What a legend calls `start`: only theta_0 is untuned."""
        if self.untuned is not None or not self.trials:
            return "untuned"
        problem = self.problem
        if problem is None or problem.safety is None:
            return "first trial"
        if problem.safe_start is not None:
            return "declared start"
        # Over a range the first theta is chosen for all of it, and no cautious corner.
        return "cautious start" if problem.range is None else "first trial"

    @cached_property
    def units(self) -> dict[str, str]:
        """Unit of every signal in the first trace that can be read, by name; empty without one."""
        traced = [t for t in self.trials if t.trace_sha256 is not None]
        for reading in self.readings(traced) if traced else ():
            episode = reading.episode
            if episode is not None:
                names = (*episode.input_names, *episode.output_names)
                return dict(zip(names, (*episode.input_units, *episode.output_units), strict=True))
        return {}

    @property
    def tuned(self) -> Trial | None:
        """The trial that is the study's result; it need not have kept the limits. None without a score."""
        return self.result.trial

    @property
    def tuned_label(self) -> str:
        """What a legend calls the tuned trial, so that nobody takes one that broke a limit for a success."""
        return "tuned" if self.tuned is None or self.tuned.feasible else "tuned, over a limit"

    @property
    def tuned_dashes(self) -> str:
        """Line style of the tuned run: dashed when it is the start too, which then shows through."""
        return "--" if self.tuned is not None and self.tuned is self.start else "-"

    @property
    def others(self) -> tuple[Trial, ...]:
        """Told trials that are neither the start nor the tuned one, the failed ones included."""
        apart = [t.number for t in (self.start, self.tuned) if t is not None]
        return tuple(t for t in self.trials if t.status in (TrialStatus.DONE, TrialStatus.FAILED) and t.number not in apart)

    def episodes(self, trials: Iterable[Trial]) -> Iterator[tuple[Trial, Episode]]:
        """Those of ``trials`` that have a trace, each with its episode, read one at a time.

        Raises StoreError for a trace that is not as it was stored, naming the trial.
        """
        with Store(self.location, read_only=True) as store:
            record = store.study(self.name)
            for trial in trials:
                trace = None if trial.trace_sha256 is None else store.trace(record.id, trial.number)
                if trace is not None:
                    yield trial, Episode.from_arrays(*trace)

    def readings(self, trials: Iterable[Trial]) -> Iterator[ReadStudy]:
        """Each of ``trials`` with its episode or the reason why there is none; nothing is raised for a single trace."""
        with Store(self.location, read_only=True) as store:
            record = store.study(self.name)
            for trial in trials:
                try:
                    trace = None if trial.trace_sha256 is None else store.trace(record.id, trial.number)
                    if trace is None:
                        yield ReadStudy(trial, None, "no trace is stored")
                    else:
                        yield ReadStudy(trial, Episode.from_arrays(*trace), "")
                except StoreError as error:
                    yield ReadStudy(trial, None, str(error))
                except (KeyError, TypeError, ValueError) as error:
                    # A program may store arrays of its own with a trial.
                    yield ReadStudy(trial, None, f"the stored trace is not that of an episode ({error})")

    def range_trace(self, trial: Trial | None) -> RangeTrace | None:
        """All that the trace of a trial over a range of use holds; None for any other trial, and where an older version stored it.

        Raises StoreError for a trace that is not as it was stored.
        """
        if trial is None or not self.over_range:
            return None
        with Store(self.location, read_only=True) as store:
            trace = store.trace(store.study(self.name).id, trial.number)
        return None if trace is None else RangeTrace.from_arrays(*trace)

    def episode(self, trial: Trial | None) -> Episode | None:
        """The episode of one trial; None without trial or trace."""
        return None if trial is None else next((episode for _, episode in self.episodes([trial])), None)


def read_study(store: str | os.PathLike[str], name: str, *, trials: int | None = None) -> StudyView:
    """Read a study, or its first ``trials`` trials, without writing to the store.

    Raises StoreError for what is no store and for an unknown study, naming those that there are; ValueError for a study without trials.
    """
    with Store(store, read_only=True) as opened:
        record = opened.study(name)
        view = _view(opened, record, opened.trials(record.id)[:trials])
    if not view.trials:
        raise ValueError(f"{opened.label}: study {name!r} has no trials yet, so there is nothing to draw")
    return view


def read_studies(store: str | os.PathLike[str], only: int | None = None) -> list[StudyView]:
    """Every study of a store, oldest first, also those without trials; ``only`` reads the one with this id, if there is one.

    Raises StoreError for what is no store.
    """
    with Store(store, read_only=True) as opened:
        return [_view(opened, r, opened.trials(r.id)) for r in opened.studies() if only is None or r.id == only]


def _view(store: Store, record: StudyRecord, trials: Sequence[Trial]) -> StudyView:
    config = record.identity["config"]
    tuner = str(config.get("study", {}).get("tuner", ""))
    try:
        problem = problem_of_document(config) if "cell" in config else None
    except ValueError as error:
        raise ValueError(f"study {record.name!r}: {error}") from error
    return StudyView(
        location=store.location,
        name=record.name,
        tuner=tuner,
        space=space_from_json(record.identity["space"]),
        trials=tuple(trials),
        problem=problem,
        result=read_result(store, record, trials),
        record=record,
    )
