"""What a controller refuses to be built from."""

import casadi as ca
import numpy as np
import pytest
from systems import SPACE, controller, model

from chargetune.control.controller import Controller, SoftLimit
from chargetune.model.model import Model, Signal
from chargetune.model.parameter_space import ParameterSpace

GOOD = {"horizon": 5, "stage_cost": lambda s: s.x["position"] ** 2, "input_lower": {"force": -1.0}, "input_upper": {"force": 1.0}}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"horizon": 0}, ["horizon = 0", "[1, 200]"]),
        ({"horizon": 201}, ["horizon = 201", "[1, 200]"]),
        ({"blocks": (1, 2)}, ["blocks = (1, 2)", "add up to horizon = 5"]),
        ({"blocks": (5, 0)}, ["blocks = (5, 0)", ">= 1", "horizon = 5"]),
        ({"blocks": (2.0, 3)}, ["blocks = (2.0, 3)", "integers"]),
        ({"blocks": (True, 4)}, ["blocks = (True, 4)", "integers"]),
        ({"horizon": True}, ["horizon = True"]),
        ({"horizon": 5.0}, ["horizon = 5.0"]),
        ({"iterations_max": 0}, ["iterations_max = 0", ">= 1"]),
        ({"input_lower": {}}, ["input_lower", "force"]),
        ({"input_upper": {"farce": 1.0}}, ["input_upper", "farce", "force"]),
        ({"input_lower": {"force": 1.0}}, ["input_lower of force = 1.0", "input_upper = 1.0"]),
        ({"input_upper": {"force": np.nan}}, ["input_upper of force = nan"]),
        ({"fallback": {"farce": 0.0}}, ["fallback", "farce"]),
        ({"setpoint": {"place": 1.0}}, ["setpoint", "place", "position"]),
        ({"setpoint": {"position": np.inf}}, ["setpoint of position = inf"]),
        ({"start": {"place": 1.0}}, ["start", "place"]),
        ({"parameters": lambda _: {"mass": 1.0}}, ["parameters", "mass", "gain"]),
        ({"parameters": lambda s: {"gain": s.x.vector}}, ["gain", "shape"]),
        ({"stage_cost": lambda s: s.x.vector}, ["stage_cost", "scalar"]),
        ({"hessian": "newton"}, ["hessian = 'newton'", "gauss_newton, exact"]),
        ({"terminal_cost": lambda s: s.u["force"] ** 2}, ["terminal_cost", "input"]),
        ({"limits": [SoftLimit("weight", upper=1.0)]}, ["weight", "load"]),
        ({"limits": [SoftLimit("load", upper=1.0, at="terminal")]}, ["load", "terminal", "feedthrough"]),
    ],
)
def test_build_refuses(change, words):
    with pytest.raises(ValueError) as refused:  # noqa: PT011 - the words are what is tested
        Controller.build(model(), SPACE, **{**GOOD, **change})
    assert all(word in str(refused.value) for word in words), refused.value


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({}, ["neither lower nor upper"]),
        ({"upper": np.nan}, ["upper = nan"]),
        ({"upper": True}, ["upper = True"]),
        ({"lower": 2.0, "upper": 1.0}, ["lower = 2.0", "upper = 1.0"]),
        ({"upper": 1.0, "at": "middle"}, ["at = 'middle'", "start, end, both or terminal"]),
        ({"upper": 1.0, "penalty": -1.0}, ["penalty = -1.0", "> 0"]),
        ({"upper": 1.0, "penalty": 0.0}, ["penalty = 0.0"]),
        ({"upper": 1.0, "scale": np.inf}, ["scale = inf"]),
    ],
)
def test_limit_refuses(arguments, words):
    with pytest.raises(ValueError) as refused:  # noqa: PT011 - the words are what is tested
        SoftLimit("load", **arguments)
    assert all(word in str(refused.value) for word in words), refused.value


@pytest.mark.parametrize("theta", [[0.4], [2.1], [np.nan], [1.0, 1.0], []])
def test_theta_outside_its_space_is_refused(theta):
    with pytest.raises(ValueError, match="theta"):
        controller("l").theta_vector(theta)


def test_structure_ignores_run_time_numbers_and_sees_the_rest():
    same = controller("l", setpoint={"position": 0.3}, start={"speed": 0.1})
    assert same.structure == controller("l").structure
    others = {controller(slot).structure for slot in ("l", "Vf", "f", "h", "X", "Y", "U", "E")}
    assert len(others) == 8
    assert controller("l", horizon=7).structure != controller("l").structure


@pytest.mark.parametrize(
    ("change", "hessian"),
    [
        ({}, "gauss_newton"),
        ({"stage_cost": lambda s: -(s.x["position"] ** 2)}, "exact"),
        # Convex where the random points are, not at the start and at the set-point.
        ({"stage_cost": lambda s: -(ca.fmax(0, s.x["position"] - 5) ** 2), "start": {"position": 6.0}}, "exact"),
        ({"stage_cost": lambda s: -(ca.fmax(0, s.u["force"] - 5) ** 2), "setpoint": {"force": 6.0}}, "exact"),
        ({"terminal_cost": lambda s: -(s.x["speed"] ** 2)}, "exact"),
        # A cost without any curvature.
        ({"stage_cost": lambda s: s.u["force"] - s.x["speed"]}, "exact"),
        ({"hessian": "exact"}, "exact"),
        ({"stage_cost": lambda s: -(s.x["position"] ** 2), "hessian": "gauss_newton"}, "gauss_newton"),
    ],
)
def test_hessian_is_exact_where_the_costs_are_not_bent_upwards(change, hessian):
    assert Controller.build(model(), SPACE, **{**GOOD, **change}).hessian == hessian


def test_curvature_is_looked_for_in_what_the_input_reaches():
    """A clock, a price, and a state that no input moves are no choice of the controller's."""
    own = Model.build(
        "clocked",
        states=(Signal("x"), Signal("clock"), Signal("ahead")),
        inputs=(Signal("u"),),
        outputs=(),
        parameters={},
        sampling_time_s=1.0,
        equations=lambda x, u, p: ({"x": 0.9 * x["x"] + u["u"], "clock": x["clock"] + 1, "ahead": x["x"]}, {}),
    )

    def build(cost):
        bounds = {"input_lower": {"u": -1.0}, "input_upper": {"u": 1.0}, "given": (Signal("price"),)}
        return Controller.build(own, ParameterSpace(()), horizon=3, stage_cost=cost, **bounds)

    easy = build(lambda s: s.given["price"] * s.u["u"] + ca.sin(s.x["clock"]) * s.u["u"] + (s.x["x"] - s.x["clock"] ** 2) ** 2)
    assert easy.hessian == "gauss_newton"
    assert easy.curvatures["stage_cost"].of == ("u", "u before", "x", "ahead")
    bent = build(lambda s: -(s.x["ahead"] ** 2) + s.u["u"] ** 2)
    assert bent.hessian == "exact"
    assert bent.curvatures["stage_cost"].along == ("ahead",)
    assert bent.curvatures["stage_cost"].least == pytest.approx(-2.0)
