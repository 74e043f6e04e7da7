"""Costs of any shape: flat ones, economic ones, ones that are bent downwards, and equality at the end of the horizon."""

import casadi as ca
import numpy as np
import pytest

from chargetune.control.control_step import act, begin
from chargetune.control.controller import Controller, SoftLimit
from chargetune.control.ipopt_reference import ipopt_act
from chargetune.episode.compiled import compiled_episode, simulate
from chargetune.episode.stepwise import run_episode
from chargetune.model.integrators import rk4
from chargetune.model.model import Model, Signal
from chargetune.model.parameter_space import Parameter, ParameterSpace
from chargetune.plants.simulated import SimulatedPlant

pytestmark = pytest.mark.usefixtures("virtual_machine")

NONE = ParameterSpace(())


def tank():
    """x+ = 0.9 x + u."""
    return Model.build(
        "tank",
        states=(Signal("x"),),
        inputs=(Signal("u"),),
        outputs=(Signal("x"),),
        parameters={},
        sampling_time_s=1.0,
        equations=lambda x, u, p: ({"x": 0.9 * x["x"] + u["u"]}, {"x": x["x"]}),
    )


TANK = SimulatedPlant(tank(), {"x": 0.0})


def of_tank(cost, **more):
    return Controller.build(tank(), NONE, horizon=6, stage_cost=cost, input_lower={"u": 0.0}, input_upper={"u": 1.0}, **more)


# What is compiled are the functions that the virtual machine runs: one curvature shows that they are solved there as well.
@pytest.mark.parametrize(
    ("curved", "compiled"),
    [(0.0, False), (1e-6, False), (1e-3, False), pytest.param(0.0, True, marks=pytest.mark.compiled_code(quick=True))],
)
def test_linear_cost_by_hand(curved, compiled):
    """Without a limit all that is allowed; with x <= 2 as much as keeps it: 1, 1, 2 - 1.71, then 2 - 1.8 for good."""
    free = of_tank(lambda s: -s.x["x"] + curved * s.u["u"] ** 2)
    limited = of_tank(lambda s: -s.x["x"] + curved * s.u["u"] ** 2, limits=[SoftLimit("x", upper=2.0, at="end")])
    for own, wanted in ((free, np.ones(8)), (limited, np.array([1.0, 1.0, 0.29, 0.2, 0.2, 0.2, 0.2, 0.2]))):
        episode = simulate(own, TANK, steps=8, compiled=compiled)
        assert episode.failures == 0
        np.testing.assert_allclose(episode.input[:, 0], wanted, rtol=0, atol=1e-6)


@pytest.mark.parametrize("sign", [1, -1])
def test_linear_cost_of_one_input_beside_a_quadratic_one_of_another(sign):
    own = Model.build(
        "two",
        states=(Signal("a"), Signal("b")),
        inputs=(Signal("left"), Signal("right")),
        outputs=(Signal("a"), Signal("b")),
        parameters={},
        sampling_time_s=1.0,
        equations=lambda x, u, p: (
            {"a": 0.8 * x["a"] + u["left"], "b": 0.7 * x["b"] + u["right"] + 0.1 * x["a"]},
            {"a": x["a"], "b": x["b"]},
        ),
    )
    bounds = {"input_lower": {"left": -1.0, "right": -1.0}, "input_upper": {"left": 1.0, "right": 1.0}}
    controller = Controller.build(
        own,
        NONE,
        horizon=5,
        stage_cost=lambda s: (s.x["a"] - 1) ** 2 + sign * 0.3 * s.u["right"],
        limits=[SoftLimit("b", lower=-1.5, upper=1.5, at="end", scale=0.1)],
        **bounds,
    )
    plant = SimulatedPlant(own, {"a": -1.0})
    one, two = (run_episode(controller, plant, steps=10, control=control) for control in (None, ipopt_act))
    assert one.failures == 0
    np.testing.assert_allclose(one.input[:, 1], two.input[:, 1], rtol=0, atol=1e-4)


def reactor():
    """A semi-batch of two reactions in series, a -> b -> waste, fed and cooled: b is worth something."""

    def equations(x, u, p):
        def rate(z):
            a, b, heat = z[0], z[1], z[2]
            first, second = 0.8 * ca.exp(0.3 * heat) * a, 0.3 * ca.exp(0.6 * heat) * b
            return ca.vertcat(u["feed"] - first, first - second, 0.5 * first - 0.4 * (heat - u["jacket"]))

        a, b, heat = ca.vertsplit(rk4(rate, x.vector, 0.5))
        return {"a": a, "b": b, "heat": heat}, {name: x[name] for name in ("a", "b", "heat")}

    states = (Signal("a"), Signal("b"), Signal("heat"))
    return Model.build(
        "reactor",
        states=states,
        inputs=(Signal("feed"), Signal("jacket")),
        outputs=states,
        parameters={},
        sampling_time_s=0.5,
        equations=equations,
    )


@pytest.mark.parametrize("blocks", [(), (1, 1, 2, 4)])
@pytest.mark.usefixtures("written_as")
def test_economic_cost_of_a_nonlinear_plant_is_solved_as_by_ipopt(blocks):
    """Its curvature is that of the dynamics alone: Gauss-Newton has none of it."""
    own = Controller.build(
        reactor(),
        NONE,
        horizon=8,
        blocks=blocks,
        stage_cost=lambda s: -s.x["b"] + 0.3 * s.u["feed"],
        terminal_cost=lambda s: -5 * s.x["b"],
        input_lower={"feed": 0.0, "jacket": -1.0},
        input_upper={"feed": 1.0, "jacket": 1.0},
        limits=[SoftLimit("heat", upper=0.6, at="end", penalty=100.0, scale=0.1)],
    )
    assert own.hessian == "exact"
    plant = SimulatedPlant(reactor(), {"a": 1.0})
    one, two = (run_episode(own, plant, steps=12, control=control) for control in (None, ipopt_act))
    assert one.failures == 0
    np.testing.assert_allclose(one.input, two.input, rtol=0, atol=2e-3)
    np.testing.assert_allclose(one.state, two.state, rtol=0, atol=5e-4)


def test_cost_that_is_bent_downwards_in_the_input():
    """-u^2 pushes u to a bound. Each solver finds a local solution or the way to one; what is not solved says so."""
    own = of_tank(lambda s: (s.x["x"] - 1.0) ** 2 - 0.3 * s.u["u"] ** 2)
    assert own.hessian == "exact"
    one, two = (run_episode(own, TANK, steps=8, control=control) for control in (None, ipopt_act))
    costs = [np.sum((e.state[:-1, 0] - 1.0) ** 2 - 0.3 * e.input[:, 0] ** 2) for e in (one, two)]
    assert costs[0] <= costs[1] + 0.05 * abs(costs[1])
    np.testing.assert_array_equal(one.status == 0, one.kkt <= 1e-4)


def test_cost_with_two_valleys_is_solved():
    """(x^2 - 1)^2 is bent downwards between -1 and 1: from 0.3 on it is 1, and so says IPOPT."""
    own = Controller.build(
        tank(),
        NONE,
        horizon=6,
        stage_cost=lambda s: (s.x["x"] ** 2 - 1) ** 2 + 0.1 * s.u["u"] ** 2,
        input_lower={"u": -0.3},
        input_upper={"u": 0.3},
    )
    assert own.hessian == "exact"
    plant = SimulatedPlant(tank(), {"x": 0.3})
    one, two = (run_episode(own, plant, steps=10, control=control) for control in (None, ipopt_act))
    assert one.failures == 0
    assert one.state[-1, 0] == pytest.approx(1.0, abs=0.05)
    np.testing.assert_allclose(one.input, two.input, rtol=0, atol=2e-4)


def cart():
    """Cart and pole; angle 0 is upright. The system and its costs are those of the example of leap-c (University of Freiburg, 2024)."""

    def equations(x, u, p):
        def rate(z):
            angle, v, w, push = z[1], z[2], z[3], u["push"]
            bob, mass, length, g = 0.1, 1.1, 0.8, 9.81
            den = mass - bob * ca.cos(angle) ** 2
            swing = bob * length * ca.sin(angle) * w**2
            forward = (-swing + bob * g * ca.cos(angle) * ca.sin(angle) + push) / den
            turn = (-swing * ca.cos(angle) + push * ca.cos(angle) + mass * g * ca.sin(angle)) / (length * den)
            return ca.vertcat(v, w, forward, turn)

        names = ("place", "angle", "v", "w")
        return dict(zip(names, ca.vertsplit(rk4(rate, x.vector, 0.04)), strict=True)), {name: x[name] for name in names}

    states = (Signal("place"), Signal("angle"), Signal("v"), Signal("w"))
    return Model.build(
        "cart", states=states, inputs=(Signal("push"),), outputs=states, parameters={}, sampling_time_s=0.04, equations=equations
    )


def worth(x):
    return 1e3 * x["place"] ** 2 + 1e3 * x["angle"] ** 2 + 0.005 * x["v"] ** 2 + 0.005 * x["w"] ** 2


def swing_up(**more):
    return Controller.build(
        cart(),
        NONE,
        horizon=50,
        stage_cost=lambda s: worth(s.x) + 0.1 * s.u["push"] ** 2,
        terminal_cost=lambda s: worth(s.x),
        input_lower={"push": -80.0},
        input_upper={"push": 80.0},
        limits=[SoftLimit("place", lower=-2.4, upper=2.4, at="end", penalty=1e4, scale=0.1)],
        start={"angle": np.pi},
        **more,
    )


def cost_of(episode):
    names = dict(zip(("place", "angle", "v", "w"), episode.state[:-1].T, strict=True))
    return float(np.sum(worth(names) + 0.1 * episode.input[:, 0] ** 2))


def test_swing_up_begins_at_the_plan_of_ipopt():
    plant = SimulatedPlant(cart(), {"angle": np.pi})
    own = swing_up(first_guess="ipopt")
    episode, by_ipopt = run_episode(own, plant, steps=40), run_episode(own, plant, steps=40, control=ipopt_act)
    assert episode.failures == 0
    assert cost_of(episode) == pytest.approx(cost_of(by_ipopt), rel=1e-5)
    np.testing.assert_allclose(episode.input, by_ipopt.input, rtol=0, atol=0.02)
    # From the cold start it ends in a local solution that costs more than twice as much.
    assert cost_of(run_episode(swing_up(), plant, steps=40)) > 2 * cost_of(episode)


def test_solver_ipopt_runs_step_by_step_and_nothing_else():
    own = of_tank(lambda s: (s.x["x"] - 1.0) ** 2, solver="ipopt")
    by_ipopt = run_episode(own, TANK, steps=5, control=ipopt_act)
    for episode in (run_episode(own, TANK, steps=5), simulate(own, TANK, steps=5)):
        np.testing.assert_array_equal(episode.input, by_ipopt.input)
        np.testing.assert_array_equal(episode.iterations, by_ipopt.iterations)
    with pytest.raises(ValueError, match="solver = 'ipopt', allowed is sqp"):
        compiled_episode(own, TANK, 5)


@pytest.mark.parametrize("label", ["solver", "first_guess"])
def test_unknown_choice_is_refused(label):
    with pytest.raises(ValueError, match=f"{label} = 'guess', allowed is"):
        of_tank(lambda s: s.x["x"] ** 2, **{label: "guess"})


def test_first_guess_knows_theta_and_the_given_signals():
    """Two valleys at -1 and 1, of which theta makes one the deeper: IPOPT's plan is for this theta and this signal."""
    space = ParameterSpace((Parameter("tilt", -1.0, 1.0, 0.5),))
    plant = SimulatedPlant(tank(), {"x": 0.0})
    own = Controller.build(
        tank(),
        space,
        horizon=4,
        stage_cost=lambda s: (s.x["x"] ** 2 - 1) ** 2 + (s.theta["tilt"] + s.given["push"]) * s.x["x"] + 0.01 * s.u["u"] ** 2,
        input_lower={"u": -1.0},
        input_upper={"u": 1.0},
        given=(Signal("push"),),
        first_guess="ipopt",
    )
    for theta, push in (([0.5], 0.0), ([-0.5], 0.0), ([0.0], -0.7)):
        whole = simulate(own, plant, steps=6, theta=theta, given={"push": push}, compiled=False)
        assert np.sign(whole.state[-1, 0]) == -np.sign(theta[0] + push)
        np.testing.assert_allclose(
            whole.input, run_episode(own, plant, steps=6, theta=theta, given={"push": push}).input, rtol=0, atol=1e-6
        )


@pytest.mark.parametrize("compiled", [pytest.param(True, marks=pytest.mark.compiled_code(quick=True)), False])
def test_equality_at_the_end_of_the_horizon(compiled):
    """The last predicted state is the wanted one from the first solve on, also where the cost asks for another one."""
    own = Controller.build(
        cart(),
        NONE,
        horizon=10,
        stage_cost=lambda s: worth(s.x) + s.u["push"] ** 2,
        input_lower={"push": -80.0},
        input_upper={"push": 80.0},
        limits=[SoftLimit(name, equals=value, at="terminal", penalty=1e6, scale=0.01) for name, value in (("place", 0.2), ("v", 0.0))],
    )
    plant = SimulatedPlant(cart(), {"angle": 0.1})
    one = simulate(own, plant, steps=6, compiled=compiled)
    assert one.failures == 0
    if not compiled:
        two = run_episode(own, plant, steps=6, control=ipopt_act)
        np.testing.assert_allclose(one.input, two.input, rtol=0, atol=0.02)
        # The plan of the last interval, rolled out.
        u, memory, _ = act(own, np.array([0.0, 0.1, 0.0, 0.0]), np.zeros(0), begin(own))
        x = np.array([0.0, 0.1, 0.0, 0.0])
        for value in [u[0], *memory.warm[:9]]:
            x = np.array(own.model.f(x, value, [])).ravel()
        np.testing.assert_allclose(x[[0, 2]], [0.2, 0.0], rtol=0, atol=1e-3)


def test_equality_at_the_end_of_the_horizon_with_inputs_that_are_held():
    """x+ = 0.9 x + u with u_0, then u_1 for two intervals, is led from 2 to 0.5 at the end of the third."""
    own = Controller.build(
        tank(),
        NONE,
        horizon=3,
        blocks=(1, 2),
        stage_cost=lambda s: s.u["u"] ** 2,
        input_lower={"u": -1.0},
        input_upper={"u": 1.0},
        limits=[SoftLimit("x", equals=0.5, at="terminal", penalty=1e4, scale=0.01)],
    )
    u, memory, info = act(own, np.array([2.0]), np.zeros(0), begin(own))
    assert info.status == 0
    # The least of u_0^2 + 2 u_1^2 subject to 0.9^3 2 + 0.81 u_0 + 1.9 u_1 = 0.5.
    price = (0.5 - 0.9**3 * 2) / (0.81**2 + 1.9**2 / 2)
    np.testing.assert_allclose(u, [0.81 * price], atol=1e-4)
    # What is planned an interval later: u_1 for good.
    np.testing.assert_allclose(memory.warm[:2], [1.9 / 2 * price] * 2, atol=1e-4)


def test_equality_beside_a_bound_is_refused():
    with pytest.raises(ValueError, match=r"equals = 1\.0 beside lower or upper"):
        SoftLimit("x", equals=1.0, upper=2.0)
    with pytest.raises(ValueError, match="equals = nan"):
        SoftLimit("x", equals=np.nan)
