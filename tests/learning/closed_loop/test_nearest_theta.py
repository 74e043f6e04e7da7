"""The nearest theta that promises as much, against its closed form."""

from types import SimpleNamespace

import numpy as np
import pytest
from chargetune.learning.closed_loop.nearest_theta import GAIN, _LeastDistance, nearest
from scipy.optimize import minimize

from chargetune.episode.score import Score
from chargetune.learning.closed_loop.search import Search
from chargetune.learning.closed_loop.slp import Linearisation, Point, solve_slp
from chargetune.model.parameter_space import Parameter, ParameterSpace

SPACE = ParameterSpace((Parameter("speed", 0.0, 2.0, 1.0, size=2), Parameter("unused", -4.0, 4.0, 0.0, size=3)))


def search(bend=0.0):
    """Objective u0 in the unit cube, and a limit u0 - u1 + bend (u0 - 0.5)^2 <= 0.1 with a tolerance of 0.01."""

    def simulate(thetas):
        return [SPACE.to_unit(theta) for theta in thetas]

    def excess(u):
        return float(u[0] - u[1] + bend * (u[0] - 0.5) ** 2 - 0.1)

    def samples(u):
        return {"limit": (np.array([excess(u), excess(u) - 0.2]), np.zeros(2, dtype=int))}

    def score(u):
        return Score(float(u[0]), float(u[0]), {"limit": excess(u)}, {"limit": 0.01})

    return Search(SimpleNamespace(score=score, samples=samples), simulate, SPACE)


@pytest.mark.parametrize("bend", [0.0, 0.4])
@pytest.mark.parametrize("margin", [0.0, 3.0])
def test_what_is_needed_moves_and_nothing_else(bend, margin):
    best, theta = np.array([0.2, 0.3, 1.0, 2.0, 3.0]), np.array([0.6, 0.95, 0.1, 0.9, 0.4])
    # Both entries of what is needed stay in part: the gain is worth a step of 6e-4, and u1 is as large as the limit asks for.
    u0 = 0.6 * (1.0 - GAIN)
    u1 = u0 + bend * (u0 - 0.5) ** 2 - 0.1 + (margin - 1.0) * 0.01
    expected = np.concatenate([[u0, u1], SPACE.to_unit(best)[2:]])
    found = SPACE.to_unit(nearest(search(bend), SPACE, best, SPACE.from_unit(theta), 0.6, np.array([-margin])))
    # A tenth of the gain and of the tolerance are rounding.
    np.testing.assert_allclose(found, expected, rtol=0, atol=1.2e-3)


def test_a_theta_that_promises_no_more_is_not_worth_a_step():
    best = np.array([1.2, 1.1, 1.0, 2.0, 3.0])
    theta = best + np.array([1e-4, 0.1, 0.3, -0.5, 0.2])
    found = nearest(search(), SPACE, best, theta, float(SPACE.to_unit(theta)[0]), np.zeros(1))
    np.testing.assert_allclose(found, best, rtol=0, atol=1e-9)


def bent_search():
    """Eleven windows, each with its own bent limit, u_i + 3 (u_(i+1) - 0.5)^2 <= 0.5: (search, its space, points simulated so far)."""
    space, simulated = ParameterSpace((Parameter("x", 0.0, 1.0, 0.5, size=11),)), []

    def simulate(thetas):
        simulated.extend(space.to_unit(theta) for theta in thetas)
        return [space.to_unit(theta) for theta in thetas]

    def bent(u):
        return u - 0.5 + 3.0 * (np.roll(u, -1) - 0.5) ** 2

    def samples(u):
        return {"limit": (bent(u), np.arange(11))}

    def score(u):
        windows = bent(u)
        return Score(float(u.sum()), float(u.sum()), {"limit": windows.max()}, {"limit": 1e-3}, profile={"limit": tuple(windows)})

    return Search(SimpleNamespace(score=score, samples=samples), simulate, space), space, simulated


def test_it_ends_where_it_is_not_left_to_run_back_and_forth():
    # The best theta is beyond all limits: the nearest has all entries at 0.5.
    found_by, space, simulated = bent_search()
    start = np.random.default_rng(0).uniform(0.1, 0.4, 11)
    found = nearest(found_by, space, np.full(11, 0.6), start, start.sum(), np.full(11, -1.0))
    # A tenth of the tolerance is rounding.
    np.testing.assert_allclose(found, 0.5, rtol=0, atol=1e-3)
    # Four times as many when SLSQP ends by itself, after as many iterations as it may take.
    assert len(simulated) < 100


def test_it_is_as_near_as_another_solver_finds_from_many_starts():
    found_by, space, simulated = bent_search()
    draw = np.random.default_rng(6)
    start, best = draw.uniform(0.0, 0.45, 11), draw.uniform(0.3, 1.0, 11)
    found = nearest(found_by, space, best, start, 0.5 * start.sum(), np.full(11, -1.0))
    assert len(simulated) < 160

    def room(u):
        return np.append(0.5 - u - 3.0 * (np.roll(u, -1) - 0.5) ** 2, u.sum() - 0.5 * start.sum())

    given = {"bounds": [(0.0, 1.0)] * 11, "constraints": {"type": "ineq", "fun": room}, "method": "SLSQP"}
    others = [minimize(lambda u: float(np.sum((u - best) ** 2)), draw.uniform(0.0, 0.5, 11), **given) for _ in range(10)]
    nearest_known = min(other.fun for other in others if other.success)
    assert np.sum((found - best) ** 2) == pytest.approx(nearest_known, rel=0.02)


def towards(to, start, row):
    """From start to the nearest point to ``to`` that keeps one row, in one dimension."""
    whole = abs(to - start) or 0.3

    def points(us):
        return [Point(1.0 + (float(u[0]) - to) ** 2 / whole**2, np.array([row(float(u[0]))])) for u in us]

    return float(solve_slp(points, np.array([start]), 8, 0.01, 0.01, _LeastDistance(np.array([to]), whole))[0])


def test_limits_that_are_broken_on_the_way_and_not_at_its_end_do_not_end_it():
    # Between 0.2 and 0.6 up to half a tolerance is missing: steps that keep the limit all the way end before it.
    def hill(u):
        return 0.5 * np.sin(np.pi * np.clip((u - 0.2) / 0.4, 0.0, 1.0)) ** 2

    assert towards(0.4, 0.65, hill) == pytest.approx(0.6, abs=0.05)
    assert towards(0.15, 0.65, hill) == pytest.approx(0.15, abs=0.01)


def test_a_limit_that_is_dearer_to_mend_than_its_price_is_mended():
    # Three tenths of a tolerance cost all of the distance, of which they are worth a hundredth at first.
    assert towards(0.8, 0.8, lambda u: u - 0.5) == pytest.approx(0.5, abs=0.02)


def test_a_row_that_becomes_known_within_a_step_of_the_differences_has_no_slope():
    for start in (0.1, 0.4995):
        assert towards(0.8, start, lambda u: -np.inf if u < 0.5 else u - 0.9) == pytest.approx(0.8, abs=0.01)


def test_where_the_best_trial_promises_as_much_nothing_else_is_simulated():
    found_by, space, simulated = bent_search()
    best = np.full(11, 0.5)
    start = best - np.linspace(0.1, 0.3, 11)
    np.testing.assert_array_equal(nearest(found_by, space, best, start, float(start.sum()), np.full(11, -1.0)), best)
    assert len(simulated) == 1


def test_from_where_limits_are_broken_it_mends_them_first():
    found_by, space, _ = bent_search()
    start = np.full(11, 0.52)
    found = nearest(found_by, space, start + 0.01, start, 0.9 * start.sum(), np.full(11, -1.0))
    np.testing.assert_allclose(found, 0.5, rtol=0, atol=1e-3)


@pytest.mark.parametrize("seed", range(5))
def test_a_step_is_the_least_distance_within_the_lines(seed):
    """Against SLSQP on the same quadratic program, without a violation and its price."""
    draw = np.random.default_rng(seed)
    u, to, jacobian = draw.uniform(0.3, 0.7, 6), draw.uniform(0.0, 1.0, 6), draw.standard_normal((40, 6))
    # All are kept at u.
    lines = Linearisation(u, -draw.uniform(0.0, 0.3, 40), np.zeros(6), jacobian)
    step, left = _LeastDistance(to, 0.7).step(lines, 0.25, price=1e3)
    low, high = lines.room(0.25)
    kept = {"type": "ineq", "fun": lambda d: -lines.rows - jacobian @ d, "jac": lambda d: -jacobian}
    other = minimize(
        lambda d: float(np.sum((u + d - to) ** 2)), np.zeros(6), jac=lambda d: 2 * (u + d - to), method="SLSQP",
        bounds=list(zip(low, high, strict=True)), constraints=kept, options={"ftol": 1e-14, "maxiter": 500},
    )  # fmt: skip
    assert other.success
    np.testing.assert_allclose(step, other.x, rtol=0, atol=1e-6)
    assert left == pytest.approx(0.0, abs=1e-6)
    assert _LeastDistance(to, 0.7).falls(lines, step) == pytest.approx((np.sum((u - to) ** 2) - other.fun) / 0.49, abs=1e-6)


def test_where_lines_cannot_be_kept_the_violation_has_its_price():
    # d <= -0.3 and a radius of 0.1: at a high price as far as may be, for nothing not at all.
    lines = Linearisation(np.array([0.5]), np.array([0.3]), np.zeros(1), np.array([[1.0]]))
    for price, d in ((100.0, -0.1), (1e-6, 0.1)):
        step, left = _LeastDistance(np.array([0.9]), 1.0).step(lines, 0.1, price)
        assert step == pytest.approx(d, abs=1e-6)
        assert left == pytest.approx(0.3 + d, rel=1e-3)
