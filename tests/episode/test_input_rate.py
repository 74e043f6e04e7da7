"""The input of the interval before: costs on its change, and bounds of its rate."""

import numpy as np
import pytest

from chargetune.control.control_step import act, begin
from chargetune.control.controller import Controller
from chargetune.control.ipopt_reference import ipopt_act
from chargetune.episode.compiled import simulate
from chargetune.episode.stepwise import run_episode
from chargetune.model.model import Model, Signal
from chargetune.model.parameter_space import Parameter, ParameterSpace
from chargetune.plants.simulated import SimulatedPlant

STEPS = 12
SPACE = ParameterSpace((Parameter("rate", 0.05, 1.0, 0.2),))


def model():
    """Two masses pushed by two forces, both positions measured."""

    def equations(x, u, p):
        return (
            {"a": 0.9 * x["a"] + 0.1 * x["b"] + 0.4 * u["left"], "b": 0.85 * x["b"] + 0.3 * u["right"] + 0.1 * u["left"]},
            {"a": x["a"], "b": x["b"], "load": x["a"] + 0.2 * u["left"]},
        )

    return Model.build(
        "masses",
        states=(Signal("a"), Signal("b")),
        inputs=(Signal("left"), Signal("right")),
        outputs=(Signal("a"), Signal("b"), Signal("load")),
        parameters={},
        sampling_time_s=1.0,
        equations=equations,
    )


def own(**changes):
    settings = {
        "horizon": 5,
        "stage_cost": lambda s: (s.x["a"] - 1) ** 2 + (s.x["b"] + 0.5) ** 2 + 0.01 * s.u["left"] ** 2,
        "input_lower": {"left": -1.0, "right": -1.0},
        "input_upper": {"left": 1.0, "right": 1.0},
        **changes,
    }
    return Controller.build(model(), SPACE, **settings)


PLANT = SimulatedPlant(model(), {"a": 3.0})
CASES = {
    "cost": {"stage_cost": lambda s: (s.x["a"] - 1) ** 2 + s.x["b"] ** 2 + 0.5 * (s.u["right"] - s.u_last["right"]) ** 2},
    "bound": {"input_rate": {"left": 0.15}},
    "both": {
        "input_rate": {"left": lambda s: s.theta["rate"], "right": 0.1},
        "stage_cost": lambda s: (s.x["a"] - 1) ** 2 + s.x["b"] ** 2 + 0.5 * (s.u["right"] - s.u_last["right"]) ** 2,
        "input_before": {"left": -0.5},
    },
    "bounds that move": {
        "input_rate": {"left": 0.15},
        "input_upper": {"left": lambda s: s.given["most"], "right": 1.0},
        "input_lower": {"left": lambda s: s.given["most"] - 0.8, "right": -1.0},
        "fallback": {"left": 0.0, "right": 0.0},
        "given": (Signal("most"),),
    },
}
TOLD = {"bounds that move": {"most": np.where(np.arange(STEPS) < 6, -0.1, 0.9)}}


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("compiled", [pytest.param(True, marks=pytest.mark.compiled_code(quick=True)), False])
def test_whole_episode_is_that_of_step_by_step_and_of_ipopt(case, compiled):
    controller, given = own(**CASES[case]), TOLD.get(case)
    whole = simulate(controller, PLANT, steps=STEPS, given=given, compiled=compiled)
    assert whole.failures == 0
    np.testing.assert_allclose(whole.input, run_episode(controller, PLANT, steps=STEPS, given=given).input, rtol=0, atol=1e-6)
    if not compiled:
        by_ipopt = run_episode(controller, PLANT, steps=STEPS, given=given, control=ipopt_act)
        np.testing.assert_allclose(whole.input, by_ipopt.input, rtol=0, atol=2e-4)


@pytest.mark.usefixtures("written_as")
@pytest.mark.parametrize("case", CASES)
def test_inputs_that_are_held_are_those_of_ipopt(case):
    """As straight-line code and as loops."""
    controller, given = own(**CASES[case], blocks=(1, 1, 3)), TOLD.get(case)
    ours = run_episode(controller, PLANT, steps=STEPS, given=given)
    assert ours.failures == 0
    np.testing.assert_allclose(
        ours.input, run_episode(controller, PLANT, steps=STEPS, given=given, control=ipopt_act).input, rtol=0, atol=2e-4
    )
    free = run_episode(own(**CASES[case]), PLANT, steps=STEPS, given=given)
    assert np.max(np.abs(free.input - ours.input)) > 1e-3


def test_rate_is_kept_from_the_first_interval_on():
    controller = own(input_rate={"left": 0.15, "right": 0.1}, input_before={"left": 0.3})
    episode = simulate(controller, PLANT, steps=STEPS, compiled=False)
    change = np.abs(np.diff(np.vstack([[0.3, 0.0], episode.input]), axis=0))
    assert np.all(change <= np.array([0.15, 0.1]) + 1e-12)
    # It was in the way.
    assert np.max(change[:, 0]) == pytest.approx(0.15, abs=1e-9)


def test_rate_is_kept_where_the_measurement_is_no_number():
    controller = own(input_rate={"left": 0.15, "right": 0.1}, input_before={"left": 0.3, "right": 0.8})
    u, _, info = act(controller, np.array([np.nan, 0.0]), SPACE.default, begin(controller))
    assert np.all(np.abs(u - [0.3, 0.8]) <= [0.15 + 1e-12, 0.1 + 1e-12])
    assert info.status != 0


def test_bounds_win_where_they_leave_no_input_within_the_rate():
    controller = own(**CASES["bounds that move"])
    for control in (act, ipopt_act):
        left = run_episode(controller, PLANT, steps=STEPS, given=TOLD["bounds that move"], control=control).input[:, 0]
        most = TOLD["bounds that move"]["most"]
        assert np.all(left <= most + 1e-9)
        assert np.all(left >= most - 0.8 - 1e-9)
        # From -0.1 up to 0.1 is the least that the bounds ask for.
        assert np.max(np.abs(np.diff(left))) == pytest.approx(0.2, abs=1e-6)


def test_cost_on_the_change_is_that_of_a_state_made_by_hand():
    plain = own(**CASES["cost"])

    def equations(x, u, p):
        after, seen = {}, {"a": x["a"], "b": x["b"], "held": x["held"]}
        after["a"] = 0.9 * x["a"] + 0.1 * x["b"] + 0.4 * u["left"]
        after["b"] = 0.85 * x["b"] + 0.3 * u["right"] + 0.1 * u["left"]
        return {**after, "held": u["right"]}, seen

    states = (Signal("a"), Signal("b"), Signal("held"))
    by_hand = Model.build(
        "by hand", states=states, inputs=model().inputs, outputs=states, parameters={}, sampling_time_s=1.0, equations=equations
    )
    held = Controller.build(
        by_hand,
        SPACE,
        horizon=5,
        stage_cost=lambda s: (s.x["a"] - 1) ** 2 + s.x["b"] ** 2 + 0.5 * (s.u["right"] - s.x["held"]) ** 2,
        input_lower={"left": -1.0, "right": -1.0},
        input_upper={"left": 1.0, "right": 1.0},
    )
    one = run_episode(plain, PLANT, steps=STEPS)
    two = run_episode(held, SimulatedPlant(by_hand, {"a": 3.0}), steps=STEPS)
    np.testing.assert_allclose(one.input, two.input, rtol=0, atol=1e-9)
    # The estimate stays the model's own state.
    assert one.estimate.shape == (STEPS, 2)


def test_input_before_is_read_at_the_first_interval():
    cost = {"stage_cost": lambda s: (s.x["a"] - 1) ** 2 + 100 * (s.u["left"] - s.u_last["left"]) ** 2 + (s.u["right"]) ** 2}
    for before in (-0.5, 0.5):
        u = run_episode(own(**cost, input_before={"left": before}), PLANT, steps=1).input[0, 0]
        assert u == pytest.approx(before, abs=0.1)


def test_plant_is_measured_under_the_input_before():
    plant = SimulatedPlant(model(), {"a": 3.0}, input_before={"left": 0.5})
    assert plant.reset(0).end[2] == pytest.approx(3.1)
    with pytest.raises(ValueError, match="input_before names unknown"):
        SimulatedPlant(model(), {}, input_before={"a": 0.5})


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"input_rate": {"up": 1.0}}, ["input_rate", "up", "left, right"]),
        ({"input_rate": {"left": 0.0}}, ["input_rate of left = 0.0", "> 0"]),
        ({"input_rate": {"left": np.nan}}, ["input_rate of left = nan"]),
        ({"input_before": {"up": 1.0}}, ["input_before", "up"]),
        ({"input_before": {"left": np.inf}}, ["input_before of left = inf"]),
        ({"input_upper": {"left": lambda s: s.u_last["left"], "right": 1.0}}, ["input_upper", "not known there"]),
    ],
)
def test_refused(change, words):
    with pytest.raises(ValueError) as refused:  # noqa: PT011 - the words are what is tested
        own(**change)
    assert all(word in str(refused.value) for word in words), refused.value


def test_rates_and_signals_with_inputs_that_are_held():
    """Blocks of one, one and three intervals: the rate holds from block to block, the bound is that of a block's first interval."""
    controller = own(
        blocks=(1, 1, 3),
        input_rate={"left": 0.15},
        input_upper={"left": lambda s: s.given["most"], "right": 1.0},
        given=(Signal("most"),),
    )
    given = {"most": np.where(np.arange(STEPS) < 6, 0.2, 0.9)}
    whole = simulate(controller, PLANT, steps=STEPS, given=given, compiled=False)
    assert whole.failures == 0
    np.testing.assert_allclose(whole.input, run_episode(controller, PLANT, steps=STEPS, given=given).input, rtol=0, atol=1e-6)
    by_ipopt = run_episode(controller, PLANT, steps=STEPS, given=given, control=ipopt_act)
    np.testing.assert_allclose(whole.input, by_ipopt.input, rtol=0, atol=2e-4)
    assert np.max(np.abs(np.diff(whole.input[:, 0]))) <= 0.15 + 1e-9
