"""One evaluation of theta, in whatever process: a failure comes back as a result, never as an exception."""

from __future__ import annotations

import traceback
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from chargetune.episode.episode import Ending, Episode
from chargetune.episode.score import Score
from chargetune.plants.plant import SetUpError
from chargetune.study.serialization import score_to_json
from chargetune.study.store.trace import Traceable, encode

__all__ = ["Evaluate", "Outcome", "evaluate_trial", "trial_seed"]

# Errors of a program, not of a theta: what is missing, misspelt or called in a wrong way is so for every theta.
PROGRAM = (ImportError, NameError, TypeError, KeyError, AttributeError, NotImplementedError)

# theta and a seed -> score (None: the episode is worth none), trace (None: there is none), why the episode ended
Evaluate = Callable[[NDArray[np.float64], int], tuple[Score | None, Traceable | None, str]]


@dataclass(frozen=True)
class Outcome:
    """What an evaluation gave; ``score`` is None when it failed. The trace is encoded already, so an outcome crosses processes small."""

    score: Score | None
    trace: bytes | None
    ending: str


def trial_seed(study_seed: int, number: int) -> int:
    """The seed of a trial: independent of all others, and of the order of evaluation. Below 2**53, exact in JSON everywhere."""
    state = np.random.SeedSequence(study_seed, spawn_key=(number,)).generate_state(1, np.uint64)
    return int(state[0]) >> 11


def evaluate_trial(evaluate: Evaluate, theta: tuple[float, ...], seed: int) -> Outcome:
    """Run one evaluation. What it raises, or returns against its contract, becomes an outcome without score that says so.

    Raises SetUpError, with the traceback, where no theta could work: for `PROGRAM` errors, and for what the plant refuses.
    KeyboardInterrupt and SystemExit pass through: they stop the study, they say nothing about theta. So does an episode that the user
    interrupted, which `run_episode` returns as such.
    """
    try:
        score, episode, ending = evaluate(np.array(theta), seed)
        trace = None if episode is None else encode(episode.arrays(), episode.meta())
    except SetUpError as error:
        raise SetUpError(str(error), error.details or traceback.format_exc()) from error
    except PROGRAM as error:
        raise SetUpError(f"{type(error).__name__}: {error}", traceback.format_exc()) from error
    except Exception as error:  # noqa: BLE001 - whatever a plant or a controller raises is this trial's failure, not the study's
        return Outcome(None, None, f"{type(error).__name__}: {error}")
    if isinstance(episode, Episode) and episode.ending is Ending.INTERRUPTED:
        raise KeyboardInterrupt(episode.message)
    if not isinstance(ending, str) or not ending:
        return Outcome(None, trace, f"ValueError: ending = {ending!r}, allowed is a non-empty string")
    try:
        if score is not None:
            score_to_json(score)
    except ValueError as error:
        # The score is nonsense, but the trace is what a person needs to find out why.
        return Outcome(None, trace, f"ValueError: {error}")
    return Outcome(score, trace, ending)
