"""The soft limits: exact above the multipliers, visible below, and a state beyond its limit comes back."""

import casadi as ca
import numpy as np
import pytest
from systems import controller, model

from chargetune.control.control_step import problem_of
from chargetune.control.controller import SoftLimit
from chargetune.control.ocp import row_weight
from chargetune.control.sqp import SolveStatus, cold, solver
from chargetune.episode.compiled import simulate
from chargetune.plants.simulated import SimulatedPlant

SPEED_MAX = 0.25
# From where the speed limit is both reachable and in the way.
STARTS = [np.array([0.0, 0.2]), np.array([0.3, 0.25]), np.array([-0.5, 0.1])]


def soft(penalty):
    return controller("l", limits=[SoftLimit("speed", upper=SPEED_MAX, at="end", penalty=penalty, scale=0.1)])


def hard_solution(own, now):
    """(U, multipliers of the speed) of the same problem with the limit as a hard one, single shooting in the test's own words."""
    inputs = ca.MX.sym("U", own.horizon)
    x, cost, speeds = ca.MX(now), 0, []
    for i in range(own.horizon):
        cost += (x[0] - 1) ** 2 + 0.1 * inputs[i] ** 2
        x = own.model.f(x, inputs[i], own.model.nominal)
        speeds.append(x[1])
    cost += 5 * (x[0] - 1) ** 2
    options = {"ipopt": {"print_level": 0, "sb": "yes", "tol": 1e-11}, "print_time": False}
    solve = ca.nlpsol("hard", "ipopt", {"x": inputs, "f": cost, "g": ca.vertcat(*speeds)}, options)
    found = solve(x0=0, lbx=-0.9, ubx=0.9, lbg=-np.inf, ubg=SPEED_MAX)
    assert solve.stats()["success"]
    return np.array(found["x"]).ravel(), np.array(found["lam_g"]).ravel()


def threshold(own, multipliers):
    """The least exact penalty: the sum of the multipliers of the weighted rows."""
    return sum(m / row_weight(i, own.horizon) for i, m in enumerate(multipliers))


def soft_solution(own, now):
    problem = problem_of(own)
    q = problem.prepare(own.theta.default, ca.DM(own.setpoint), own.model.nominal)
    inputs, _, status, *_ = solver(problem)(now, cold(problem, np.zeros(1)), q)
    assert int(status) == SolveStatus.CONVERGED
    rows = np.array(problem.sweep(now, inputs, q)[1]).ravel()
    return np.array(inputs).ravel(), max(0.0, float(np.max(rows)) * 0.1)


@pytest.mark.parametrize("now", STARTS)
def test_a_limit_that_can_be_kept_is_kept_as_by_a_hard_one(now):
    reference, multipliers = hard_solution(soft(1e3), now)
    assert np.max(multipliers) > 1e-2, "the limit is to be active"
    assert threshold(soft(1e3), multipliers) < 1e3
    inputs, violation = soft_solution(soft(1e3), now)
    np.testing.assert_allclose(inputs, reference, atol=1e-3)
    assert violation < 1e-5


@pytest.mark.parametrize("now", STARTS)
def test_the_penalty_is_exact_from_the_sum_of_the_multipliers_on(now):
    own = soft(1e3)
    reference, multipliers = hard_solution(own, now)
    least = threshold(own, multipliers)
    above, violation = soft_solution(soft(1.05 * least), now)
    np.testing.assert_allclose(above, reference, atol=2e-3)
    assert violation < 1e-4
    _, violation = soft_solution(soft(0.5 * least), now)
    assert violation > 1e-3


def test_in_closed_loop_a_large_penalty_changes_nothing_and_a_tiny_one_shows():
    plant = SimulatedPlant(model(), {})
    exact, larger, weak = (simulate(soft(penalty), plant, steps=40, compiled=False) for penalty in (1e3, 1e5, 1e-2))
    assert np.max(exact.signal("speed")[1]) <= SPEED_MAX + 1e-5
    np.testing.assert_allclose(exact.input, larger.input, atol=2e-3)
    assert np.max(weak.signal("speed")[1]) > SPEED_MAX + 0.01
    assert exact.failures == larger.failures == weak.failures == 0


def test_an_impossible_limit_is_broken_as_little_as_possible():
    own = controller("l", limits=[SoftLimit("position", upper=-1.0, at="end", penalty=1e4, scale=0.1)])
    episode = simulate(own, SimulatedPlant(model(), {}), steps=60, compiled=False)
    assert episode.failures == 0
    assert np.all(episode.input >= -0.9)
    # The cost pulls to +1, the limit is -1: it goes there as far as the force can push.
    position = episode.signal("position")[1]
    assert np.all(np.diff(position) <= 1e-6)
    assert position[-1] < -0.9


def test_a_state_beyond_its_limit_comes_back_although_the_cost_pulls_outwards():
    """Only the growing weights of later violations do this: with equal ones the whole horizon may be as bad as its start."""
    own = controller("l", limits=[SoftLimit("position", upper=0.2, at="end", penalty=1e3, scale=0.1)])
    episode = simulate(own, SimulatedPlant(model(), {"position": 0.6}), steps=60, compiled=False)
    assert episode.failures == 0
    assert episode.signal("position")[1][-1] < 0.21
