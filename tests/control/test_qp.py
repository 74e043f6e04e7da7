"""The two QP paths against each other and against the optimality conditions."""

import casadi as ca
import numpy as np
import pytest

from chargetune.control.qp import daqp, daqp_warm

VARIABLES, ROWS = 7, 12


def random_qp(rng, kind):
    root = rng.normal(size=(VARIABLES, VARIABLES))
    h, g = root @ root.T + 0.1 * np.eye(VARIABLES), 5 * rng.normal(size=VARIABLES)
    a, b = rng.normal(size=(ROWS, VARIABLES)), rng.uniform(0.1, 1.0, ROWS)
    low, high = -rng.uniform(0.1, 1.0, VARIABLES), rng.uniform(0.1, 1.0, VARIABLES)
    if kind == "dependent rows":
        a[6:], b[6:] = a[:6], b[:6]
    if kind == "one-sided":
        high[3:] = np.inf
    if kind == "fixed variables":
        low[:2] = high[:2] = 0.0
    return h, g, a, b, low, high


@pytest.fixture(scope="module")
def solvers():
    return daqp(VARIABLES, ROWS), daqp_warm(VARIABLES, ROWS)


@pytest.mark.parametrize("kind", ["general", "dependent rows", "one-sided", "fixed variables"])
def test_both_solve_what_the_optimality_conditions_say(kind, solvers):
    rng = np.random.default_rng(0)
    for _ in range(60):
        h, g, a, b, low, high = data = random_qp(rng, kind)
        guesses = [np.zeros(VARIABLES + ROWS), rng.normal(size=VARIABLES + ROWS) * (rng.uniform(size=VARIABLES + ROWS) < 0.4)]
        for solve in solvers:
            for guess in guesses:
                x, dual = (np.array(o).ravel() for o in solve(*data, guess))
                np.testing.assert_allclose(h @ x + g + dual[:VARIABLES] + a.T @ dual[VARIABLES:], 0, atol=1e-7)
                assert np.all(a @ x <= b + 1e-7)
                assert np.all((x >= low - 1e-8) & (x <= high + 1e-8))
                assert np.all(dual[VARIABLES:] >= -1e-9)
                np.testing.assert_allclose(dual[VARIABLES:] * (b - a @ x), 0, atol=1e-6)


def test_a_right_guess_gives_the_same_solution(solvers):
    _, warm = solvers
    rng = np.random.default_rng(1)
    for _ in range(50):
        data = random_qp(rng, "general")
        x, dual = warm(*data, np.zeros(VARIABLES + ROWS))
        again, _ = warm(*data, dual)
        np.testing.assert_allclose(np.array(again), np.array(x), atol=1e-9)


def test_what_has_no_solution_gives_no_number(solvers):
    rng = np.random.default_rng(2)
    h, g, a, b, low, high = random_qp(rng, "general")
    a[1], b[1], b[0] = -a[0], -5.0, 1.0
    x, dual = solvers[1](h, g, a, b, low, high, np.zeros(VARIABLES + ROWS))
    assert np.all(np.isnan(np.array(x)))
    assert np.all(np.isnan(np.array(dual)))
    x, _ = solvers[1](-h, g, a, np.abs(b), low, high, np.zeros(VARIABLES + ROWS))
    assert np.all(np.isnan(np.array(x)))


@pytest.mark.parametrize("place", ["H", "g", "A", "uba", "lbx", "ubx"])
def test_input_that_is_no_number_gives_none_and_the_next_qp_is_solved(place, solvers):
    data = random_qp(np.random.default_rng(3), "general")
    guess = np.zeros(VARIABLES + ROWS)
    at = ["H", "g", "A", "uba", "lbx", "ubx"].index(place)
    broken = [value.copy() for value in data]
    broken[at].flat[2] = np.nan
    right = np.array(solvers[1](*data, guess)[0])
    x, dual = solvers[1](*broken, guess)
    assert np.all(np.isnan(np.array(x)))
    assert np.all(np.isnan(np.array(dual)))
    np.testing.assert_array_equal(np.array(solvers[1](*data, guess)[0]), right)
    # CasADi's interface need not tell, only return: the caller's own check refuses what it gives.
    assert solvers[0](*broken, guess)[0].shape == (VARIABLES, 1)


@pytest.mark.parametrize("guess", [np.nan, np.inf, -np.inf, 1.0, -1.0])
def test_a_nonsensical_guess_does_not_change_the_solution(guess, solvers):
    rng = np.random.default_rng(4)
    for kind in ("general", "dependent rows", "one-sided", "fixed variables"):
        data = random_qp(rng, kind)
        right = np.array(solvers[1](*data, np.zeros(VARIABLES + ROWS))[0])
        np.testing.assert_allclose(np.array(solvers[1](*data, np.full(VARIABLES + ROWS, guess))[0]), right, atol=1e-8)


def test_no_rows_at_all():
    x, dual = daqp_warm(3, 0)(np.eye(3), np.array([-2.0, 0.0, 2.0]), ca.DM(0, 3), ca.DM(0, 1), -np.ones(3), np.ones(3), np.zeros(3))
    np.testing.assert_allclose(np.array(x).ravel(), [1, 0, -1])
    np.testing.assert_allclose(np.array(dual).ravel(), [1, 0, -1])
