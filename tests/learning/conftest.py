"""Trials for the tests of tuners."""

import sys
from pathlib import Path

import numpy as np
import pytest

from chargetune.episode.score import Score

sys.path.insert(0, str(Path(__file__).parent))

from toy_loop import Told


@pytest.fixture(scope="session")
def told():
    """Make a trial; without a score it failed, or runs."""

    def make(number, theta, objective=None, excess=None, *, status=None, tolerance=1e-3, profile=None):
        if objective is None:
            return Told(number, tuple(theta), status or "failed", None)
        limits = {} if excess is None else {"limit": float(excess)}
        score = Score(
            objective=float(objective),
            performance=float(objective) - 10 * max(0.0, float(excess or 0.0)),
            excess=limits,
            tolerance=dict.fromkeys(limits, tolerance),
            profile={} if profile is None else {"limit": tuple(profile)},
        )
        return Told(number, tuple(theta), "done", score)

    return make


@pytest.fixture(scope="session")
def run(told):
    """Tune a function theta -> (objective, excess or None), one trial at a time."""

    def tune(tuner, space, function, count, profile=None):
        trials = []
        while len(trials) < count:
            theta = tuner.ask(space, trials)[0]
            objective, excess = function(np.asarray(theta))
            trials.append(told(len(trials), theta, objective, excess, profile=None if profile is None else profile(theta)))
        return trials

    return tune
