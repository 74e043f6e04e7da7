"""What a controller refuses to be built from."""

import casadi as ca
import numpy as np
import pytest
from systems import SPACE, controller, model

from chargetune.control.controller import Controller, SoftLimit

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
        ({"stage_cost": lambda s: -(s.x["position"] ** 2)}, ["stage_cost", "convex"]),
        # Convex where the random points are, not at the start and at the set-point.
        ({"stage_cost": lambda s: -(ca.fmax(0, s.x["position"] - 5) ** 2), "start": {"position": 6.0}}, ["stage_cost", "convex"]),
        ({"stage_cost": lambda s: -(ca.fmax(0, s.u["force"] - 5) ** 2), "setpoint": {"force": 6.0}}, ["stage_cost", "convex"]),
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
