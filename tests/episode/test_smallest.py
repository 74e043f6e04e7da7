"""The smallest systems there are: one state, one input, one output or none, one interval, one row."""

from dataclasses import replace

import numpy as np
import pytest

from chargetune.control.controller import Controller, SoftLimit
from chargetune.control.estimators import ExactState, Propagated
from chargetune.control.ipopt_reference import ipopt_act
from chargetune.episode.compiled import simulate
from chargetune.episode.episode import Ending
from chargetune.episode.stepwise import run_episode
from chargetune.model.model import Model, Signal
from chargetune.model.parameter_space import Parameter, ParameterSpace
from chargetune.plants.sensors import Sensors
from chargetune.plants.simulated import SimulatedPlant

LEVEL = Signal("level", "m")


def tank(leak, outputs=(LEVEL,)):
    """level+ = level + 0.1 (inflow - leak level)."""
    return Model.build(
        "tank", states=(LEVEL,), inputs=(Signal("inflow", "m/s"),), outputs=outputs, parameters={"leak": leak}, sampling_time_s=0.1,
        equations=lambda x, u, p: (
            {"level": x["level"] + 0.1 * (u["inflow"] - p["leak"] * x["level"])},
            {signal.name: x["level"] for signal in outputs},
        ),
    )  # fmt: skip


def filling(**changes):
    """Fills the tank to a level of 1."""
    settings = {
        "horizon": 10,
        "stage_cost": lambda s: s.theta["weight"] * (s.x["level"] - s.x_d["level"]) ** 2 + 1e-3 * s.u["inflow"] ** 2,
        "input_lower": {"inflow": 0.0},
        "input_upper": {"inflow": 2.0},
        "fallback": {"inflow": 0.0},
        "limits": [SoftLimit("level", lower=0.0, upper=2.0, at="end", penalty=1e4, scale=0.1)],
        "setpoint": {"level": 1.0},
        "estimator": ExactState(),
    }
    space = ParameterSpace((Parameter("weight", 1e-2, 1e2, 1.0, scale="log"),))
    return Controller.build(tank(1.0), space, **(settings | changes))


@pytest.mark.parametrize("compiled", [pytest.param(True, marks=pytest.mark.compiled_code(quick=True)), False])
def test_one_output_without_delay(same, compiled):
    controller, plant = filling(), SimulatedPlant(tank(1.2), {})
    whole = simulate(controller, plant, steps=60, theta=[1.0], compiled=compiled)
    same(whole, run_episode(controller, plant, steps=60, theta=[1.0]))
    same(whole, run_episode(controller, plant, steps=60, theta=[1.0], control=ipopt_act))
    assert (whole.ending, whole.failures) == (Ending.DONE, 0)
    # The leak is larger than the controller knows, so the level stays a little below the set-point.
    assert 0.9 < whole.signal("level")[1][-1] < 1.0


@pytest.mark.parametrize("delay", [0, 1])
def test_no_output_at_all(same, delay):
    """The estimator reads nothing and runs the model open loop."""
    controller = filling(estimator=Propagated(()))
    plant = SimulatedPlant(tank(1.2, outputs=()), {}, sensors=Sensors(delay_steps=delay))
    whole = simulate(controller, plant, steps=20, compiled=False)
    same(whole, run_episode(controller, plant, steps=20))
    assert (whole.ending, whole.output_end.shape) == (Ending.DONE, (20, 0))


ENDS = {"a row": [SoftLimit("level", upper=0.5, at="end", penalty=1e4, scale=0.1)],
        "a terminal row": [SoftLimit("level", upper=0.5, at="terminal", penalty=1e4, scale=0.1)],
        "a row at the start": [SoftLimit("level", upper=0.5, at="start", penalty=1e4, scale=0.1)],
        "none": []}  # fmt: skip


@pytest.mark.parametrize("limits", ENDS)
def test_one_interval_ahead_with_one_row_or_none(same, limits):
    """l(x_0) is given, so the terminal cost is what the one input is for; the row is 0.5 below the set-point."""
    toward = 0.5 if ENDS[limits] else 1.0
    controller = filling(horizon=1, limits=ENDS[limits], terminal_cost=lambda s: (s.x["level"] - s.x_d["level"]) ** 2)
    plant = SimulatedPlant(tank(1.0), {})
    whole = simulate(controller, plant, steps=40, compiled=False)
    same(whole, run_episode(controller, plant, steps=40))
    assert (whole.ending, whole.failures) == (Ending.DONE, 0)
    # argmin over u of 1e-3 u^2 + (0.9 x + 0.1 u - 1)^2, cut to 0.9 x + 0.1 u <= 0.5 and to 0 <= u <= 2.
    level, inputs = 0.0, []
    for _ in range(40):
        free = 0.1 * (1.0 - 0.9 * level) / (1e-3 + 0.01)
        inputs.append(float(np.clip(min(free, 10 * (toward - 0.9 * level)) if ENDS[limits] else free, 0.0, 2.0)))
        level = 0.9 * level + 0.1 * inputs[-1]
    np.testing.assert_allclose(whole.input[:, 0], inputs, rtol=0, atol=1e-4)


def test_a_sample_that_comes_late_is_the_oldest_one(same):
    controller, plant = filling(), SimulatedPlant(tank(1.2), {}, sensors=Sensors(delay_steps=2))
    late = simulate(controller, plant, steps=30, compiled=False)
    same(late, run_episode(controller, plant, steps=30))
    # The tank is empty at rest: that is what the controller knows in its first three steps.
    np.testing.assert_array_equal(late.estimate[:3, 0], 0.0)
    np.testing.assert_allclose(late.estimate[3:, 0], late.signal("level")[1][:-3], rtol=0, atol=1e-12)
    prompt = simulate(controller, replace(plant, sensors=Sensors()), steps=30, compiled=False)
    assert np.max(np.abs(late.input - prompt.input)) > 1e-2
