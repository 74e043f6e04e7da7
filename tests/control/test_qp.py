"""The two QP paths against each other and against the optimality conditions."""

import subprocess
import sys

import casadi as ca
import numpy as np
import pytest

from chargetune.control.qp import daqp, daqp_warm

SLACKS, VARIABLES, ROWS = 2, 5, 12
N, DUALS = SLACKS + VARIABLES, SLACKS + ROWS
NOTHING = np.zeros(DUALS)
# All but DAQP's own interface is C that this project compiles.
pytestmark = pytest.mark.compiled_code


def random_qp(rng, kind):
    g, a = 3 * rng.normal(size=N), rng.normal(size=(ROWS, N))
    low, high = -rng.uniform(0.1, 1.0, ROWS), rng.uniform(0.1, 1.0, ROWS)
    # Rows of the controller stand only against the first variables with a slack.
    a[:, :SLACKS] = -np.abs(a[:, :SLACKS])
    if kind == "dependent rows":
        a[6:], low[6:], high[6:] = a[:6], low[:6], high[:6]
    if kind == "one-sided":
        low[:] = -np.inf
    if kind == "fixed variables":
        a[:2] = np.eye(N)[SLACKS : SLACKS + 2]
        low[:2] = high[:2] = 0.0
    return g, a.T, low, high


@pytest.fixture
def solvers():
    return daqp(SLACKS, VARIABLES, ROWS), daqp_warm(SLACKS, VARIABLES, ROWS)


def solved(solve, data, guess):
    return [np.array(o).ravel() for o in solve(*data, guess)]


@pytest.mark.parametrize("kind", ["general", "dependent rows", "one-sided", "fixed variables"])
def test_both_solve_what_the_optimality_conditions_say(kind, solvers):
    rng = np.random.default_rng(0)
    for _ in range(60):
        g, columns, low, high = data = random_qp(rng, kind)
        for solve in solvers:
            for guess in (NOTHING, rng.normal(size=DUALS) * (rng.uniform(size=DUALS) < 0.4)):
                values, dual = solved(solve, data, guess)
                # Stationarity gives x from the multipliers; everything else is checked at that x.
                x = -(g + columns @ dual[SLACKS:] + np.concatenate([dual[:SLACKS], np.zeros(VARIABLES)]))
                np.testing.assert_allclose(values, columns.T @ x, atol=1e-7)
                assert np.all((values >= low - 1e-7) & (values <= high + 1e-7))
                assert np.all(x[:SLACKS] >= -1e-7)
                assert np.all(dual[:SLACKS] <= 1e-9)
                np.testing.assert_allclose(dual[:SLACKS] * x[:SLACKS], 0, atol=1e-6)
                up, down = np.maximum(dual[SLACKS:], 0), np.minimum(dual[SLACKS:], 0)
                np.testing.assert_allclose(np.where(up > 1e-8, up * (high - values), 0), 0, atol=1e-6)
                np.testing.assert_allclose(np.where(down < -1e-8, down * (values - np.maximum(low, -1e6)), 0), 0, atol=1e-6)


def test_a_right_guess_gives_the_same_solution(solvers):
    rng = np.random.default_rng(1)
    for _ in range(50):
        data = random_qp(rng, "general")
        values, dual = solved(solvers[1], data, NOTHING)
        np.testing.assert_allclose(solved(solvers[1], data, dual)[0], values, atol=1e-9)


def test_what_has_no_solution_gives_no_number(solvers):
    g, columns, low, high = random_qp(np.random.default_rng(2), "one-sided")
    columns[:, 1], high[1], high[0] = -columns[:, 0], -5.0, 1.0
    for part in solved(solvers[1], (g, columns, low, high), NOTHING):
        assert np.all(np.isnan(part))
    high[1], low[1] = -5.0, -4.0
    assert np.all(np.isnan(solved(solvers[1], (g, columns, low, high), NOTHING)[0]))


@pytest.mark.parametrize("place", ["g", "A", "lba", "uba"])
@pytest.mark.parametrize("nonsense", [np.nan, np.inf])
def test_input_that_is_no_number_gives_none_and_the_next_qp_is_solved(place, nonsense, solvers):
    data = random_qp(np.random.default_rng(3), "general")
    broken = [value.copy() for value in data]
    broken[["g", "A", "lba", "uba"].index(place)].flat[2] = nonsense
    right = solved(solvers[1], data, NOTHING)[0]
    values, dual = solved(solvers[1], broken, NOTHING)
    if (place, nonsense) == ("uba", np.inf):
        # A row without an upper bound is a problem like any other.
        assert np.all(np.isfinite(values))
    else:
        assert np.all(np.isnan(values))
        assert np.all(np.isnan(dual))
    np.testing.assert_array_equal(solved(solvers[1], data, NOTHING)[0], right)
    # CasADi's interface need not tell, only return: the caller's own check refuses what it gives.
    assert solvers[0](*broken, NOTHING)[0].shape == (ROWS, 1)


@pytest.mark.parametrize("guess", [np.nan, np.inf, -np.inf, 1.0, -1.0])
def test_a_nonsensical_guess_does_not_change_the_solution(guess, solvers):
    rng = np.random.default_rng(4)
    for kind in ("general", "dependent rows", "one-sided", "fixed variables"):
        data = random_qp(rng, kind)
        right = solved(solvers[1], data, NOTHING)[0]
        np.testing.assert_allclose(solved(solvers[1], data, np.full(DUALS, guess))[0], right, atol=1e-8)


def test_rows_alone():
    values, dual = daqp_warm(0, 3, 3)(np.array([-2.0, 0.0, 2.0]), ca.DM.eye(3), -np.ones(3), np.ones(3), np.zeros(3))
    np.testing.assert_allclose(np.array(values).ravel(), [1, 0, -1])
    np.testing.assert_allclose(np.array(dual).ravel(), [1, 0, -1])


def test_slacks_alone():
    _, dual = daqp_warm(2, 1, 1)(np.array([1.0, -2.0, 0.0]), np.array([0.0, 1.0, 0.0]), [-10], [10], np.zeros(3))
    np.testing.assert_allclose(np.array(dual).ravel(), [-1, 0, 0], atol=1e-12)


# In a fresh process, because a thread whose stack is too small takes the whole process with it. No first guess.
LARGE = """
import threading
import subprocess
import sys

import casadi as ca
import numpy as np
from chargetune.control.qp import daqp, daqp_warm

# Two matrices of 1.5 MB each, on a stack of 0.25 MB.
slacks, variables, rows = 5, 250, 750
rng = np.random.default_rng(0)
a = np.hstack([-rng.uniform(0.1, 1.0, (rows, slacks)), rng.normal(size=(rows, variables))])
data = (rng.normal(size=slacks + variables), a.T, np.full(rows, -np.inf), rng.uniform(0.1, 1.0, rows), np.zeros(slacks + rows))
solve, other = daqp_warm(slacks, variables, rows), daqp(slacks, variables, rows)
found = []
threading.stack_size(1 << 18)
thread = threading.Thread(target=lambda: found.append(np.array(solve(*data)[0])))
thread.start()
thread.join()
np.testing.assert_allclose(found[0], np.array(other(*data)[0]), rtol=0, atol=1e-7)
print("solved")
"""


def test_a_large_problem_needs_no_large_stack():
    done = subprocess.run([sys.executable, "-c", LARGE], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout.strip()) == (0, "solved"), done.stderr


def test_more_entries_than_daqp_can_count_are_an_error_of_the_compiler():
    with pytest.raises(RuntimeError, match="the QP has too many variables or rows"):
        daqp_warm(0, 50_000, 50_000)
