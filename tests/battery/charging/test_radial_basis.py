"""A radial-basis stage cost: its value and derivatives, the closed loop beside IPOPT's, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest

from chargetune.battery.charging.controller import controller_of
from chargetune.battery.charging.evaluate import plant_of, run_charge
from chargetune.battery.charging.radial_basis import RadialBasis
from chargetune.battery.studies.study_file import Config, problem_of_document
from chargetune.control.ipopt_reference import ipopt_act
from chargetune.episode.stepwise import run_episode
from charging_problems import charging_problem

pytestmark = pytest.mark.usefixtures("virtual_machine")

RNG = np.random.default_rng(0)
WEIGHTS = RNG.uniform(-0.05, 0.05, 16)
# The weights of a cost that keeps the limit on mismatch seed 1: slopes at the highest voltage centres.
KEEPING = np.array([0, 0, 0.02, 0.04, 0, 0, 0.02, 0.04, 0, -0.01, 0.01, 0.02, 0, -0.01, -0.01, 0.01])
# Bumps and wells, as a tuner finds them.
BENT = np.array([29.1, -26.6, -10.3, 9.0, -7.9, -30.0, -13.6, 30.0, 20.5, -17.7, -16.0, 27.4, 30.0, 27.3, 5.4, 1.2]) / 1000


@pytest.fixture(scope="module")
def problem(cell):
    return charging_problem(cell, mismatch_seed=1, rbf=RadialBasis())


def stage_cost(problem, x, u, theta):
    controller = controller_of(problem)
    p = controller.parameters(theta, controller.model.nominal, np.zeros(0))
    value = controller.stage_cost(x, u, theta, p, controller.setpoint, controller.start, 0.0, np.zeros(0))
    return float(value)


def voltage_of(problem, x, u):
    controller = controller_of(problem)
    return float(np.array(controller.model.h(x, u, controller.model.nominal)).ravel()[controller.model.output_names.index("voltage_V")])


@pytest.mark.parametrize(("x", "u"), [((0.3, 0.05), 4.0), ((0.85, 0.02), 1.0), ((0.05, 0.0), 6.0)])
def test_cost_by_hand(problem, x, u):
    voltage, wanted = voltage_of(problem, x, u), (1 - x[0]) ** 2
    for j, z in enumerate((0, 1 / 3, 2 / 3, 1)):
        for k, v in enumerate((4.0, 4.1, 4.2, 4.3)):
            wanted += WEIGHTS[4 * j + k] * np.exp(-((x[0] - z) ** 2) / (2 / 9) - (voltage - v) ** 2 / (2 * 0.1**2))
    assert stage_cost(problem, x, u, WEIGHTS) == pytest.approx(wanted, rel=1e-12)
    assert stage_cost(problem, x, u, np.zeros(16)) == pytest.approx((1 - x[0]) ** 2, rel=1e-12)


def test_derivatives_of_the_stage_by_finite_differences(problem):
    """What the solver linearises: gradient and Hessian in (SOC, overpotential, current)."""
    import casadi as ca

    controller = controller_of(problem)
    f = controller.stage_cost
    x, u, *rest = f.sx_in()
    free = ca.vertcat(x, u)
    hessian, gradient = ca.hessian(f(x, u, *rest), free)
    both = ca.Function("both", [x, u, *rest], [gradient, hessian])
    at = np.array([0.6, 0.04, 3.0])
    p = controller.parameters(WEIGHTS, controller.model.nominal, np.zeros(0))
    fixed = (WEIGHTS, p, controller.setpoint, controller.start, 0.0, np.zeros(0))

    def slope(point):
        return np.array(both(point[:2], point[2:], *fixed)[0]).ravel()

    def value(point):
        return float(f(point[:2], point[2:], *fixed))

    steps = 1e-6 * np.eye(3)
    found, curved = (np.array(one) for one in both(at[:2], at[2:], *fixed))
    np.testing.assert_allclose(found.ravel(), [(value(at + h) - value(at - h)) / 2e-6 for h in steps], rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(curved, [(slope(at + h) - slope(at - h)) / 2e-6 for h in steps], rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("weights", [KEEPING, BENT])
def test_closed_loop_as_ipopt(problem, weights):
    """Twelve intervals from where the voltage comes near its limit."""
    near = replace(problem, episode=replace(problem.episode, soc_start=0.55, steps=12))
    controller = controller_of(near)
    mine, reference = (run_episode(controller, plant_of(near), steps=12, theta=weights, control=control) for control in (None, ipopt_act))
    assert mine.failures == 0
    assert np.ptp(reference.input) > 0.1
    np.testing.assert_allclose(mine.input, reference.input, rtol=0, atol=5e-3)


@pytest.mark.compiled_code
def test_compiled_as_step_by_step(problem):
    compiled = run_charge(problem, KEEPING)
    stepwise = run_episode(controller_of(problem), plant_of(problem), steps=problem.episode.steps, theta=KEEPING)
    np.testing.assert_allclose(compiled.input, stepwise.input, rtol=0, atol=1e-6)


def test_a_price_of_the_highest_voltages_keeps_off_the_limit(problem):
    worst = [np.max(run_charge(problem, w * np.tile([0, 0.5, 1, 1], 4)).signal("voltage_V")[1]) for w in (0.0, 0.01, 0.05)]
    assert worst[0] > 4.2 > worst[2]
    assert worst == sorted(worst, reverse=True)


@pytest.mark.parametrize(
    ("entries", "named"),
    [
        ({"soc_nodes": 1}, "soc_nodes = 1"),
        ({"voltage_nodes": 21}, "voltage_nodes = 21"),
        ({"voltage_V": (4.3, 4.0)}, "lowest < highest"),
        ({"voltage_V": (4.0, 4.1, 4.2)}, r"allowed is \[lowest, highest\]"),
        ({"voltage_V": (4.0, float("nan"))}, r"voltage_V\[1\]"),
        ({"upper": 0.0}, "upper = 0"),
        ({"lower": 0.1}, "lower = 0.1"),
    ],
)
def test_settings_are_refused_by_name(entries, named):
    with pytest.raises(ValueError, match=named):
        RadialBasis(**entries)


def test_stored_study_has_the_same_problem(problem):
    config = Config(controller=problem.controller, theta=problem.theta)
    assert problem_of_document(config.document()) == config.problem()
    assert "rbf" not in Config().document()["theta"]
