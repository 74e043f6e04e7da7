"""Where a safe study begins, on plants whose answer is known in closed form."""

from dataclasses import dataclass, field

import numpy as np
import pytest

from chargetune.episode.score import Score
from chargetune.learning import NoSafeThetaError, Safety
from chargetune.learning.candidates import Proposal
from chargetune.learning.safe_mode import safe_thetas
from chargetune.learning.twin.ensemble import Prediction
from chargetune.learning.twin.settings import TwinSettings
from chargetune.model.parameter_space import Parameter, ParameterSpace


class Verdict:
    """An episode is its own excess over the one limit."""

    def score(self, episode):
        return Score(0.0, 0.0, {"limit": episode}, {"limit": 1e-3})


@dataclass
class Sides:
    """Plants whose excess falls by 1 for each parameter at its safe side and rises by 1 for each at the other; ``loops`` are counted."""

    safe: np.ndarray
    level: float
    discrepancy: None = None
    settings: TwinSettings = field(default_factory=TwinSettings)
    loops: list = field(default_factory=list)

    def predict(self, theta, seed, count=None):
        count = count or self.settings.plants
        self.loops.append(count)
        right = np.sum(np.where(self.safe > 0.5, theta, 1.0 - theta) > 0.5)
        excess = self.level + 0.1 * np.random.default_rng(seed).standard_normal(count) - 2.0 * right + self.safe.size
        return Prediction(Verdict(), tuple(float(value) for value in excess), self.settings.near)


def start(ensemble, safety=None):
    space = ParameterSpace(tuple(Parameter(f"p{i}", 0.0, 1.0, 0.5) for i in range(ensemble.safe.size)))
    safety = safety or Safety()
    return safe_thetas(Proposal(space, ensemble, [], safety.probability, 0), safety)


@pytest.mark.parametrize("count", [1, 2, 3, 4, 12])
def test_the_start_is_the_one_safe_corner_and_few_loops_find_it(count):
    safe = np.random.default_rng(count).integers(0, 2, count).astype(float)
    ensemble = Sides(safe, count - 1.0)
    np.testing.assert_array_equal(start(ensemble), [safe])
    # Twelve parameters have 4096 corners; one after the other they are thirteen, and at most eight of three.
    assert len(ensemble.loops) <= 2 + max(8, count + 1)


def test_where_no_corner_is_safe_that_is_said():
    with pytest.raises(NoSafeThetaError, match=r"the most cautious one: 0\.00"):
        start(Sides(np.ones(5), 6.0))


def test_where_every_loop_fails_no_corner_is_safe():
    class Failing(Sides):
        def predict(self, theta, seed, count=None):
            return Prediction(Verdict(), (None,) * (count or 8), 3.0)

    prediction = Failing(np.ones(2), 0.0).predict(np.ones(2), 0)
    assert prediction.probability() == 0.0
    assert prediction.objective() == -np.inf
    assert prediction.upper_windows(1.0).shape == (0,)
    with pytest.raises(NoSafeThetaError, match=r"the most cautious one: 0\.00"):
        start(Failing(np.ones(2), 0.0))


def test_a_corner_that_only_the_plants_it_was_chosen_by_allow_is_no_start():
    class Lucky(Sides):
        def predict(self, theta, seed, count=None):
            return Prediction(Verdict(), (-1.0 if seed == 0 else 1.0,) * (count or 8), 3.0)

    with pytest.raises(NoSafeThetaError, match="no corner"):
        start(Lucky(np.ones(2), 0.0))


def test_a_declared_start_is_taken_as_it_is_and_refused_outside_the_space():
    ensemble = Sides(np.ones(2), 9.0)
    np.testing.assert_array_equal(start(ensemble, Safety(start=(0.25, 0.5))), [[0.25, 0.5]])
    assert ensemble.loops == []
    with pytest.raises(ValueError, match="p1 = 9"):
        start(ensemble, Safety(start=(0.25, 9.0)))
