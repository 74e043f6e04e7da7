"""Evaluations of a batch, here or in an executor."""

from __future__ import annotations

import pickle
from collections.abc import Generator, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor, as_completed

from chargetune.study.evaluation import Evaluate, Outcome, evaluate_trial
from chargetune.study.trial import Trial

__all__ = ["WorkerError", "check_crosses", "outcomes"]


class WorkerError(Exception):
    """A worker was lost or gave no result. The trials it had stay running, a resume evaluates them again."""


def check_crosses(evaluate: Evaluate, executor: Executor | None) -> None:
    """ValueError when ``evaluate`` cannot go to the processes of ``executor``."""
    if not isinstance(executor, ProcessPoolExecutor):
        return
    try:
        pickle.dumps(evaluate)
    except Exception as error:
        raise ValueError(f"evaluate = {evaluate!r} does not go to another process ({error}); allowed is what pickle can copy") from error


def outcomes(evaluate: Evaluate, trials: Sequence[Trial], executor: Executor | None) -> Generator[tuple[Trial, Outcome], None, None]:
    """Each trial with its outcome, in the order in which they finish; ``executor=None`` evaluates in this process.

    Closing the iterator cancels what did not begin. Raises WorkerError when the executor gives no result.
    """
    if executor is None:
        for trial in trials:
            yield trial, evaluate_trial(evaluate, trial.theta, trial.seed)
        return
    futures: dict[Future[Outcome], Trial] = {}
    try:
        for trial in trials:
            futures[executor.submit(evaluate_trial, evaluate, trial.theta, trial.seed)] = trial
        for future in as_completed(futures):
            yield futures[future], future.result()
    except Exception as error:
        # An evaluation does not raise, so this is the executor's trouble and says nothing about theta.
        raise WorkerError(f"a worker gave no result ({type(error).__name__}: {error}); the same call resumes the study") from error
    finally:
        for future in futures:
            future.cancel()
