"""Sequential linear programming against closed forms and against other solvers."""

import numpy as np
import pytest
from scipy.optimize import linprog, minimize

from chargetune.learning.closed_loop.slp import Linearisation, Point, solve_slp


class Counted:
    """f and c as what `solve_slp` evaluates; ``points`` are all that it asked for."""

    def __init__(self, objective, rows, known=lambda u: True):
        self.objective, self.rows, self.known, self.points = objective, rows, known, []

    def __call__(self, points):
        self.points += list(points)
        return [Point(float(self.objective(u)), np.asarray(self.rows(u), float)) if self.known(u) else None for u in points]


def circle(u):
    """360 tangents to a circle of radius 0.4 around the middle: at its rim one limit takes over from another at every step."""
    angles = np.linspace(0.0, 2.0 * np.pi, 360, endpoint=False)
    return np.cos(angles) * (u[0] - 0.5) + np.sin(angles) * (u[1] - 0.5) - 0.4


def bent(u):
    """u_i + 3 (u_(i+1) - 0.5)^2 <= 0.5: as many bent limits as entries, which the best theta has all at 0."""
    return u - 0.5 + 3.0 * (np.roll(u, -1) - 0.5) ** 2


@pytest.mark.parametrize("start", [[0.5, 0.5], [0.85, 0.3], [0.0, 1.0], [1.0, 1.0]])
@pytest.mark.parametrize("way", [[1.0, 1.0], [1.0, 0.2], [-1.0, 0.3]])
def test_along_many_limits_to_the_one_that_matters(start, way):
    # Also from where all of them are broken.
    way = np.array(way)
    found = solve_slp(Counted(lambda u: -1.0 - way @ u, circle), np.array(start), 30, 1e-6)
    expected = 0.5 + 0.4 * way / np.linalg.norm(way)
    assert np.max(circle(found)) <= 1e-6
    assert way @ found == pytest.approx(way @ expected, abs=1e-4)


@pytest.mark.parametrize("seed", range(5))
def test_at_a_corner_it_arrives_in_few_steps(seed):
    problem = Counted(lambda u: -1.0 - u.sum(), bent)
    found = solve_slp(problem, np.random.default_rng(seed).uniform(0.1, 0.4, 11), 20, 1e-6)
    np.testing.assert_allclose(found, 0.5, rtol=0, atol=1e-4)
    # Twelve an iteration and what is corrected: eight to eleven iterations.
    assert len(problem.points) < 150


def test_along_a_bent_edge_steps_are_corrected_instead_of_shortened():
    # Between two bent limits four tolerances apart: a straight step of any length leaves them.
    def edge(u):
        middle = 0.1 + 3.0 * (u[0] - 0.3) ** 2
        return 1000.0 * np.array([u[1] - middle - 0.002, middle - u[1] - 0.002])

    problem = Counted(lambda u: 2.0 - u[0], edge)
    found = solve_slp(problem, np.array([0.3, 0.1]), 100, 1e-5)
    # Where the edge leaves the cube: 0.1 + 3 (u_0 - 0.3)^2 = 1.002.
    np.testing.assert_allclose(found, [0.3 + np.sqrt(0.902 / 3.0), 1.0], rtol=0, atol=1e-3)
    # Without corrections 400 points lead half of the way.
    assert len(problem.points) < 120


def test_what_no_point_keeps_is_broken_as_little_as_can_be():
    # No u has u_0 <= -0.5: at u_0 = 0 it is broken least, and that is paid for with all of the objective.
    found = solve_slp(Counted(lambda u: 1.0 - 0.01 * u[0] + u[1], lambda u: [u[0] + 0.5]), np.array([0.9, 0.1]), 30, 1e-6)
    np.testing.assert_allclose(found, [0.0, 0.0], rtol=0, atol=1e-3)


def test_a_limit_that_is_worth_more_than_its_price_is_kept_nevertheless():
    # One unit of the limit is worth a hundred times the objective, which is its price at first.
    found = solve_slp(Counted(lambda u: 1.0 - 100.0 * u[0], lambda u: [u[0] - 0.3]), np.array([0.1, 0.5]), 30, 1e-6)
    assert found[0] == pytest.approx(0.3, abs=1e-4)


def test_where_nothing_is_known_is_not_gone():
    problem = Counted(lambda u: 2.0 - u[0] - u[1], lambda u: [u[1] - 0.6], known=lambda u: u[0] <= 0.8)
    found = solve_slp(problem, np.array([0.2, 0.2]), 60, 1e-6)
    assert found[0] <= 0.8
    np.testing.assert_allclose(found, [0.8, 0.6], rtol=0, atol=0.01)
    start = np.array([0.9, 0.2])
    np.testing.assert_array_equal(solve_slp(problem, start, 60, 1e-6), start)


@pytest.mark.parametrize("most", [0.6, 0.8, 2.0])
def test_along_a_bent_valley_it_comes_nearly_as_far_as_slsqp(most):
    # A valley is no corner: linear programs know nothing of it, and still come near.
    def valley(u):
        return 1.0 + 10.0 * (u[1] - u[0] ** 2) ** 2 + (1.0 - u[0]) ** 2

    found = solve_slp(Counted(valley, lambda u: [u[0] - most]), np.array([0.1, 0.8]), 100, 1e-6)
    other = minimize(
        valley,
        [0.1, 0.8],
        method="SLSQP",
        bounds=[(0, 1)] * 2,
        constraints=[{"type": "ineq", "fun": lambda u: most - u[0]}],
    )
    assert found[0] <= most + 1e-6
    assert valley(found) == pytest.approx(other.fun, abs=0.03)


def test_with_a_gain_it_ends_where_less_is_promised():
    start = np.random.default_rng(0).uniform(0.1, 0.4, 11)
    whole, short = (Counted(lambda u: -1.0 - u.sum(), bent) for _ in range(2))
    most, enough = solve_slp(whole, start, 20, 1e-9), solve_slp(short, start, 20, 1e-2)
    assert len(short.points) < len(whole.points)
    assert enough.sum() >= most.sum() - 2e-2 * (1.0 + most.sum())


def test_every_point_is_within_the_cube():
    problem = Counted(lambda u: 1.0 - u.sum(), lambda u: [u[0] - 2.0])
    found = solve_slp(problem, np.array([0.95, 0.2, 1.0]), 30, 1e-6)
    np.testing.assert_allclose(found, 1.0, rtol=0, atol=1e-9)
    assert np.all(np.abs(np.array(problem.points) - 0.5) <= 0.5 + 1e-9)


def test_what_is_broken_by_no_more_than_counts_as_kept_is_no_reason_to_go_on():
    # Every straight step ends on the wrong side of this limit, and there is nothing but the limit to gain.
    def limits(u):
        return np.array([u[0] ** 2 - 0.01, -1.0])

    whole, short = (Counted(lambda u: 1.0, limits) for _ in range(2))
    start = np.array([0.9, 0.5])
    most, enough = solve_slp(whole, start, 60, 1e-6), solve_slp(short, start, 60, 1e-6, kept=0.2)
    assert limits(most)[0] <= 1e-5
    assert 0.01 < limits(enough)[0] <= 0.2
    assert len(short.points) < len(whole.points)


def test_a_linear_program_without_a_solution_is_warned_of_and_no_step():
    """From a point outside the cube no short step leads into it."""
    lines = Linearisation(np.array([1.5]), np.array([0.3, -0.1]), np.ones(1), np.ones((2, 1)), 0.0, np.array([1.5]))
    with pytest.warns(RuntimeWarning, match="a linear program of 2 rows failed"):
        step, left = lines.step(0.15, 1.0)
    np.testing.assert_array_equal(step, [0.0])
    assert left == 0.3


@pytest.mark.parametrize("seed", range(6))
def test_with_a_proximal_term_a_linear_problem_is_solved_as_by_another_solver(seed):
    """min g'u + w |u - centre|_1 s.t. A u <= b, in the variables u+, u- >= 0 with u = centre + u+ - u-."""
    draw = np.random.default_rng(seed)
    d, w = 5, 0.05
    slope, matrix = -draw.uniform(0.0, 0.3, d), draw.uniform(0.0, 1.0, (8, d))
    centre, most = draw.uniform(0.1, 0.4, d), draw.uniform(1.0, 1.5, 8)
    found = solve_slp(Counted(lambda u: -1.0 + slope @ (u - centre), lambda u: matrix @ u - most), centre, 60, 1e-9, 0.0, w)
    split = linprog(
        np.concatenate([slope + w, w - slope]),
        A_ub=np.hstack([matrix, -matrix]),
        b_ub=most - matrix @ centre,
        bounds=[*((0.0, 1.0 - c) for c in centre), *((0.0, c) for c in centre)],
    )
    assert np.max(matrix @ found - most) <= 1e-6
    assert slope @ (found - centre) + w * np.abs(found - centre).sum() == pytest.approx(split.fun, abs=1e-6)


def test_entries_without_influence_stay_at_the_centre_and_return_to_it():
    """max u_0 - 0.001 u_3 s.t. u_0 <= 0.7: entries 1 and 2 do nothing, entry 3 wins less than the proximal term costs."""
    problem = Counted(lambda u: -1.0 - u[0] - 1e-3 * u[3], lambda u: [u[0] - 0.7])
    centre = np.array([0.2, 0.3, 0.9, 0.5])
    found = solve_slp(problem, np.array([0.4, 0.8, 0.1, 0.2]), 60, 1e-6, 0.0, 0.01, centre)
    np.testing.assert_allclose(found, [0.7, 0.3, 0.9, 0.5], atol=1e-4)
    # Without the term nothing says where they belong.
    free = solve_slp(problem, np.array([0.4, 0.8, 0.1, 0.2]), 60, 1e-6)
    assert np.max(np.abs(free[1:3] - centre[1:3])) > 0.1


@pytest.mark.parametrize("w", [0.05, 0.5])
def test_a_proximal_term_shrinks_a_parabola_by_the_closed_form(w):
    """min 1/2 |u - a|^2 + w' |u - c|_1: u_i = c_i + sign(a_i - c_i) max(0, |a_i - c_i| - w')."""
    a, c = np.array([0.9, 0.45, 0.1]), np.array([0.4, 0.4, 0.5])
    start = np.array([0.5, 0.5, 0.5])
    value = lambda u: 1.0 + 0.5 * np.sum((u - a) ** 2)  # noqa: E731
    found = solve_slp(Counted(value, lambda u: [-1.0]), start, 200, 1e-9, 0.0, w, c)
    weight = w * value(start)
    np.testing.assert_allclose(found, c + np.sign(a - c) * np.maximum(0.0, np.abs(a - c) - weight), atol=5e-3)
