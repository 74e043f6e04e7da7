"""An environment of Gymnasium as plant: the Pendulum, whose equations are known."""

import casadi as ca
import numpy as np
import pytest

from chargetune.control.controller import Controller
from chargetune.episode.episode import Ending
from chargetune.episode.stepwise import run_episode
from chargetune.model.model import Model, Signal
from chargetune.model.parameter_space import ParameterSpace
from chargetune.plants.gymnasium import GymnasiumPlant

gymnasium = pytest.importorskip("gymnasium", reason="Gymnasium is in the extra gym")
OUTPUTS = (Signal("angle", "rad"), Signal("speed", "rad/s"))
TORQUE = (Signal("torque", "N m"),)


def pendulum(name="Pendulum-v1", **more):
    """Observation (cos, sin, speed) as (angle, speed)."""
    return GymnasiumPlant(gymnasium.make(name, **more), TORQUE, OUTPUTS, 0.05, observe=lambda seen: [np.arctan2(seen[1], seen[0]), seen[2]])


def model():
    """The environment's own: speed+ = speed + (15 sin(angle) + 3 torque) 0.05, angle+ = angle + 0.05 speed+."""

    def equations(x, u, p):
        speed = x["speed"] + 0.05 * (15 * ca.sin(x["angle"]) + 3 * u["torque"])
        return {"angle": x["angle"] + 0.05 * speed, "speed": speed}, {name: x[name] for name in ("angle", "speed")}

    return Model.build("pendulum", states=OUTPUTS, inputs=TORQUE, outputs=OUTPUTS, parameters={}, sampling_time_s=0.05, equations=equations)


def controller():
    return Controller.build(
        model(),
        ParameterSpace(()),
        horizon=15,
        stage_cost=lambda s: s.x["angle"] ** 2 + 0.1 * s.x["speed"] ** 2 + 0.01 * s.u["torque"] ** 2,
        terminal_cost=lambda s: 20 * s.x["angle"] ** 2 + 5 * s.x["speed"] ** 2,
        input_lower={"torque": -2.0},
        input_upper={"torque": 2.0},
    )


def test_episode_is_what_the_equations_say_and_can_be_repeated():
    one, two = (run_episode(controller(), pendulum(), steps=30, seed=3) for _ in range(2))
    assert one.ending is Ending.DONE
    np.testing.assert_array_equal(one.output_end, two.output_end)
    x = one.output_start[0]
    for k in range(30):
        np.testing.assert_allclose(one.output_start[k], x, rtol=0, atol=1e-5)
        x = np.array(model().f(x, one.input[k], [])).ravel()
        x[0] = np.arctan2(np.sin(x[0]), np.cos(x[0]))
        # The environment computes in float32.
        np.testing.assert_allclose(one.output_end[k], x, rtol=0, atol=1e-4)
        x = one.output_end[k]


def test_end_of_the_environments_time_ends_the_episode():
    episode = run_episode(controller(), pendulum(max_episode_steps=8), steps=20)
    assert (episode.ending, len(episode)) == (Ending.PLANT, 8)
    assert "truncated" in episode.message


def test_what_is_no_plant_is_refused():
    with pytest.raises(ValueError, match=r"action space Discrete\(2\), allowed is a Box of 1 number: torque"):
        pendulum("CartPole-v1")
    bare = GymnasiumPlant(gymnasium.make("Pendulum-v1"), TORQUE, OUTPUTS, 0.05)
    episode = run_episode(controller(), bare, steps=2)
    assert episode.ending is Ending.PLANT
    assert "observed: 3 numbers, expected 2: angle, speed" in episode.message
    plant = pendulum()
    plant.reset(0)
    with pytest.raises(RuntimeError, match="outside the action space"):
        plant.step(np.array([5.0]))
