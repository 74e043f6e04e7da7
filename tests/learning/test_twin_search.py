"""The search on a simulated plant, on a valley with a limit, against its closed form."""

from types import SimpleNamespace

import numpy as np
import pytest

from chargetune.episode.score import Score
from chargetune.learning.twin_search import Search
from chargetune.model.parameters import Parameter, ParameterSpace

SPACE = ParameterSpace((Parameter("x", 0.0, 1.0, 0.5, size=2),))
START = np.array([0.1, 0.8])
TOLERANCE = 0.01


class Counted(Search):
    """Objective -1 - 10 (u1 - u0^2)^2 - (1 - u0)^2, and the limit u0 <= most; how many points were simulated is counted."""

    def __init__(self, most: float) -> None:
        self.simulated = 0

        def simulate(thetas):
            self.simulated += len(thetas)
            return [SPACE.to_unit(theta) for theta in thetas]

        def score(u):
            objective = float(-1.0 - 10.0 * (u[1] - u[0] ** 2) ** 2 - (1.0 - u[0]) ** 2)
            return Score(objective, objective, {"limit": float(u[0] - most)}, {"limit": TOLERANCE})

        super().__init__(SimpleNamespace(score=score), simulate, SPACE)
        self.scale([START, SPACE.to_unit(SPACE.default)])


@pytest.mark.parametrize("most", [0.6, 0.8, 2.0])
def test_it_finds_the_best_that_keeps_the_limit(most):
    search = Counted(most)
    search.refine(START, 60)
    best = search.best()
    assert best[0] <= most
    # It aims at half a tolerance inside.
    expected = -1.0 - max(0.0, 1.0 - most + 0.5 * TOLERANCE) ** 2
    assert search.score(best).objective == pytest.approx(expected, abs=5e-3)


@pytest.mark.parametrize("most", [0.6, 0.8, 2.0])
@pytest.mark.parametrize("kept", [False, True])
def test_with_a_gain_it_ends_where_little_is_left_to_win(most, kept):
    whole, short = Counted(most), Counted(most)
    whole.refine(START, 60)
    gain = 1e-3
    short.refine(START, 60, gain, None if kept else START)
    assert short.simulated < whole.simulated
    won, most_won = (search.score(search.best()).objective for search in (short, whole))
    # An iteration won less than the gain when all that was left was to converge.
    assert won >= most_won - 3 * gain * abs(most_won)


def test_a_search_that_has_won_nothing_yet_goes_on():
    # The start breaks the limit: the first steps lead to where it is kept and win nothing.
    search = Counted(0.3)
    search.refine(np.array([0.9, 0.2]), 60, 1e-3)
    best = search.best()
    assert best[0] <= 0.3
    assert search.score(best).objective == pytest.approx(-1.0 - 0.7**2, abs=0.03)


def test_one_that_cannot_move_ends_at_once():
    # No theta keeps a limit of -1, and at the best theta nothing is left to win.
    search = Counted(-1.0)
    search.refine(np.array([0.0, 0.0]), 60, 1e-3)
    without = Counted(-1.0)
    without.refine(np.array([0.0, 0.0]), 60)
    assert search.simulated <= without.simulated
    assert search.simulated < 60


@pytest.mark.parametrize("start", [[0.9, 0.5], [0.8, 0.3]])
def test_what_counts_as_won_is_what_best_would_choose(start):
    # Of points that break the limit no more than the start some are won on the way to it, of those that keep it none.
    start = np.array(start)
    as_start, kept = Counted(0.3), Counted(0.3)
    as_start.refine(start, 60, 1e-3, start)
    kept.refine(start, 60, 1e-3)
    assert as_start.simulated < kept.simulated
    assert as_start.score(as_start.best(start)).objective > as_start.score(start).objective
    assert kept.score(kept.best()).objective == pytest.approx(-1.0 - 0.7**2, abs=0.01)
