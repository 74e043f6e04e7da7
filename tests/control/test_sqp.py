"""The solver against IPOPT, against sabotage, and at the edges of what it is given."""

import casadi as ca
import numpy as np
import pytest
from systems import SPACE, controller, ipopt_solution, plant_model, random_point

from chargetune.control import sqp
from chargetune.control.control_step import act, begin, control_step, problem_of
from chargetune.control.controller import Controller, SoftLimit
from chargetune.control.estimators import ExactState, Propagated
from chargetune.control.ipopt_reference import ipopt_act
from chargetune.control.qp import daqp
from chargetune.control.sqp import KKT_TOLERANCE, SolveStatus, cold, solver
from chargetune.episode.compiled import simulate
from chargetune.episode.stepwise import run_episode
from chargetune.model.model import Model, Signal
from chargetune.model.parameter_space import ParameterSpace
from chargetune.plants.simulated import SimulatedPlant

pytestmark = pytest.mark.usefixtures("virtual_machine")


@pytest.mark.parametrize("slot", ["l", "E"])
@pytest.mark.parametrize("seed", range(4))
def test_solution_is_that_of_ipopt(slot, seed):
    own = controller(slot)
    problem = problem_of(own)
    now, inputs, q, *_ = random_point(problem, seed)
    solution, _, status, kkt, _ = solver(problem)(now, np.concatenate([inputs, cold(problem, np.zeros(1))[problem.size :]]), q)
    assert int(status) == SolveStatus.CONVERGED
    assert float(kkt) <= KKT_TOLERANCE
    reference, _ = ipopt_solution(own, now, inputs)

    def merit(u):
        cost, rows, _ = problem.sweep(now, u, q)
        return float(problem.merit(cost, rows))

    # What the tolerance leaves of a violation, 1e-4 of a scale of 0.1, costs 1e3 a unit in each of three limits.
    assert merit(np.array(solution).ravel()) <= merit(reference) + 3 * KKT_TOLERANCE * 0.1 * 1e3
    assert float(solution[0]) == pytest.approx(reference[0], abs=2e-3)


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
    def wrong(*shape):
        right = daqp(*shape)
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
    """x+ = x + atan(u): Gauss-Newton with full steps diverges from |u| > 1.4 on, a textbook case."""

    def equations(x, u, p):
        return {"x": x["x"] + ca.atan(u["u"])}, {"x": x["x"]}

    return Model.build(
        "steep",
        states=(Signal("x"),),
        inputs=(Signal("u"),),
        outputs=(Signal("x"),),
        parameters={},
        sampling_time_s=1.0,
        equations=equations,
    )


def steep_solution(iterations_max):
    own = Controller.build(
        steep(),
        ParameterSpace(()),
        horizon=1,
        stage_cost=lambda s: 1e-10 * s.u["u"] ** 2,
        terminal_cost=lambda s: (s.x["x"] - 0.2) ** 2,
        input_lower={"u": -100.0},
        input_upper={"u": 100.0},
        iterations_max=iterations_max,
    )
    problem = problem_of(own)
    q = problem.prepare(np.zeros(0), ca.DM(own.setpoint), own.model.nominal)
    inputs, _, status, kkt, count = solver(problem)(np.zeros(1), cold(problem, np.array([3.0])), q)
    return float(inputs), SolveStatus(int(status)), float(kkt), int(count)


def test_line_search_converges_where_full_steps_do_not(monkeypatch):
    best = np.tan(0.2)
    found, status, kkt, count = steep_solution(30)
    assert (status, count > 1, kkt <= KKT_TOLERANCE) == (SolveStatus.CONVERGED, True, True)
    assert found == pytest.approx(best, abs=0.02)
    monkeypatch.setattr(sqp, "HALVINGS_MAX", 0)
    found, status, *_ = steep_solution(30)
    assert status is SolveStatus.NOT_CONVERGED
    assert abs(found - best) > 10


def test_iteration_limit_is_told():
    found, status, kkt, count = steep_solution(1)
    assert (status, count) == (SolveStatus.NOT_CONVERGED, 1)
    assert kkt > KKT_TOLERANCE
    assert -100 <= found <= 100


@pytest.mark.parametrize("horizon", [1, 50, 200])
def test_horizons_from_1_to_200(horizon):
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


def test_a_measurement_that_comes_back_ends_the_fallback():
    own = controller("l", estimator=ExactState())
    step, problem, memory = control_step(problem_of(own)), problem_of(own), begin(own)
    q = problem.prepare(SPACE.default, ca.DM(own.setpoint), own.model.nominal)
    _, ahead, warm, status, *_ = step(memory.estimator, np.array([np.nan, 0.0]), memory.last_input, memory.warm, q)
    assert int(status) == SolveStatus.FALLBACK
    u, _, _, status, *_ = step(ahead, np.array([0.1, 0.0]), memory.last_input, warm, q)
    assert int(status) == SolveStatus.CONVERGED
    assert np.isfinite(float(u))


def test_propagated_states_stand_in_for_a_lost_measurement():
    own = controller("l", estimator=Propagated(("position",)), start={"position": 0.1, "speed": 0.05})
    problem, memory = problem_of(own), begin(own)
    step = control_step(problem)
    q = problem.prepare(SPACE.default, ca.DM(own.setpoint), own.model.nominal)
    blind = step(memory.estimator, np.array([np.nan]), memory.last_input, memory.warm, q)
    seeing = step(memory.estimator, np.array([0.1]), memory.last_input, memory.warm, q)
    assert int(blind[3]) == SolveStatus.CONVERGED
    for one, other in zip(blind, seeing, strict=True):
        np.testing.assert_array_equal(np.array(one), np.array(other))


@pytest.mark.parametrize(("bad", "count"), [(np.nan, 20), (0.0, 0)])
def test_fallbacks_are_counted_step_by_step_and_bounded(bad, count):
    own, memory, statuses = controller("l"), begin(controller("l")), []
    for _ in range(20):
        u, memory, info = act(own, np.array([bad, 0.0]), SPACE.default, memory)
        assert abs(float(u[0])) <= 0.9
        statuses.append(info.status)
    assert statuses.count(SolveStatus.FALLBACK) == count


def test_bounds_that_depend_on_a_lost_state_are_those_at_zero():
    own = controller("l", input_upper={"force": lambda s: 0.5 - s.now["speed"]}, input_lower={"force": -0.9}, fallback={"force": 5.0})
    u, _, info = act(own, np.array([0.0, np.nan]), SPACE.default, begin(own))
    assert (float(u[0]), info.status) == (0.5, SolveStatus.FALLBACK)


def test_the_warm_start_is_the_solution_a_stage_later():
    own = controller("l", horizon=3)
    problem = problem_of(own)
    width, stages = problem.row_width, range(3)
    bounds, slacks = [f"bound{i}" for i in stages], [f"slack{j}" for j in range(len(own.limits))]
    rows = [f"row{i}.{k}" for i in stages for k in range(width)]
    labels = [*slacks, *bounds, *rows, "terminal"]
    assert problem.size + len(labels) == cold(problem, np.zeros(1)).size
    later = [f"row{min(i + 1, 2)}.{k}" for i in stages for k in range(width)]
    assert [labels[i] for i in sqp._shift(problem)] == [*slacks, "bound1", "bound2", "bound2", *later, "terminal"]
    now, inputs, q, *_ = random_point(problem)
    solution, following, *_ = solver(problem)(now, np.concatenate([inputs, cold(problem, np.zeros(1))[problem.size :]]), q)
    planned = np.array(solution).ravel()
    np.testing.assert_array_equal(np.array(following).ravel()[:3], planned[[1, 2, 2]])


def test_the_warm_start_of_blocks_is_the_plan_an_interval_later():
    """What is held for 2 and 3 intervals: the mean over the intervals that a block then covers; their bounds stay as they are."""
    own = controller("l", horizon=6, blocks=(1, 2, 3))
    problem = problem_of(own)
    now, inputs, q, *_ = random_point(problem)
    solution, following, *_ = solver(problem)(now, np.concatenate([inputs, cold(problem, np.zeros(1))[problem.size :]]), q)
    planned = np.array(solution).ravel()
    ahead = np.append(np.repeat(planned, (1, 2, 3))[1:], planned[-1])
    wanted = [ahead[0], np.mean(ahead[1:3]), np.mean(ahead[3:])]
    np.testing.assert_allclose(np.array(following).ravel()[:3], wanted, rtol=1e-14)
    assert sqp._shift(problem)[3:6] == [4, 4, 5]
