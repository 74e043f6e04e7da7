"""Evaluations under way, here or in an executor: begun as they come, told as they finish, begun again when a worker is lost."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Generator
from concurrent.futures import FIRST_COMPLETED, CancelledError, Executor, Future, ProcessPoolExecutor, wait
from dataclasses import dataclass
from typing import NoReturn

from chargetune.plants.plant import SetUpError
from chargetune.runtime.counted import counted
from chargetune.study.evaluation import Evaluate, Outcome, evaluate_trial
from chargetune.study.executors import ProcessExecutor
from chargetune.study.trial import Trial

__all__ = ["Losses", "WorkerError", "check_crosses", "lost", "outcomes"]


class WorkerError(Exception):
    """The executor gives no results any more. The trials it had stay running, a resume evaluates them again."""


@dataclass(frozen=True)
class Losses:
    """What is done about lost workers.

    resumed
        Numbers of the trials that another process had begun, which is dead or was interrupted.
    attempts
        How many workers a trial may lose until it has failed; with 1 it is never begun again.
    count
        Adds to the stored number of a trial's losses, and gives it.
    """

    resumed: frozenset[int] | set[int]
    attempts: int
    count: Callable[[int, int], int]


@dataclass(frozen=True)
class _Call:
    """What a worker was given: a trial, or after a loss the question whether the executor still works."""

    trial: Trial
    times: int = 0
    lost_by: BaseException | None = None


def check_crosses(evaluate: Evaluate, executor: Executor | None) -> None:
    """ValueError when ``evaluate`` cannot go to the processes of ``executor``."""
    if not isinstance(executor, (ProcessPoolExecutor, ProcessExecutor)):
        return
    try:
        pickle.dumps(evaluate)
    except Exception as error:
        raise ValueError(f"evaluate = {evaluate!r} does not go to another process ({error}); allowed is what pickle can copy") from error


def outcomes(
    evaluate: Evaluate, following: Callable[[int], Trial | None], executor: Executor | None, losses: Losses
) -> Generator[tuple[Trial, Outcome], None, None]:
    """Each trial with its outcome, in the order in which they finish; ``executor=None`` evaluates in this process.

    ``following`` gives the trial to begin now, told how many are under way; None: there is none, or it has to wait.

    When a worker is lost the executor has to unpickle ``evaluate`` again: where it cannot, the trial is not to blame. Else the
    trial is begun again until it has lost as many as allowed, and is then a failure. In this process a loss is the end of the
    process itself, so what is begun again is counted before, and taken back after it. Closing the iterator cancels what did not
    begin. Raises WorkerError when the executor gives no results, and at the first loss where nothing may be repeated.
    """
    if executor is None:
        yield from _outcomes_here(evaluate, following, losses)
        return
    calls: dict[Future[Outcome | None], _Call] = {}

    def submit(call: _Call) -> None:
        try:
            if call.lost_by is None:
                calls[executor.submit(_evaluate, evaluate, call.trial, call.times)] = call
            else:
                calls[executor.submit(_answer, evaluate, call.trial.number, call.times)] = call
        except Exception as error:  # noqa: BLE001 - each executor has its own errors
            # All that is under way went with the executor; each may be the one to blame.
            for other in (c for c in (*calls.values(), call) if c.lost_by is None):
                losses.count(other.trial.number, 1)
            _give_up(error)

    try:
        while True:
            trial = following(len(calls))
            if trial is not None:
                submit(_Call(trial))
            elif not calls:
                return
            # What has finished is told before the next theta is proposed.
            done, _ = wait(calls, timeout=None if trial is None else 0, return_when=FIRST_COMPLETED)
            for future in sorted(done, key=lambda f: calls[f].trial.number):
                call = calls.pop(future)
                then = _then(call, future, losses)
                if isinstance(then, Outcome):
                    yield call.trial, then
                else:
                    submit(then)
    finally:
        for future in calls:
            future.cancel()


def _outcomes_here(
    evaluate: Evaluate, following: Callable[[int], Trial | None], losses: Losses
) -> Generator[tuple[Trial, Outcome], None, None]:
    while (trial := following(0)) is not None:
        again = trial.number in losses.resumed
        # Should this process end now, then the count stays.
        if again:
            losses.count(trial.number, 1)
        try:
            outcome = evaluate_trial(evaluate, trial.theta, trial.seed)
        finally:
            if again:
                losses.count(trial.number, -1)
        yield trial, outcome


def lost(times: int, error: BaseException | None = None) -> str:
    """The ending of a trial that lost so many workers."""
    reason = "" if error is None else f" ({type(error).__name__}: {error})"
    return f"lost: each of {counted(times, 'attempt')} ended with the process that evaluated it{reason}"


def _evaluate(evaluate: Evaluate, trial: Trial, times: int) -> Outcome:  # noqa: ARG001 - Dask takes equal arguments for the same call
    return evaluate_trial(evaluate, trial.theta, trial.seed)


def _answer(evaluate: Evaluate, number: int, times: int) -> None:
    """Nothing: that it arrived says that the executor works and can unpickle ``evaluate``."""


def _then(call: _Call, future: Future[Outcome | None], losses: Losses) -> _Call | Outcome:
    """The outcome of a call, or what a worker is given next."""
    try:
        outcome = future.result()
    except SetUpError:
        raise
    except (Exception, CancelledError) as error:  # noqa: BLE001 - each executor has its own errors
        # An evaluation does not raise, so an error is the executor's and says nothing about theta.
        if call.lost_by is not None:
            losses.count(call.trial.number, -1)
            _give_up(call.lost_by)
        times = losses.count(call.trial.number, 1)
        if losses.attempts == 1:
            _give_up(error)
        return _Call(call.trial, times, error)
    if outcome is not None:
        return outcome
    if call.times < losses.attempts:
        return _Call(call.trial, call.times)
    return Outcome(None, None, lost(call.times, call.lost_by))


def _give_up(error: BaseException) -> NoReturn:
    raise WorkerError(f"a worker gave no result ({type(error).__name__}: {error}); the same call resumes the study") from error
