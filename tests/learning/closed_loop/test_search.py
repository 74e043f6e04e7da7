"""The search on a simulated plant, with a limit of two windows, against its closed form."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.optimize import differential_evolution
from toy_loop import LIMIT, LOSS, Plant, ToyLoop, fill, structural
from toy_loop import SPACE as VESSEL
from toy_loop import TOLERANCE as TOLERANCE_OF_GAUGE

from chargetune.episode.score import Score
from chargetune.learning.closed_loop.search import GAP, Search
from chargetune.model.parameter_space import Parameter, ParameterSpace

SPACE = ParameterSpace((Parameter("x", 0.0, 1.0, 0.5, size=2),))
START = np.array([0.1, 0.8])
TOLERANCE = 0.01


def search(share=0.0, fails=lambda u: False):
    """Objective -1 - (1 - u0)^2 - (1 - u1)^2; u0 <= 0.6 in one window, u1 <= 0.7 in the other, each at 20 samples of which one matters."""
    seen = []

    def simulate(thetas):
        seen.extend(SPACE.to_unit(theta) for theta in thetas)
        return [None if fails(SPACE.to_unit(theta)) else SPACE.to_unit(theta) for theta in thetas]

    def samples(u):
        back = np.linspace(0.0, 1.0, 20)
        return {"limit": (np.concatenate([u[0] - 0.6 - back, u[1] - 0.7 - back]), np.repeat([0, 1], 20))}

    def score(u):
        excess, window = samples(u)["limit"]
        windows = tuple(float(excess[window == k].max()) for k in (0, 1))
        objective = float(-1.0 - np.sum((1.0 - u) ** 2))
        return Score(objective, objective, {"limit": max(windows)}, {"limit": TOLERANCE}, profile={"limit": windows})

    return Search(SimpleNamespace(score=score, samples=samples), simulate, SPACE, share), seen


@pytest.mark.parametrize("margin", [0.0, 2.0, np.array([3.0, -1.0])])
@pytest.mark.parametrize("share", [0.0, 0.8])
def test_it_finds_the_best_that_keeps_every_window_with_its_margin(margin, share):
    found, _ = search(share)
    best = found.refine(START, 30, 1e-4, margin)
    least = np.array([0.6, 0.7]) + TOLERANCE * (share - np.asarray(margin))
    assert np.all(best <= least + 1e-9)
    np.testing.assert_allclose(best, least, rtol=0, atol=1.5 * GAP * TOLERANCE)


def test_from_where_limits_are_broken_it_leads_to_where_they_are_kept():
    found, _ = search()
    best = found.refine(np.array([0.95, 0.9]), 30, 1e-4, 5.0)
    np.testing.assert_allclose(best, [0.55, 0.65], rtol=0, atol=1.5 * GAP * TOLERANCE)


def test_no_point_is_simulated_twice():
    found, seen = search()
    found.refine(found.refine(START, 30, 1e-4), 30, 1e-4)
    assert len({u.tobytes() for u in seen}) == len(seen)


def test_an_episode_that_fails_is_gone_around():
    found, _ = search(fails=lambda u: u[0] > 0.5)
    best = found.refine(START, 60, 1e-4)
    assert best[0] <= 0.5
    np.testing.assert_allclose(best, [0.5, 0.7], rtol=0, atol=0.01)


def test_where_no_point_keeps_the_limits_the_least_excess_is_best():
    found, _ = search()
    # Each window is 0.4 and 0.3 beyond at least.
    assert found.refine(START, 30, 1e-4, 100.0)[0] == pytest.approx(0.0, abs=1e-3)


def test_what_moves_nothing_stays_at_the_centre_of_the_proximal_term():
    space = ParameterSpace((Parameter("x", 0.0, 1.0, 0.5, size=2),))

    def score(u):
        return Score(-1.0 - (1.0 - u[0]), 0.0, {"limit": u[0] - 0.6}, {"limit": TOLERANCE})

    samples = lambda u: {"limit": (np.array([u[0] - 0.6]), np.array([0]))}  # noqa: E731
    found = Search(SimpleNamespace(score=score, samples=samples), lambda thetas: [space.to_unit(t) for t in thetas], space)
    best = found.refine(np.array([0.1, 0.9]), 30, 1e-5, 0.0, 1e-3, np.array([0.1, 0.3]))
    np.testing.assert_allclose(best, [0.6, 0.3], atol=1.5 * GAP * TOLERANCE)


def test_merit_tells_a_broken_limit_from_a_slow_charge():
    found, _ = search()
    kept, slow, broken = (found.merit(np.array(u)) for u in ([0.59, 0.69], [0.1, 0.1], [0.8, 0.69]))
    assert kept < slow < broken
    # With a margin what was kept is broken.
    assert found.merit(np.array([0.59, 0.69]), 5.0) > kept


@pytest.mark.usefixtures("virtual_machine")
@pytest.mark.parametrize("extra", [None, structural], ids=["of the model", "structural"])
def test_on_a_true_plant_it_finds_what_differential_evolution_finds(extra):
    """A loop that rides its limit at most samples: thousands of evaluations of another, global solver."""
    plant, simulated = Plant(unmodelled=extra), []

    def simulate(thetas):
        simulated.extend(thetas)
        return plant.episodes(thetas)

    found = Search(ToyLoop(), simulate, VESSEL, share=1.0)
    best = found.score(found.refine(np.full(3, 0.9), 60, 1e-5))

    def cost(points):
        """Of all points (3, n) at once: the objective is the mean of what is missing of the level."""
        loss, n = np.multiply(plant.factors, LOSS), points.shape[1]
        inflow, levels, _, *gauges = fill(
            VESSEL.lower + points.T * (VESSEL.upper - VESSEL.lower), np.tile(loss, (n, 1)), np.full(n, plant.gain)
        )
        if extra:
            gauges = [gauge + extra(levels[:, s], inflow) for gauge, s in zip(gauges, (slice(0, -1), slice(1, None)), strict=True)]
        over = np.max(gauges, axis=(0, 2)) - LIMIT - TOLERANCE_OF_GAUGE
        return np.mean(1.0 - levels[:, 1:], axis=1) + 1e3 * np.maximum(0.0, over)

    other = differential_evolution(cost, [(0.0, 1.0)] * 3, seed=0, maxiter=100, popsize=20, tol=1e-9, vectorized=True, updating="deferred")
    assert best.feasible
    # The gap of a twentieth of the tolerance costs a little.
    assert -best.objective < 1.002 * other.fun
    assert len(simulated) < 300
