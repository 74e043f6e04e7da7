"""The solver against finite differences, dense algebra and IPOPT, and against sabotage."""

import casadi as ca
import numpy as np
import pytest
from systems import SPACE, controller, model, plant_model, random_point

from chargetune.control.controller import Controller, SoftLimit
from chargetune.control.estimators import ExactState
from chargetune.control.ipopt import ipopt_act, multiple_shooting
from chargetune.control.mpc import begin, control_step, problem_of
from chargetune.control.qp import daqp
from chargetune.control.sqp import KKT_TOLERANCE, SolveStatus, cold, solver
from chargetune.episode.compiled import simulate
from chargetune.episode.stepwise import run_episode
from chargetune.model.model import Model, Signal
from chargetune.model.parameters import ParameterSpace
from chargetune.plants.simulated import SimulatedPlant


def differences(function, at, step=1e-6):
    columns = []
    for k in range(len(at)):
        ahead, behind = at.copy(), at.copy()
        ahead[k] += step
        behind[k] -= step
        columns.append((function(ahead) - function(behind)) / (2 * step))
    return np.array(columns).T


@pytest.mark.parametrize("slot", ["l", "X", "E"])
def test_condensed_gradient_and_jacobian_are_those_of_finite_differences(slot):
    problem = problem_of(controller(slot))
    now, inputs, q, lower, upper = random_point(problem)
    _, rows, derivatives = problem.sweep(now, inputs, q)
    hessian, gradient, jacobian, uba, lbx, ubx, span, gamma = (
        np.array(o) for o in problem.quadratic(inputs, rows, derivatives, lower, upper)
    )
    size = problem.size
    slope = differences(lambda u: float(problem.sweep(now, u, q)[0]), inputs)
    np.testing.assert_allclose(gradient[:size, 0], gamma[0, 0] * span[:, 0] * slope, rtol=1e-6, atol=1e-7)
    matrix = differences(lambda u: np.array(problem.sweep(now, u, q)[1]).ravel(), inputs)
    np.testing.assert_allclose(jacobian[:, :size], matrix * span[:, 0], rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(uba, -np.array(rows))
    np.testing.assert_allclose(lbx[:size, 0] * span[:, 0] + inputs, lower)
    np.testing.assert_allclose(ubx[:size, 0] * span[:, 0] + inputs, upper)
    assert np.mean(np.diag(hessian)[:size]) == pytest.approx(1.0, rel=1e-6)


def test_condensed_hessian_is_gauss_newton_by_dense_algebra():
    own = controller("l")
    problem = problem_of(own)
    now, inputs, q, lower, upper = random_point(problem)
    _, rows, derivatives = problem.sweep(now, inputs, q)
    hessian, *_, span, gamma = (np.array(o) for o in problem.quadratic(inputs, rows, derivatives, lower, upper))

    def trajectory(u):
        x, out = now, []
        for value in u:
            x = np.array(own.model.f(x, value, own.model.nominal)).ravel()
            out.append(x)
        return np.array(out).ravel()

    states = differences(trajectory, inputs).reshape(own.horizon, 2, problem.size)
    # l = (position - 1)^2 + 0.1 t force^2 at x_0 .. x_{N-1}, Vf = 5 (position - 1)^2 at x_N
    dense = 2 * 0.1 * np.eye(problem.size)
    for i in range(own.horizon - 1):
        dense += 2 * np.outer(states[i, 0], states[i, 0])
    dense += 10 * np.outer(states[-1, 0], states[-1, 0])
    scaled = gamma[0, 0] * span * dense * span.T
    np.testing.assert_allclose(hessian[: problem.size, : problem.size], scaled + 1e-8 * np.eye(problem.size), rtol=1e-5, atol=1e-6)


def ipopt_solution(own, now, inputs):
    nlp = multiple_shooting(own)
    size, nx, limits = inputs.size, len(own.model.states), len(own.limits)
    rest = own.horizon * nx
    found = nlp.solver(
        x0=np.concatenate([inputs, np.tile(now, own.horizon), np.zeros(limits)]),
        p=np.concatenate([now, own.theta.default, own.setpoint, own.model.nominal]),
        lbx=np.concatenate([np.full(size, -0.9), np.full(rest, -np.inf), np.zeros(limits)]),
        ubx=np.concatenate([np.full(size, 0.9), np.full(rest + limits, np.inf)]),
        lbg=np.concatenate([np.zeros(rest), np.full(nlp.inequalities, -np.inf)]),
        ubg=0.0,
    )
    assert nlp.solver.stats()["success"]
    return np.array(found["x"]).ravel()[:size]


@pytest.mark.parametrize("slot", ["l", "E"])
@pytest.mark.parametrize("seed", range(4))
def test_solution_is_that_of_ipopt(slot, seed):
    own = controller(slot)
    problem = problem_of(own)
    now, inputs, q, *_ = random_point(problem, seed)
    solution, _, status, kkt, _ = solver(problem)(now, np.concatenate([inputs, cold(problem, np.zeros(1))[problem.size :]]), q)
    assert int(status) == SolveStatus.CONVERGED
    assert float(kkt) <= KKT_TOLERANCE
    reference = ipopt_solution(own, now, inputs)

    def merit(u):
        cost, rows, _ = problem.sweep(now, u, q)
        return float(problem.merit(cost, rows))

    # What the tolerance leaves of a violation, 1e-4 of a scale of 0.1, costs 1e3 a unit in each of three limits.
    assert merit(np.array(solution).ravel()) <= merit(reference) + 3 * KKT_TOLERANCE * 0.1 * 1e3
    assert float(solution[0]) == pytest.approx(reference[0], abs=2e-3)


def test_residual_sees_a_point_that_is_not_optimal():
    problem = problem_of(controller("l"))
    now, _, q, lower, upper = random_point(problem, 1)
    solution, *_ = solver(problem)(now, cold(problem, np.zeros(1)), q)
    best = np.array(solution).ravel()
    step = solver(problem)
    assert float(step(now, cold(problem, np.zeros(1)), q)[3]) <= KKT_TOLERANCE
    moved = np.clip(best + 0.05, lower, upper)
    _, rows, derivatives = problem.sweep(now, moved, q)
    gamma = problem.quadratic(moved, rows, derivatives, lower, upper)[-1]
    assert float(problem.residual(moved, rows, derivatives, np.zeros(len(problem.groups)), gamma, lower, upper)) > 100 * KKT_TOLERANCE


SABOTAGE = {
    "wrong point": lambda x, lam: (0.5 * x, lam),
    "wrong multipliers": lambda x, lam: (x, lam + 3.0),
    "no multipliers": lambda x, lam: (x, 0 * lam),
    "beyond the bounds": lambda x, lam: (100 * x, lam),
    "not a number": lambda x, lam: (x * np.nan, lam * np.nan),
    "infinite": lambda x, lam: (x + np.inf, lam),
}


@pytest.mark.parametrize("kind", SABOTAGE)
def test_a_qp_solver_that_is_silently_wrong_is_caught(kind):
    def wrong(variables, rows):
        right = daqp(variables, rows)
        arguments = right.mx_in()
        return ca.Function("wrong", arguments, SABOTAGE[kind](*right(*arguments)))

    own = controller("X", iterations_max=3)
    problem = problem_of(own)
    now = np.array([0.0, 0.24])
    q = problem.prepare(own.theta.default, ca.DM(own.setpoint), own.model.nominal)
    honest = solver(problem)(now, cold(problem, np.zeros(1)), q)
    inputs, warm, status, *_ = solver(problem, wrong)(now, cold(problem, np.zeros(1)), q)
    assert int(honest[2]) == SolveStatus.CONVERGED
    assert int(status) != SolveStatus.CONVERGED
    inputs = np.array(inputs).ravel()
    assert np.all(np.isfinite(inputs))
    assert np.all(np.abs(inputs) <= 0.9)
    assert np.all(np.isfinite(np.array(warm)))
    if kind in {"not a number", "infinite"}:
        assert int(status) == SolveStatus.FALLBACK
        np.testing.assert_array_equal(inputs, 0.0)


def steep():
    """x+ = x + tanh(4 u): far from the solution the linearisation promises much more than there is."""

    def equations(x, u, p):
        return {"x": x["x"] + ca.tanh(4 * u["u"])}, {"x": x["x"]}

    return Model.build(
        "steep",
        states=(Signal("x"),),
        inputs=(Signal("u"),),
        outputs=(Signal("x"),),
        parameters={},
        sampling_time_s=1.0,
        equations=equations,
    )


def steep_controller(**changes):
    settings = {"horizon": 1, "stage_cost": lambda s: 1e-3 * s.u["u"] ** 2, "terminal_cost": lambda s: (s.x["x"] - 0.2) ** 2, **changes}
    return Controller.build(steep(), ParameterSpace(()), input_lower={"u": -3.0}, input_upper={"u": 3.0}, **settings)


def test_line_search_converges_where_full_steps_would_not():
    own = steep_controller(iterations_max=30)
    problem = problem_of(own)
    q = problem.prepare(np.zeros(0), ca.DM(own.setpoint), own.model.nominal)
    inputs, _, status, kkt, count = solver(problem)(np.zeros(1), cold(problem, np.array([0.45])), q)
    assert int(status) == SolveStatus.CONVERGED
    grid = np.linspace(-3, 3, 60_001)
    best = grid[np.argmin(1e-3 * grid**2 + (np.tanh(4 * grid) - 0.2) ** 2)]
    assert float(inputs) == pytest.approx(best, abs=1e-3)
    assert int(count) > 1
    assert float(kkt) <= KKT_TOLERANCE


def test_iteration_limit_is_told():
    own = steep_controller(iterations_max=1)
    problem = problem_of(own)
    q = problem.prepare(np.zeros(0), ca.DM(own.setpoint), own.model.nominal)
    inputs, _, status, kkt, count = solver(problem)(np.zeros(1), cold(problem, np.array([0.45])), q)
    assert (int(status), int(count)) == (SolveStatus.NOT_CONVERGED, 1)
    assert float(kkt) > KKT_TOLERANCE
    assert -3 <= float(inputs) <= 3


def soft(penalty):
    return controller(
        "l",
        limits=[SoftLimit("speed", upper=0.25, at="end", penalty=penalty, scale=0.1)],
        stage_cost=lambda s: (s.x["position"] - 1) ** 2 + 0.1 * s.u["force"] ** 2,
    )


def test_penalty_is_exact_above_the_multipliers_and_visible_below():
    plant = SimulatedPlant(model(), {})
    exact = simulate(soft(1e3), plant, steps=40)
    assert np.max(exact.signal("speed")[1]) <= 0.25 + 1e-5
    larger = simulate(soft(1e5), plant, steps=40)
    np.testing.assert_allclose(exact.input, larger.input, atol=2e-3)
    weak = simulate(soft(1e-2), plant, steps=40)
    assert np.max(weak.signal("speed")[1]) > 0.26
    assert exact.failures == larger.failures == weak.failures == 0


def test_an_impossible_limit_is_broken_as_little_as_possible():
    own = controller("l", limits=[SoftLimit("position", upper=-1.0, at="end", penalty=1e4, scale=0.1)])
    episode = simulate(own, SimulatedPlant(model(), {}), steps=60)
    assert episode.failures == 0
    assert np.all(episode.input >= -0.9)
    # The cost pulls to +1, the limit is -1: it goes there as far as the force can push.
    position = episode.signal("position")[1]
    assert np.all(np.diff(position) <= 1e-6)
    assert position[-1] < -0.9


def test_a_state_beyond_its_limit_comes_back_although_the_cost_pulls_outwards():
    """Only the growing weights of later violations do this: with equal ones the whole horizon may be as bad as its start."""
    own = controller("l", limits=[SoftLimit("position", upper=0.2, at="end", penalty=1e3, scale=0.1)])
    episode = simulate(own, SimulatedPlant(model(), {"position": 0.6}), steps=60)
    assert episode.failures == 0
    assert episode.signal("position")[1][-1] < 0.21


@pytest.mark.parametrize("horizon", [1, 50])
def test_horizons_from_1_to_50(horizon):
    episode = simulate(controller("l", horizon=horizon), SimulatedPlant(plant_model(), {}), steps=15, compiled=False)
    assert episode.failures == 0
    assert np.all(np.abs(episode.input) <= 0.9)


def two_inputs():
    def equations(x, u, p):
        return {"a": 0.9 * x["a"] + u["p"], "b": 0.8 * x["b"] + u["q"] + 0.1 * x["a"]}, {"a": x["a"], "b": x["b"]}

    signals = (Signal("a"), Signal("b"))
    return Model.build(
        "two", states=signals, inputs=(Signal("p"), Signal("q")), outputs=signals, parameters={}, sampling_time_s=1.0, equations=equations
    )


def test_two_inputs_reach_the_set_point_and_agree_with_ipopt():
    own = Controller.build(
        two_inputs(),
        ParameterSpace(()),
        horizon=8,
        stage_cost=lambda s: sum((s.x[n] - s.x_d[n]) ** 2 for n in "ab") + sum((s.u[n] - s.u_d[n]) ** 2 for n in "pq"),
        input_lower={"p": -0.3, "q": -0.2},
        input_upper={"p": 0.3, "q": 0.2},
        limits=[SoftLimit("b", upper=1.1, at="end")],
        setpoint={"a": 2.0, "b": 1.0, "p": 0.2, "q": 0.0},
    )
    quick = simulate(own, SimulatedPlant(two_inputs(), {}), steps=25)
    slow = run_episode(own, SimulatedPlant(two_inputs(), {}), steps=25, control=ipopt_act)
    np.testing.assert_allclose(quick.input, slow.input, atol=2e-4)
    assert quick.state[-1] == pytest.approx([2.0, 1.0], abs=0.02)
    assert quick.failures == 0


def test_bounds_follow_theta_and_state_and_cross_without_harm():
    own = controller("l", input_upper={"force": lambda s: 0.5 - s.now["speed"]}, input_lower={"force": -0.2})
    episode = simulate(own, SimulatedPlant(plant_model(), {}), steps=30)
    speed = np.concatenate([[0.0], episode.signal("speed")[1][:-1]])
    assert np.all(episode.input[:, 0] <= np.maximum(0.5 - speed, -0.2) + 1e-9)
    crossing = controller("l", input_upper={"force": lambda s: -0.5 - s.now["speed"]}, input_lower={"force": -0.2})
    episode = simulate(crossing, SimulatedPlant(plant_model(), {}), steps=5)
    assert np.all(np.isfinite(episode.input))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_measurement_that_is_no_number_gives_the_fallback(bad):
    own = controller("l", fallback={"force": -5.0})
    problem = problem_of(own)
    memory = begin(own)
    q = problem.prepare(SPACE.default, ca.DM(own.setpoint), own.model.nominal)
    u, _, warm, status, *_ = control_step(problem)(memory.estimator, np.array([bad, 0.0]), memory.last_input, memory.warm, q)
    assert int(status) == SolveStatus.FALLBACK
    # The declared input is bounded like any other.
    assert float(u) == -0.9
    assert np.all(np.isfinite(np.array(warm)))


def test_exact_state_goes_on_after_a_blind_step():
    own = controller("l", estimator=ExactState())
    step, problem, memory = control_step(problem_of(own)), problem_of(own), begin(own)
    q = problem.prepare(SPACE.default, ca.DM(own.setpoint), own.model.nominal)
    _, ahead, warm, status, *_ = step(memory.estimator, np.array([np.nan, 0.0]), memory.last_input, memory.warm, q)
    u, _, _, status, *_ = step(ahead, np.array([0.1, 0.0]), memory.last_input, warm, q)
    assert int(status) == SolveStatus.CONVERGED
    assert np.isfinite(float(u))
