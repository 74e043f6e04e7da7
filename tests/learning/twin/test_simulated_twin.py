"""The twin loop of any system, against episodes run step by step."""

import zlib
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from chargetune.control.controller import Controller, SoftLimit
from chargetune.episode.episode import Ending
from chargetune.episode.score_limits import ScoredLimit, Windows
from chargetune.episode.stepwise import run_episode
from chargetune.learning.twin.discrepancy import NoDiscrepancy
from chargetune.learning.twin.rollout import predict, slopes
from chargetune.learning.twin.simulated_twin import SimulatedTwin
from chargetune.learning.twin.twin import Uncertain
from chargetune.model.model import Model, Signal
from chargetune.model.parameter_space import Parameter, ParameterSpace
from chargetune.plants.sensors import Sensors
from chargetune.plants.simulated import SimulatedPlant

pytestmark = pytest.mark.usefixtures("virtual_machine")


def tank(outflow):
    """A level with inflow u and an outflow in proportion to its root; also what flows out is measured."""

    def equations(x, u, p):
        out = p["outflow"] * ca.sqrt(ca.fmax(x["level"], 1e-3))
        return {"level": x["level"] + u["inflow"] - out}, {"level": x["level"], "out": out}

    return Model.build(
        "tank", states=[Signal("level", "m")], inputs=[Signal("inflow")], outputs=[Signal("level", "m"), Signal("out")],
        parameters={"outflow": outflow}, sampling_time_s=1.0, equations=equations,
    )  # fmt: skip


SPACE = ParameterSpace((Parameter("margin", 0.0, 0.5, default=0.2),))
CONTROLLER = Controller.build(
    tank(0.1), SPACE, horizon=4, stage_cost=lambda s: (s.x["level"] - 2.0) ** 2 + 0.01 * s.u["inflow"] ** 2,
    input_lower={"inflow": 0.0}, input_upper={"inflow": 0.3}, start={"level": 1.0},
    limits=[SoftLimit("level", upper=lambda s: 1.8 - s.theta["margin"])],
)  # fmt: skip
LIMITS = (ScoredLimit("level", lower=0.0, upper=1.8, tolerance=0.02),)
NOISE = {"level": 1e-3, "out": 1e-4}
UNKNOWNS = [Uncertain("outflow", 0.2), Uncertain("level", 0.1, "start"), Uncertain("level", 0.05, "bias")]


def mean_level(episode):
    return float(np.mean(episode.signal("level")[1]))


def build(**changes):
    given = {"noise_sd": NOISE, "steps": 20, "limits": LIMITS, "objective": mean_level, "start": {"level": 1.0}} | changes
    return SimulatedTwin.build(CONTROLLER, tank(0.1), UNKNOWNS, **given)


def test_members_are_the_plants_of_their_unknowns_step_by_step():
    """Factor exp(0.1) of the outflow, start 0.2 m higher, 0.03 m read too much: the same with a plant made by hand."""
    loop, theta = build(), np.array([0.1])
    unknowns = [np.array([0.1, 0.2, 0.03]), np.zeros(3)]
    first, second = loop.simulate([(theta, m, None) for m in unknowns])
    for found, outflow, start, bias in ((first, 0.1 * np.exp(0.1), 1.2, 0.03), (second, 0.1, 1.0, 0.0)):
        plant = SimulatedPlant(tank(outflow), {"level": start}, Sensors(bias={"level": bias}))
        expected = run_episode(CONTROLLER, plant, steps=20, theta=theta)
        np.testing.assert_allclose(found.output_end, expected.output_end, atol=1e-7)
        np.testing.assert_allclose(found.input, expected.input, atol=1e-6)


def test_a_drawn_member_is_read_with_noise_and_judged_without():
    """Step by step with sensors of the same seed: the controller follows the noise, what comes back is what was true and the bias."""
    loop, m = build(), np.array([0.1, 0.2, 0.03])
    plant = SimulatedPlant(tank(0.1 * np.exp(0.1)), {"level": 1.2}, Sensors({"level": 1e-3}, {"level": 0.03}))
    for theta in (np.array([0.1]), np.array([0.3])):
        (found,), (quiet,) = (loop.simulate([(theta, m, drawn)]) for drawn in (NoDiscrepancy(), None))
        expected = run_episode(CONTROLLER, plant, steps=20, theta=theta, seed=zlib.crc32(m.tobytes()))
        np.testing.assert_allclose(found.input, expected.input, atol=1e-6)
        assert np.abs(found.input - quiet.input).max() > 1e-4
        np.testing.assert_allclose(found.signal("level")[1], expected.signal("level", true=True)[1] + 0.03, atol=1e-7)


def test_the_verdict_is_that_of_the_limits():
    loop = build(windows=Windows("level", 1.0, 1.8, 4))
    (episode,) = loop.simulate([(np.array([0.0]), np.array([0.0, 0.0, 0.1]), None)])
    level = np.concatenate(episode.signal("level"))
    score = loop.score(episode)
    assert score.objective == pytest.approx(mean_level(episode))
    assert score.excess["level"] == pytest.approx(max(level.max() - 1.8, -level.min()))
    assert len(score.profile["level"]) == 4
    excess, window = loop.samples(episode)["level"]
    assert excess.shape == window.shape == (20,)
    assert loop.score(replace(episode, ending=Ending.SOLVER)) is None


def test_violation_counts_tolerances_over_time():
    loop = build()
    (episode,) = loop.simulate([(np.array([0.0]), np.zeros(3), None)])
    assert loop.violation(episode) == 0.0
    high = replace(episode, output_start=episode.output_start + 9.0, output_end=episode.output_end + 9.0)
    level = np.maximum(*(high.signal("level")))
    assert loop.violation(high) == pytest.approx(np.sum(level - 1.8 - 0.02) / 0.02)


def test_what_is_not_given_follows_from_limits_and_input_bounds():
    loop = build()
    assert loop.features == {"level": (0.0, 1.8), "inflow": (0.0, 0.3)}
    # 1 % of the range of a level, three sd of noise of what has no range.
    assert loop.twin.discrepancy_sd_floor == pytest.approx({"level": 0.018, "out": 3e-4})
    assert build(noise_sd={"level": 0.1}).twin.discrepancy_sd_floor == {"level": 0.1}
    given = build(features={"inflow": (0.0, 1.0)}, discrepancy_sd_floor={"out": 0.5})
    assert given.features == {"inflow": (0.0, 1.0)}
    assert given.twin.discrepancy_sd_floor == pytest.approx({"level": 0.018, "out": 0.5})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"noise_sd": {"levle": 1e-3}}, "levle"),
        ({"noise_sd": {"level": 0.0}}, "allowed are finite numbers > 0"),
        ({"features": {}}, "allowed are 1 to 3"),
        ({"features": {"level": (1.0, 0.0)}}, "range of level"),
        ({"features": {"levle": (0.0, 1.0)}}, "levle"),
        ({"limits": [ScoredLimit("levle", upper=1.0)]}, "levle"),
        ({"steps": 0}, "steps = 0"),
    ],
)
def test_nonsense_is_refused_when_it_is_made(changes, message):
    with pytest.raises(ValueError, match=message):
        build(**changes)


RAIN = 0.02 + 0.02 * np.cos(0.4 * np.arange(30))
GOAL = np.where(np.arange(30) < 10, 1.5, 1.7)


def rained(outflow):
    """The tank with rain as well, a parameter that follows a given signal."""

    def equations(x, u, p):
        out = p["outflow"] * ca.sqrt(ca.fmax(x["level"], 1e-3))
        return {"level": x["level"] + u["inflow"] + p["rain"] - out}, {"level": x["level"], "out": out + 0.1 * p["rain"]}

    return Model.build(
        "tank", states=[Signal("level", "m")], inputs=[Signal("inflow")], outputs=[Signal("level", "m"), Signal("out")],
        parameters={"outflow": outflow, "rain": 0.0}, sampling_time_s=1.0, equations=equations,
    )  # fmt: skip


TOLD = Controller.build(
    rained(0.1), SPACE, horizon=4, stage_cost=lambda s: (s.x["level"] - s.given["goal"]) ** 2 + 0.01 * s.u["inflow"] ** 2,
    input_lower={"inflow": 0.0}, input_upper={"inflow": 0.3}, start={"level": 1.0}, given=(Signal("goal", "m"), Signal("rain", "m")),
    parameters=lambda s: {"rain": s.given["rain"]}, limits=[SoftLimit("level", upper=lambda s: 1.8 - s.theta["margin"])],
)  # fmt: skip
FORECAST = np.stack([np.concatenate([RAIN[k : k + 1], np.full(4, 0.02)]) for k in range(20)])


def under_rain(**changes):
    settings = {"given": {"goal": GOAL, "rain": FORECAST}, "plant_given": ("rain",)} | changes
    return SimulatedTwin.build(
        TOLD, rained(0.1), UNKNOWNS, noise_sd=NOISE, steps=20, limits=LIMITS, objective=mean_level, start={"level": 1.0}, **settings
    )


def test_given_signals_are_those_of_an_episode_step_by_step_and_of_the_roll_outs():
    """The controller is told forecasts of the rain that are wrong, the plant and its twin follow the rain as it comes."""
    loop, theta, m = under_rain(), np.array([0.1]), np.array([0.1, 0.2, 0.03])
    (found,) = loop.simulate([(theta, m, None)])
    plant = SimulatedPlant(rained(0.1 * np.exp(0.1)), {"level": 1.2}, Sensors(bias={"level": 0.03}), given=("rain",))
    expected = run_episode(TOLD, plant, steps=20, theta=theta, given={"goal": GOAL, "rain": FORECAST})
    np.testing.assert_allclose(found.output_end, expected.output_end, atol=1e-7)
    np.testing.assert_allclose(found.input, expected.input, atol=1e-6)
    for part in (found, found.cut(7, Ending.LIMIT, "")):
        predicted = predict(loop.twin, m, part.input)
        np.testing.assert_allclose(predicted[:, 0], part.output_start, atol=1e-7)
        np.testing.assert_allclose(predicted[:, 1], part.output_end, atol=1e-7)
    step = 1e-6 * np.eye(3)
    numeric = [(predict(loop.twin, m + one, found.input) - predict(loop.twin, m - one, found.input)) / 2e-6 for one in step]
    np.testing.assert_allclose(slopes(loop.twin, m, found.input), np.stack(numeric, axis=-1), atol=1e-6)
    assert loop.twin.content != under_rain(given={"goal": GOAL, "rain": 0.0}).twin.content


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"given": {"goal": GOAL}}, r"given: missing \['rain'\]"),
        ({"given": None}, "given: missing"),
        ({"given": {"goal": GOAL[:10], "rain": 0.0}}, "goal has 10 intervals, allowed are at least the 20"),
        ({"given": {"goal": GOAL, "rain": np.nan}}, "allowed are finite numbers"),
        ({"plant_given": ("outflow",), "given": {"goal": GOAL, "rain": 0.0, "outflow": 0.1}}, r"given = \['outflow'\], allowed .* rain"),
    ],
)
def test_given_signals_that_do_not_fit_are_refused(changes, words):
    with pytest.raises(ValueError, match=words):
        under_rain(**changes)


def test_a_twin_that_follows_something_else_than_the_controller_is_told_is_refused():
    loop = under_rain()
    with pytest.raises(ValueError, match="given of rain is not what the plant follows"):
        replace(loop, given={"goal": GOAL, "rain": 0.0})
