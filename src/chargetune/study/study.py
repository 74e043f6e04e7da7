"""Study: ask, tell, fail, run, resume. Its life is in the store; this object only holds the way to it."""

from __future__ import annotations

import os
import socket
import warnings
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from functools import partial
from types import TracebackType
from typing import Any, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from chargetune.episode.episode import Ending, Episode
from chargetune.episode.score import Score
from chargetune.model.parameter_space import ParameterSpace
from chargetune.runtime.interrupts import raise_lost_interrupt
from chargetune.study.changes import Carry, carried_over
from chargetune.study.dataframe import study_html, trials_dataframe
from chargetune.study.evaluation import Evaluate, trial_seed
from chargetune.study.executors import bounded_workers, process_executor
from chargetune.study.identity import StudyError, check_change, study_identity
from chargetune.study.progress import Progress, Tally, progress_bar
from chargetune.study.provenance import utc_now, versions
from chargetune.study.result import StudyResult, allowed, by_newest, by_performance, made_from, read_result, with_belief
from chargetune.study.runner import Losses, WorkerError, check_crosses, lost, outcomes
from chargetune.study.schedule import Schedule
from chargetune.study.serialization import canonical_json, score_to_json, sha256
from chargetune.study.store.database import Hold
from chargetune.study.store.rows import ResultRecord, result_of
from chargetune.study.store.store import Store, StudyRecord
from chargetune.study.store.trace import Traceable, encode
from chargetune.study.trial import Trial, TrialStatus, best_feasible, best_performance
from chargetune.study.warm_start import Earlier, read_earlier

__all__ = ["SAME_FAILURES", "Proposer", "Study", "StudyError", "WorkerError"]

# Trials that fail for one and the same reason from the first one on, until the study is not gone on with.
SAME_FAILURES = 3


# The same as learning's Tuner, written again because importing that folder loads torch, which showing a study does not need.
class Proposer(Protocol):
    """A tuner: a pure function of space, trials and n. Same arguments, same thetas, bit for bit."""

    def ask(self, space: ParameterSpace, trials: Sequence[Trial], n: int = 1) -> NDArray[np.float64]:
        """``n`` thetas inside the bounds, shape (n, d). Running trials are pending points."""
        ...


@dataclass(frozen=True)
class Study:
    """A study in a store, held by this process until `close`. Made by `create_or_resume`.

    Trials belong to batches of ``batch`` consecutive numbers, beginning with 0. In `run` a batch is proposed from the trials of
    the batches before it and from nothing else, when all of them are told. So the trials depend on neither the number of workers,
    nor the order in which they finish, nor interruptions, nor on how often ``trials`` was raised. Only ``run(workers=...)`` with
    more than one worker gives this up, for workers that never wait.
    """

    store: Store
    record: StudyRecord
    space: ParameterSpace
    tuner: Proposer
    seed: int
    batch: int
    lease: Hold
    term: int
    earlier: tuple[Trial, ...] = ()

    @classmethod
    def create_or_resume(
        cls,
        store: Store,
        name: str,
        *,
        config: Mapping[str, Any],
        space: ParameterSpace,
        tuner: Proposer,
        seed: int = 0,
        batch: int = 1,
        hardware: bool = False,
        earlier: Sequence[Earlier] = (),
        accept_changed: bool = False,
        carry: Carry | None = None,
    ) -> Self:
        """The study ``name`` of the store, begun if there is none.

        config
            JSON data that says what an evaluation does. It is compared on resume, together with space, tuner, seed and batch.
        hardware
            The plant is no simulation: a trial is handed out at most once and never repeated by the program.
        earlier
            Studies whose told trials are its initial data D_0: the tuner gets them before its own. They are copied when the study is
            begun, with traces and origin, and keep numbers below 0; `trials` and `best` leave them out.
        accept_changed
            Resume although something differs; the parameters must keep names, order and units, and ``earlier`` must be what it was.
            Old trials outside of the bounds are set apart, see `carried_over`; back in them they count again.
        carry
            What is known of the configuration: old trials of another closed loop are then set apart, too, and judged again from
            their traces where only the verdict changes. None: the old trials stay as they are.

        Raises ValueError for bad arguments; StudyError when what is resumed differs, or when another process holds the study.
        """
        identity = study_identity(
            name, config=config, space=space, tuner=tuner, seed=seed, batch=batch, hardware=hardware, earlier=[e.name for e in earlier]
        )
        record = next((r for r in store.studies() if r.name == name), None)
        record = record or store.add_study(name, identity, hardware=hardware, earlier=read_earlier(earlier, space))
        lease = _take_lease(store, record)
        try:
            record = store.study(name)
            if check_change(record, identity, accept_changed=accept_changed):
                store.change_study(record.id, identity, _carried(store, record, identity, space, carry))
                record = store.study(name)
            term = store.note_holder(record.id, os.getpid(), socket.gethostname())
        except BaseException:
            lease.release()
            raise
        return cls(store, record, space, tuner, seed, batch, lease, term, tuple(store.earlier(record.id)) if earlier else ())

    def close(self) -> None:
        """Give the study back, so that another process can go on with it. The store stays open."""
        self.lease.release()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, traceback: TracebackType | None) -> None:
        self.close()

    def trials(self) -> list[Trial]:
        """All trials by number, those that are running included."""
        return self.store.trials(self.record.id)

    def running(self) -> list[Trial]:
        """Trials that were asked for and are not told. After a crash these are the ones to evaluate again."""
        return [t for t in self.trials() if t.status is TrialStatus.RUNNING]

    def best(self) -> Trial | None:
        """The trial of the largest objective that was measured to keep every limit; the `result` may be another.

        Where each trial is under a condition of its own (`RangeTwinTuner`) it is the luckiest start, and only the `result` says anything.
        """
        return best_feasible(allowed(self.record, self.trials()))

    def best_performance(self) -> Trial | None:
        """The trial of the largest performance G, the incumbent of the paper's Algorithm 1."""
        return best_performance(allowed(self.record, self.trials()))

    def result(self) -> StudyResult:
        """The result of the study as it stands, and why: the one that every command and page shows.

        The tuner is asked which trial it believes best from all traces (`TwinTuner.best`, `Composite.best`, which may take seconds),
        see `with_belief` for what that counts; the answer is stored. A stored one of exactly these told trials is given at once.
        `run` does this when it ends, not when it is interrupted. A trial told later makes the stored result one of other trials:
        `read_result`, and so `show`, `certify` and the pages, then takes what was measured, and says so, until this is called.
        """
        trials = self.trials()
        known = read_result(self.store, self.record, trials)
        if known.asked:
            return known
        own, newest = by_performance(self.record.identity), by_newest(self.record.identity)
        count = allowed(self.record, trials)
        found = with_belief(count, lambda: self._believed_best(count), by_performance=own, newest=newest)
        number = None if found.trial is None else found.trial.number
        made = ResultRecord(number, found.reason.value, made_from(self.record, trials))
        self.store.set_result(self.record.id, made, term=self.term)
        return replace(found, note=known.note)

    def _believed_best(self, trials: Sequence[Trial]) -> Trial | None:
        """The trial that the tuner believes best from all traces; None where it does not say, or names one of an earlier study."""
        best = getattr(self.tuner, "best", None)
        told = [t for t in trials if t.status is not TrialStatus.RUNNING]
        index = None if best is None else best(self.space, self._traced(told))
        return None if index is None or index < len(self.earlier) else told[index - len(self.earlier)]

    def trials_dataframe(self) -> Any:
        """All trials as a pandas data frame, see `trials_dataframe`. Raises ImportError without pandas."""
        return trials_dataframe(self.space, self.trials())

    def _repr_html_(self) -> str:
        about = {"tuner": type(self.tuner).__name__, "store": self.store.label}
        trials = self.trials()
        return study_html(self.record.name, about, self.space, trials, read_result(self.store, self.record, trials))

    def trace(self, number: int) -> tuple[dict[str, NDArray[Any]], dict[str, Any]] | None:
        """Arrays and metadata of a trial's episode, None when none was stored."""
        return self.store.trace(self.record.id, number)

    def ask(self, n: int = 1) -> list[Trial]:
        """The next ``n`` trials, proposed from all trials so far, and recorded as running before this returns.

        Telling each batch before asking for the next one, ``ask(batch)``, gives the same trials as `run`.
        """
        if isinstance(n, bool) or not isinstance(n, int) or n < 1:
            raise ValueError(f"n = {n!r}, allowed is an integer >= 1")
        trials = self.trials()
        return self._record(len(trials), self._propose(trials, n), trials)

    def ask_batch(self, limit: int) -> list[Trial]:
        """The rest of the next batch up to trial number ``limit - 1``, as `run` asks; empty when there are ``limit`` trials.

        Raises StudyError while a trial of an earlier batch is running.
        """
        trials = self.trials()
        first = len(trials) - len(trials) % self.batch
        count = min(first + self.batch, limit) - len(trials)
        if count <= 0:
            return []
        before = trials[:first]
        waiting = [t.number for t in before if t.status is TrialStatus.RUNNING]
        if waiting:
            raise StudyError(f"the trials {waiting} are not told, the next batch is proposed when they are")
        # A batch that was cut by an earlier limit is proposed again as a whole: the tuner is a pure function.
        thetas = self._propose(before, self.batch)[len(trials) - first :]
        return self._record(len(trials), thetas[:count], before)

    def hand_out(self, trials: Sequence[Trial], worker: str = "") -> list[Trial]:
        """Record that these running trials begin now, and where; gives them with the number of this attempt.

        The attempt before is given up: its late result is refused. Raises StoreError for a trial that is told or was handed out
        since it was read, and for one on hardware that was handed out before.
        """
        return self.store.hand_out(self.record.id, trials, worker or f"process {os.getpid()} on {socket.gethostname()}", term=self.term)

    def tell(
        self, number: int, score: Score, episode: Traceable | None = None, *, ending: str = "done", attempt: int | None = None
    ) -> Trial:
        """Record the score of a running trial and its trace in one transaction. Telling the same again changes nothing.

        ``attempt`` is that of `hand_out`; None speaks for whatever attempt there is.

        Raises ValueError for a score with anything but finite numbers; StoreError for an unknown trial or a different second result.
        """
        score_to_json(score)
        return self.finish(number, score, None if episode is None else encode(episode.arrays(), episode.meta()), ending, attempt=attempt)

    def fail(self, number: int, reason: str, episode: Traceable | None = None, *, attempt: int | None = None) -> Trial:
        """Record that a running trial failed, why, and what trace there is. As safe to repeat as `tell`."""
        return self.finish(number, None, None if episode is None else encode(episode.arrays(), episode.meta()), reason, attempt=attempt)

    def finish(self, number: int, score: Score | None, trace: bytes | None, ending: str, *, attempt: int | None = None) -> Trial:
        """Record an outcome whose trace is encoded already; no score means that the trial failed."""
        if not isinstance(ending, str) or not ending:
            raise ValueError(f"ending = {ending!r}, allowed is a non-empty string")
        return self.store.finish_trial(
            self.record.id, number, score=score, ending=ending, trace=trace, provenance=self._provenance(), attempt=attempt, term=self.term
        )

    def run(
        self,
        evaluate: Evaluate,
        trials: int,
        *,
        executor: Executor | None = None,
        workers: int | None = None,
        attempts: int = 3,
        progress: Progress | bool | None = None,
    ) -> Trial | None:
        """Evaluate until the study has ``trials`` told trials, and return the result where it kept every limit, else None.

        executor
            Any executor of the caller's; None evaluates in this process, or with ``workers`` in processes of its own.
        workers
            None: batch after batch, each when the one before it is told; the trials depend on nothing but the study. A number:
            so many trials are under way at once, and as soon as one is told the next theta is proposed, with those under way as
            pending points. One worker gives the trials of a study in batches of 1; with more they depend on the order in which
            evaluations end. Each trial's provenance says which were ``pending`` when it was proposed. Without an executor there are
            not more than cores of this machine and trials left; a larger number is lowered with a warning.
        attempts
            A trial whose worker was lost is evaluated again until so many workers were lost by it; then it has failed. Losses are
            counted in the store. With 1, and always on hardware, nothing is repeated: a trial that was begun and is not told stops
            the study until somebody tells it or lets it fail.
        progress
            Receives the trial told last, the best feasible trial, the number of done trials that broke a limit, and of failed ones.
            True shows a bar, in a notebook as a widget (`tqdm.auto`, extra ``notebook``).

        Trials that a dead process left running are evaluated first, again, with the same theta and seed. What ``evaluate`` raises
        makes that trial failed and the study goes on; but an error that no theta could avoid (a name that is not known, a package
        that is missing, a plant that refuses its set-up) ends it, and the trial stays to be evaluated when that is mended. So does one
        and the same reason in each of the first `SAME_FAILURES` trials. On Ctrl-C evaluations that did not begin are cancelled and
        KeyboardInterrupt passes on; the same call resumes. When all are told the tuner is asked for the `result`; `advance` leaves
        that out.
        Raises ValueError for bad arguments, SetUpError for such an error, WorkerError when the executor gives no results, StudyError
        for trials that may not be repeated.
        """
        self.advance(evaluate, trials, executor=executor, workers=workers, attempts=attempts, progress=progress)
        return self.result().kept

    def advance(
        self,
        evaluate: Evaluate,
        trials: int,
        *,
        executor: Executor | None = None,
        workers: int | None = None,
        attempts: int = 3,
        progress: Progress | bool | None = None,
    ) -> None:
        """As `run`, without asking for the result: for who goes on at once."""
        for name, value in (("trials", trials), ("attempts", attempts), ("workers", 1 if workers is None else workers)):
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise ValueError(f"{name} = {value!r}, allowed is an integer >= 1")
        with ExitStack() as stack:
            known = self.trials()
            if executor is None and workers is not None:
                told = sum(t.status is not TrialStatus.RUNNING for t in known)
                workers, said = bounded_workers(workers, max(1, trials - told))
                if said:
                    warnings.warn(said, RuntimeWarning, stacklevel=2)
                executor = stack.enter_context(process_executor(workers))
            check_crosses(evaluate, executor)
            if isinstance(progress, bool):
                progress = stack.enter_context(progress_bar(known, trials)) if progress else None
            tally = Tally(known, progress)
            left = [t for t in known if t.status is TrialStatus.RUNNING]
            attempts = 1 if self.record.hardware else attempts
            begun = [t for t in left if t.attempt]
            if begun and attempts == 1:
                raise StudyError(
                    f"the trials {[t.number for t in begun]} were begun and are not told; whether their plant ran is not known, and"
                    f" {'on hardware' if self.record.hardware else 'with attempts = 1'} nothing is repeated: tell them or let them fail"
                )
            # In this process the first loss is not counted: nobody was left to do it.
            uncounted = executor is None
            for trial in [t for t in begun if t.losses + uncounted >= attempts]:
                tally.add(self.finish(trial.number, None, None, lost(trial.losses + uncounted)))
                left.remove(trial)
            schedule = Schedule(
                left=[t for t in left if t.losses <= 0],
                suspects=[t for t in left if t.losses > 0],
                batch=lambda: self.ask_batch(trials),
                one=lambda: self._ask_ahead(trials),
                workers=workers,
            )

            def following(busy: int) -> Trial | None:
                trial = schedule(busy)
                return None if trial is None else self.hand_out([trial])[0]

            losses = Losses({t.number for t in begun}, attempts, partial(self.store.count_loss, self.record.id, term=self.term))
            finished = stack.enter_context(closing(outcomes(evaluate, following, executor, losses)))
            for trial, outcome in finished:
                raise_lost_interrupt()
                tally.add(self.finish(trial.number, outcome.score, outcome.trace, outcome.ending, attempt=trial.attempt))
                if outcome.score is None:
                    _refuse_sameness(self.trials())

    def _ask_ahead(self, limit: int) -> list[Trial]:
        """One more trial while others are running; none when there are ``limit`` trials."""
        trials = self.trials()
        if len(trials) >= limit:
            return []
        pending = [t.number for t in trials if t.status is TrialStatus.RUNNING]
        return self._record(len(trials), self._propose(trials, 1), trials, pending=pending)

    def _propose(self, trials: Sequence[Trial], n: int) -> list[tuple[float, ...]]:
        thetas = np.asarray(self.tuner.ask(self.space, self._traced(trials), n), dtype=float)
        if thetas.shape != (n, self.space.dimension):
            raise StudyError(f"the tuner proposed an array of shape {thetas.shape}, expected ({n}, {self.space.dimension})")
        return [tuple(float(v) for v in self.space.validate(theta)) for theta in thetas]

    def _traced(self, trials: Sequence[Trial]) -> list[Trial]:
        """Earlier studies' trials and those of these that count, each with a reader of its episode where it has a trace."""
        known = [*self.earlier, *allowed(self.record, trials)]
        return [t if t.trace_sha256 is None else replace(t, episode=partial(self.episode, t.number)) for t in known]

    def episode(self, number: int) -> Episode | None:
        """A trial's episode, None when none was stored or it is not an episode of this library."""
        trace = self.trace(number)
        try:
            return None if trace is None else Episode.from_arrays(*trace)
        except (KeyError, TypeError, ValueError):
            # A trace of the caller's own shape is kept for the caller, and is nothing that a tuner can read.
            return None

    def _record(self, first: int, thetas: Sequence[tuple[float, ...]], known: Sequence[Trial], **more: Any) -> list[Trial]:
        # A tuner, and the twin in it, is a pure function of the trials it was given, so these are its whole state.
        state = [[t.number, list(t.theta), *result_of(t)] for t in (*self.earlier, *allowed(self.record, known))]
        made_with = {**self._provenance(), "learnt_sha256": sha256(canonical_json(state, "trials")), **more}
        now = utc_now()
        trials = [
            Trial(number, theta, seed=trial_seed(self.seed, number), asked_at=now, provenance=made_with)
            for number, theta in enumerate(thetas, start=first)
        ]
        self.store.add_trials(self.record.id, trials, term=self.term)
        return trials

    def _provenance(self) -> dict[str, Any]:
        return {"study_sha256": self.record.identity_sha256, "versions": versions()}


def _carried(store: Store, record: StudyRecord, identity: Mapping[str, Any], space: ParameterSpace, carry: Carry | None) -> list[Trial]:
    def episode(number: int) -> Episode | None:
        trace = store.trace(record.id, number)
        return None if trace is None else Episode.from_arrays(*trace)

    new_sha256 = sha256(canonical_json(identity, "study"))
    return carried_over(
        store.trials(record.id), old=record.identity, new=identity, new_sha256=new_sha256, space=space, carry=carry, episode=episode
    )


def _refuse_sameness(trials: Sequence[Trial]) -> None:
    """StudyError when the first trials failed, as many as there are, and all for the same reason."""
    told = [t for t in trials if t.status in (TrialStatus.DONE, TrialStatus.FAILED)]
    # A loop that was ended at a limit says something of its theta.
    failed = all(t.score is None and not (t.ending or "").startswith(Ending.LIMIT.value) for t in told)
    if failed and len(told) == SAME_FAILURES and len({t.ending for t in told}) == 1:
        raise StudyError(f"each of the first {SAME_FAILURES} trials failed for the same reason, so others would too: {told[0].ending}")


def _take_lease(store: Store, record: StudyRecord) -> Hold:
    lease = store.hold(record.id)
    if lease is None:
        raise StudyError(f"{store.label}: study {record.name!r} is held by {store.holder(record.id)}; end that process, or wait for it")
    return lease
