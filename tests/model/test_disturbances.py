"""Disturbance models: their equations, what cannot be told apart, and an MPC without offset."""

import numpy as np
import pytest

from chargetune.control.controller import Controller
from chargetune.control.kalman import ExtendedKalman
from chargetune.episode.compiled import simulate
from chargetune.episode.stepwise import run_episode
from chargetune.model.detectability import undetectable
from chargetune.model.disturbances import Ramp, with_disturbances
from chargetune.model.model import Model, Signal
from chargetune.model.parameter_space import ParameterSpace
from chargetune.plants.simulated import SimulatedPlant

pytestmark = pytest.mark.usefixtures("virtual_machine")


def tanks(offset=0.0, inflow=0.0, factor=1.0):
    """Two tanks in a row; the plant's gauge, pump and valves are off by these."""

    def equations(x, u, p):
        drop = p["valve"] * p["factor"] * (x["upper"] - x["lower"])
        return (
            {
                "upper": x["upper"] + 0.5 * (u["pump"] + p["inflow"]) - drop,
                "lower": x["lower"] + drop - p["drain"] * p["factor"] * x["lower"],
            },
            {"gauge": x["lower"] + p["offset"], "upper": x["upper"]},
        )

    return Model.build(
        "tanks",
        states=(Signal("upper", "m"), Signal("lower", "m")),
        inputs=(Signal("pump", "m3/s"),),
        outputs=(Signal("gauge", "m"), Signal("upper", "m")),
        parameters={"valve": 0.3, "drain": 0.2, "factor": factor, "offset": offset, "inflow": inflow},
        sampling_time_s=2.0,
        equations=equations,
    )


def test_the_equations_are_those_of_the_model_with_what_is_added():
    own = tanks()
    made = with_disturbances(
        own,
        outputs=("gauge",),
        inputs=("pump",),
        parameters={"outlet": ("valve", "drain")},
        time_constants_s={"pump_offset": 10.0},
        settings={"gauge_sd": 0.1},
    )
    assert made.state_names == ("upper", "lower", "gauge_offset", "pump_offset", "outlet_log_factor")
    assert [s.unit for s in made.states[2:]] == ["m", "m3/s", "1"]
    x, u, p = np.array([0.9, 0.4, 0.05, 0.1, np.log(1.3)]), np.array([0.2]), made.nominal
    changed = own.with_parameters(valve=0.3 * 1.3, drain=0.2 * 1.3)
    after = np.array(changed.f(x[:2], u + 0.1, changed.nominal)).ravel()
    np.testing.assert_allclose(np.array(made.f(x, u, p)).ravel(), [*after, 0.05, 0.1 * np.exp(-0.2), np.log(1.3)], atol=1e-14)
    y = np.array(changed.h(x[:2], u + 0.1, changed.nominal)).ravel()
    np.testing.assert_allclose(np.array(made.h(x, u, p)).ravel(), [y[0] + 0.05, y[1]], atol=1e-14)
    assert dict(made.parameters)["gauge_sd"] == (0.1,)
    slower = made.with_parameters(pump_offset_time_constant_s=20.0)
    assert float(slower.f(x, u, slower.nominal)[3]) == pytest.approx(0.1 * np.exp(-0.1))


SETPOINT = {"upper": 1.0, "lower": 0.6, "pump": 0.24}


@pytest.mark.parametrize(
    ("given", "measured", "alike"),
    [
        ({"outputs": ("gauge",)}, ("gauge",), None),
        ({"inputs": ("pump",)}, ("gauge",), None),
        ({"outputs": ("gauge",), "inputs": ("pump",)}, ("gauge", "upper"), None),
        # More disturbances than measurements, each as good an explanation as the other.
        ({"outputs": ("gauge",), "inputs": ("pump",)}, ("gauge",), {"upper", "lower", "gauge_offset", "pump_offset"}),
        # Nobody reads the gauge that is off.
        ({"outputs": ("gauge",)}, ("upper",), {"gauge_offset"}),
        # In steady state the same level and a factor on all flows is one and the same as another pump.
        ({"inputs": ("pump",), "parameters": {"outlet": ("valve", "drain")}}, ("gauge", "upper"), {"pump_offset", "outlet_log_factor"}),
        # It leaks away by itself, so it need not be seen.
        ({"outputs": ("gauge",), "time_constants_s": {"gauge_offset": 5.0}}, ("upper",), None),
    ],
)
def test_what_cannot_be_told_apart_at_the_setpoint_is_refused_by_name(given, measured, alike):
    if alike is None:
        with_disturbances(tanks(), **given, measured=measured, setpoint=SETPOINT)
        return
    with pytest.raises(ValueError, match="cannot be told apart") as refused:
        with_disturbances(tanks(), **given, measured=measured, setpoint=SETPOINT)
    names = str(refused.value).split(": ", 1)[1].split(" cannot")[0]
    assert set(names.split(", ")) == alike


def test_the_rank_test_is_that_of_pannocchia_and_rawlings():
    """[A - I, B_d; C, C_d] of the plain model, against the null space that is found for the one with disturbances."""
    a, b = np.array([[0.7, 0.3], [0.3, 0.5]]), np.array([[0.5], [0.0]])
    offset, pump = {"outputs": ("gauge",)}, {"inputs": ("pump",)}
    for names in (("gauge",), ("gauge", "upper")):
        c = np.array([[0.0, 1.0], [1.0, 0.0]])[: len(names)]
        on_gauge, nothing = np.eye(len(names))[:, :1], np.zeros((len(names), 1))
        for b_d, c_d, given in (
            (np.zeros((2, 1)), on_gauge, offset),
            (b, nothing, pump),
            (np.hstack([np.zeros((2, 1)), b]), np.hstack([on_gauge, nothing]), {**offset, **pump}),
        ):
            matrix = np.block([[a - np.eye(2), b_d], [c, c_d]])
            detectable = np.linalg.matrix_rank(matrix) == matrix.shape[1]
            made = with_disturbances(tanks(), **given)
            at = np.zeros(len(made.states)), np.zeros(1)
            assert (undetectable(made, names, *at) == []) == detectable


def test_a_factor_that_rest_does_not_show_is_told_apart_in_motion():
    own = with_disturbances(tanks(), parameters={"outlet": ("valve", "drain")}, outputs=("gauge",))
    rest = np.zeros(len(own.states)), np.zeros(1)
    assert undetectable(own, ("gauge", "upper"), *rest) == [("outlet_log_factor",)]
    x, inputs, states = np.zeros(len(own.states)), np.array([[0.3], [0.3], [0.0], [0.0], [0.3], [0.3]]), []
    for u in inputs:
        states.append(x)
        x = np.array(own.f(x, u, own.nominal)).ravel()
    assert undetectable(own, ("gauge", "upper"), np.array(states), inputs) == []
    assert undetectable(own, ("gauge",), np.zeros((6, 4)), np.zeros((6, 1))) == [("outlet_log_factor",)]
    assert undetectable(own, ("gauge",), np.zeros((6, 4)), np.zeros((6, 1)), known=("outlet_log_factor",)) == []


def controller(own, estimator):
    """It brings the gauge to 0.5, whatever is off."""
    return Controller.build(
        own,
        ParameterSpace(()),
        horizon=15,
        stage_cost=lambda s: (s.y["gauge"] - 0.5) ** 2,
        terminal_cost=lambda s: (s.y["gauge"] - 0.5) ** 2,
        input_lower={"pump": 0.0},
        input_upper={"pump": 1.0},
        estimator=estimator,
    )


@pytest.mark.parametrize("off", [{"offset": 0.1}, {"inflow": 0.05}, {"factor": 1.3}, {"offset": -0.05, "factor": 0.8}])
@pytest.mark.parametrize("disturbance", [{"outputs": ("gauge",)}, {"inputs": ("pump",)}, {"parameters": ("drain",)}])
def test_an_integrating_disturbance_leaves_no_offset_in_steady_state(off, disturbance):
    plant = SimulatedPlant(tanks(**off), {})
    plain = ExtendedKalman(("gauge",), (0.01,), (1e-3, 1e-3), (0.1, 0.1))
    without = simulate(controller(tanks(), plain), plant, steps=120)
    own = with_disturbances(tanks(), **disturbance, measured=("gauge",), setpoint=SETPOINT)
    name = own.state_names[-1]
    estimator = ExtendedKalman.of(
        own, measurement_sd={"gauge": 0.01}, process_sd={"upper": 1e-3, "lower": 1e-3, name: 0.02}, start_sd={name: 0.1}
    )
    with_it = simulate(controller(own, estimator), plant, steps=120)
    assert abs(without.signal("gauge")[1][-1] - 0.5) > 0.01
    assert abs(with_it.signal("gauge")[1][-1] - 0.5) < 1e-4
    steps = run_episode(controller(own, estimator), plant, steps=20)
    np.testing.assert_allclose(steps.estimate, with_it.estimate[:20], atol=1e-6)
    np.testing.assert_allclose(steps.input, with_it.input[:20], atol=1e-5)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"outputs": ("meter",)}, ["outputs = ['meter']", "gauge, upper"]),
        ({"inputs": ("valve",)}, ["inputs = ['valve']", "pump"]),
        ({"parameters": ("pump",)}, ["parameters = ['pump']", "valve, drain"]),
        ({"parameters": {"outlet": ("valve", "tap")}}, ["parameters (outlet) = ['tap']", "valve, drain"]),
        ({"parameters": {"a": ("valve",), "b": ("valve",)}}, ["'valve', 'valve'", "one factor for each block"]),
        ({"outputs": ("gauge", "gauge")}, ["['gauge', 'gauge']", "different names"]),
        ({}, ["none is given", "at least one"]),
        ({"outputs": ("gauge",), "time_constants_s": {"gauge": 1.0}}, ["time_constants_s = ['gauge']", "gauge_offset"]),
        ({"outputs": ("gauge",), "time_constants_s": {"gauge_offset": 0.0}}, ["gauge_offset = 0.0", "> 0"]),
        ({"outputs": ("gauge",), "settings": {"valve": 1.0}}, ["['valve']", "new names"]),
        ({"outputs": ("gauge",), "setpoint": {"level": 1.0}}, ["['level']", "upper, lower"]),
        ({"outputs": ("gauge",), "setpoint": {}, "measured": ("level",)}, ["measured = ['level']", "gauge, upper"]),
    ],
)
def test_refusals(given, words):
    with pytest.raises(ValueError) as refused:  # noqa: PT011 - the words are what is tested
        with_disturbances(tanks(), **given)
    assert all(word in str(refused.value) for word in words)


def test_two_disturbances_of_one_name_are_refused():
    alike = Model.build(
        "alike",
        states=(Signal("x"),),
        inputs=(Signal("y"),),
        outputs=(Signal("y"),),
        parameters={},
        sampling_time_s=1.0,
        equations=lambda x, u, p: ({"x": x["x"] + u["y"]}, {"y": x["x"]}),
    )
    with pytest.raises(ValueError, match=r"y_offset.*different names"):
        with_disturbances(alike, outputs=("y",), inputs=("y",))


def test_shapes_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match=r"states \(3,\) and inputs \(1,\)"):
        undetectable(tanks(), ("gauge",), np.zeros(3), np.zeros(1))


def test_a_ramp_moves_its_disturbance_by_what_it_runs_along():
    along = with_disturbances(tanks(), outputs=("gauge",), ramps={"gauge_offset": Ramp(lambda u, p: p["valve"] * u["pump"], decay=0.5)})
    timed = with_disturbances(tanks(), outputs=("gauge",), ramps={"gauge_offset": Ramp()})
    x, u = np.array([0.9, 0.4, 0.05, 2.0]), np.array([0.2])
    after = np.array(along.f(x, u, along.nominal)).ravel()[2:]
    np.testing.assert_allclose(after, [0.05 + 0.3 * 0.2 * 2.0, 2.0 * np.exp(-0.06 / 0.5)], atol=1e-14)
    np.testing.assert_allclose(np.array(timed.f(x, u, timed.nominal)).ravel()[2:], [0.05 + 2.0 * 2.0, 2.0], atol=1e-14)
    assert dict(along.parameters)["gauge_offset_rate_decay"] == (0.5,)
    with pytest.raises(ValueError, match=r"decay = 0\.0, allowed is a finite number > 0"):
        Ramp(decay=0.0)
    with pytest.raises(ValueError, match=r"ramps = \['upper_offset'\], allowed are gauge_offset"):
        with_disturbances(tanks(), outputs=("gauge",), ramps={"upper_offset": Ramp()})
