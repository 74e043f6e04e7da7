"""References, prices and forecasts that are told at run time: every way to run the loop sees the same ones."""

import casadi as ca
import numpy as np
import pytest

from chargetune.control.controller import Controller, SoftLimit
from chargetune.control.ipopt_reference import ipopt_act
from chargetune.control.kalman import ExtendedKalman
from chargetune.episode.compiled import compiled_episode, simulate
from chargetune.episode.stepwise import run_episode
from chargetune.model.model import Model, Signal
from chargetune.model.parameter_space import Parameter, ParameterSpace
from chargetune.plants.simulated import SimulatedPlant

STEPS, HORIZON = 12, 6
SPACE = ParameterSpace((Parameter("weight", 0.1, 10.0, 1.0),))
HOURS = np.arange(STEPS)
TOLD = {
    "price": 0.02 + 0.015 * np.sin(HOURS),
    "ambient": 5.0 + 3.0 * np.cos(0.5 * HOURS),
    "least": np.where(HOURS < 6, 18.0, 20.0),
}


@pytest.fixture(scope="module")
def room():
    """T+ = T + (ambient - T) / 20 + heat, measured with what the heater adds."""
    return Model.build(
        "room",
        states=(Signal("T", "degC"),),
        inputs=(Signal("heat", "K"),),
        outputs=(Signal("T", "degC"), Signal("near", "degC")),
        parameters={"ambient": 0.0, "gain": 1.0},
        sampling_time_s=3600.0,
        equations=lambda x, u, p: (
            {"T": x["T"] + (p["ambient"] - x["T"]) / 20 + p["gain"] * u["heat"]},
            {"T": x["T"], "near": x["T"] + 0.3 * u["heat"] + 0.01 * p["ambient"]},
        ),
    )


@pytest.fixture(scope="module")
def heating(room):
    """Cost of the heat, a lower limit that changes, an input bound that changes, and a filter that knows the ambient temperature."""

    def build(**changes):
        settings = {
            "horizon": HORIZON,
            "stage_cost": lambda s: s.theta["weight"] * s.given["price"] * s.u["heat"] + 0.05 * s.u["heat"] ** 2,
            "input_lower": {"heat": 0.0},
            "input_upper": {"heat": lambda s: 1.5 + 10 * s.given["price"]},
            "limits": [SoftLimit("T", lower=lambda s: s.given["least"], at="end", penalty=50.0, scale=0.1)],
            "parameters": lambda s: {"ambient": s.given["ambient"]},
            "start": {"T": 18.5},
            "given": (Signal("price", "EUR/kWh"), Signal("ambient", "degC"), Signal("least", "degC")),
            "estimator": ExtendedKalman(("near",), (0.1,), (0.1,), (0.1,)),
            **changes,
        }
        return Controller.build(room, SPACE, **settings)

    return build


@pytest.fixture(scope="module")
def plant(room):
    return SimulatedPlant(room, {"T": 18.5}, given=("ambient",))


def same(one, two, tolerance=1e-6):
    assert one.meta() == two.meta()
    for name in ("input", "output_start", "output_end", "estimate", "state", "status"):
        np.testing.assert_allclose(one.arrays()[name], two.arrays()[name], rtol=0, atol=tolerance, err_msg=name)


@pytest.mark.parametrize("compiled", [pytest.param(True, marks=pytest.mark.compiled_code(quick=True)), False])
def test_episode_is_that_of_step_by_step(heating, plant, compiled):
    whole = simulate(heating(), plant, steps=STEPS, given=TOLD, compiled=compiled)
    same(whole, run_episode(heating(), plant, steps=STEPS, given=TOLD))
    assert whole.failures == 0


@pytest.mark.parametrize("blocks", [(), (1, 2, 3)])
@pytest.mark.usefixtures("written_as")
def test_episode_is_that_of_ipopt(heating, plant, blocks):
    one = run_episode(heating(blocks=blocks), plant, steps=STEPS, given=TOLD)
    two = run_episode(heating(blocks=blocks), plant, steps=STEPS, given=TOLD, control=ipopt_act)
    np.testing.assert_allclose(one.input, two.input, rtol=0, atol=1e-4)
    # The limit is previewed, and so it is kept from the instant on at which it rises.
    assert np.all(one.state[1:STEPS, 0] >= TOLD["least"][1:] - 1e-3)
    assert one.state[5, 0] > 18.3


def test_plant_follows_the_signal_and_the_filter_knows_it(heating, plant, room):
    episode = simulate(heating(), plant, steps=STEPS, given=TOLD, compiled=False)
    x = 18.5
    for k in range(STEPS):
        p = np.array([TOLD["ambient"][k], 1.0])
        np.testing.assert_allclose(episode.true_start[k], np.array(room.h(x, episode.input[k], p)).ravel(), rtol=0, atol=1e-9)
        # Without noise and with the right signal of each interval the filter's estimate is the state itself.
        assert episode.estimate[k, 0] == pytest.approx(x, abs=1e-9)
        x = float(room.f(x, episode.input[k], p))
    assert episode.state[-1, 0] == pytest.approx(x, abs=1e-9)


def test_preview_reaches_as_far_as_the_horizon(heating, plant):
    changed = {**TOLD, "price": np.where(HOURS == 9, 1.0, TOLD["price"])}
    one, two = (simulate(heating(), plant, steps=STEPS, given=told, compiled=False) for told in (TOLD, changed))
    moved = np.flatnonzero(np.abs(one.input - two.input)[:, 0] > 1e-6)
    assert moved[0] >= 9 - HORIZON
    assert moved[0] < 9


def test_what_comes_after_the_episode_is_seen_where_it_is_told_and_is_constant_beyond(heating, plant):
    longer = {name: np.concatenate([values, np.repeat(values[-1:], 20)]) for name, values in TOLD.items()}
    one, two = (simulate(heating(), plant, steps=STEPS, given=told, compiled=False) for told in (TOLD, longer))
    same(one, two, 0.0)
    rising = {**longer, "least": np.concatenate([TOLD["least"], np.full(20, 23.0)])}
    assert simulate(heating(), plant, steps=STEPS, given=rising, compiled=False).input[-1] > one.input[-1] + 0.1


def test_forecast_that_is_the_truth_changes_nothing_and_another_one_does(heating, plant):
    right = np.array([[TOLD["ambient"][min(k + i, STEPS - 1)] for i in range(HORIZON + 1)] for k in range(STEPS)])
    one = simulate(heating(), plant, steps=STEPS, given=TOLD, compiled=False)
    same(one, simulate(heating(), plant, steps=STEPS, given={**TOLD, "ambient": right}, compiled=False), 0.0)
    wrong = right + np.where(np.arange(HORIZON + 1) > 0, 5.0, 0.0)
    two = simulate(heating(), plant, steps=STEPS, given={**TOLD, "ambient": wrong}, compiled=False)
    same(two, run_episode(heating(), plant, steps=STEPS, given={**TOLD, "ambient": wrong}))
    assert np.max(np.abs(one.input - two.input)) > 0.01


def test_new_forecast_is_no_new_function(heating, plant):
    run = compiled_episode(heating(), plant, STEPS, compiled=False)
    assert run.function is compiled_episode(heating(), plant, STEPS, compiled=False).function
    one, two = run.run(given=TOLD), run.run(given={**TOLD, "price": 0.5})
    assert np.max(np.abs(one.input - two.input)) > 0.01
    (alike,) = run.run_each([None], [plant], given=TOLD)
    same(one, alike, 0.0)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"prize": 1.0}, ["unknown ['prize']", "price, ambient, least"]),
        ({"price": None}, ["missing ['price']", "price, ambient, least"]),
        ({"price": np.ones(STEPS - 1)}, ["price has 11 intervals", "at least the 12"]),
        ({"ambient": np.ones((STEPS, HORIZON))}, ["ambient has shape (12, 6)", "(steps, 7)"]),
        ({"ambient": np.ones((STEPS, 7, 1))}, ["ambient has shape (12, 7, 1)"]),
        ({"ambient": np.where(HOURS == 3, np.nan, 1.0)}, ["ambient[3] = nan", "finite"]),
        ({"ambient": np.where(np.arange(7) == 2, np.inf, np.ones((STEPS, 7)))}, ["ambient[0, 2] = inf", "finite"]),
        ({"price": "cheap"}, ["price = 'cheap'", "numbers"]),
    ],
)
@pytest.mark.parametrize("way", [simulate, run_episode])
def test_signals_that_do_not_fit_are_refused_before_the_plant_is_touched(heating, plant, change, words, way):
    told = {name: value for name, value in {**TOLD, **change}.items() if value is not None}
    with pytest.raises(ValueError) as refused:  # noqa: PT011 - the words are what is tested
        way(heating(), plant, steps=STEPS, given=told)
    assert all(word in str(refused.value) for word in words), refused.value


def test_signals_of_a_controller_that_has_none_are_refused(tank_controller, tank_plant):
    with pytest.raises(ValueError, match=r"given: unknown \['price'\], allowed are \(none\)"):
        run_episode(tank_controller(), tank_plant(), steps=2, given={"price": 1.0})


def test_two_signals_of_one_name_and_an_unknown_parameter_of_the_plant_are_refused(heating, room):
    with pytest.raises(ValueError, match=r"given = \['price', 'price'\]"):
        heating(given=(Signal("price"), Signal("price")))
    with pytest.raises(ValueError, match=r"plant: given = \['weather'\], allowed are different ones of ambient, gain"):
        SimulatedPlant(room, {}, given=("weather",))
    with pytest.raises(ValueError, match=r"given = \['ambient', 'ambient'\]"):
        SimulatedPlant(room, {}, given=("ambient", "ambient"))


def test_reference_tracked_with_preview_beats_one_that_is_not_seen_ahead(room, plant):
    reference = np.where(HOURS < 6, 18.0, 21.0)
    own = Controller.build(
        room,
        SPACE,
        horizon=HORIZON,
        stage_cost=lambda s: (s.x["T"] - s.given["reference"]) ** 2 + 0.1 * s.theta["weight"] * s.u["heat"] ** 2,
        terminal_cost=lambda s: (s.x["T"] - s.given["reference"]) ** 2,
        parameters=lambda s: {"ambient": s.given["ambient"]},
        input_lower={"heat": 0.0},
        input_upper={"heat": 1.5},
        start={"T": 18.5},
        given=(Signal("reference"), Signal("ambient")),
    )
    told = {"ambient": TOLD["ambient"], "reference": reference}
    blind = {**told, "reference": np.repeat(reference[:, None], HORIZON + 1, axis=1)}
    seen, unseen = (run_episode(own, plant, steps=STEPS, given=given) for given in (told, blind))
    error = [float(np.sum((one.state[:-1, 0] - reference) ** 2)) for one in (seen, unseen)]
    assert error[0] < 0.9 * error[1]
    by_ipopt = run_episode(own, plant, steps=STEPS, given=told, control=ipopt_act)
    np.testing.assert_allclose(seen.input, by_ipopt.input, rtol=0, atol=1e-4)


def test_parameters_that_depend_on_a_signal_may_enter_nonlinearly(room, plant):
    own = Controller.build(
        room,
        SPACE,
        horizon=3,
        stage_cost=lambda s: (s.x["T"] - 20) ** 2,
        parameters=lambda s: {"gain": ca.exp(-s.given["dirt"]), "ambient": s.given["ambient"]},
        input_lower={"heat": 0.0},
        input_upper={"heat": 1.5},
        start={"T": 18.5},
        given=(Signal("dirt"), Signal("ambient")),
    )
    told = {"dirt": 0.1 * HOURS, "ambient": TOLD["ambient"]}
    one = simulate(own, plant, steps=STEPS, given=told, compiled=False)
    np.testing.assert_allclose(one.input, run_episode(own, plant, steps=STEPS, given=told, control=ipopt_act).input, rtol=0, atol=1e-4)
