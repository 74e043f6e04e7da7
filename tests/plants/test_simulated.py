"""SimulatedPlant: its trajectory by hand, imperfect sensors, process noise, delay."""

import math

import numpy as np
import pytest

from chargetune.model.model import Model, Signal
from chargetune.plants.plant import PlantError
from chargetune.plants.sensors import Sensors
from chargetune.plants.simulated import SimulatedPlant, disturbances

LEAK, SPLASH = 0.9, 0.25


def test_trajectory_by_hand(make):
    plant = make()
    rest = plant.reset(0)
    assert rest.start.tolist() == rest.end.tolist() == [1.0, 1.0]
    level = 1.0
    for inflow in (0.5, -0.2, 0.0):
        m = plant.step(np.array([inflow]))
        after = LEAK * level + inflow
        np.testing.assert_allclose(m.start, [level, level + SPLASH * inflow], rtol=0, atol=1e-15)
        np.testing.assert_allclose(m.end, [after, after + SPLASH * inflow], rtol=0, atol=1e-15)
        np.testing.assert_array_equal(m.received, m.end)
        np.testing.assert_array_equal(m.true_end, m.end)
        np.testing.assert_allclose(m.state, [after], rtol=0, atol=1e-15)
        level = after


def test_reset_starts_again(make):
    plant = make(sensors=Sensors(noise_sd={"level": 0.1}), process_noise_sd={"level": 0.1})

    def run():
        plant.reset(7)
        return [plant.step(np.array([0.3])).end.tolist() for _ in range(5)]

    assert run() == run()


@pytest.mark.parametrize("delay", [0, 1, 3])
def test_delay(make, delay):
    plant = make(sensors=Sensors(delay_steps=delay))
    history = [plant.reset(0).end] * (delay + 1)
    assert np.array_equal(plant.reset(0).received, history[0])
    for k in range(8):
        m = plant.step(np.array([float(k)]))
        history.append(m.end)
        np.testing.assert_array_equal(m.received, history[-1 - delay])


def test_sensor_errors_are_what_was_drawn(make):
    sensors = Sensors(noise_sd={"level": 0.01, "gauge": 0.2}, bias={"gauge": -0.5}, resolution={"level": 0.05})
    plant = make(sensors=sensors)
    rest = plant.reset(3)
    errors, process = disturbances(plant, 600, 3)
    np.testing.assert_allclose(rest.end, [round((1.0 + errors[0, 1, 0]) / 0.05) * 0.05, 1.0 + errors[0, 1, 1]], rtol=0, atol=1e-12)
    assert not process.any()
    # More steps than are drawn at first: a longer episode begins with the numbers of a shorter one.
    for k in range(600):
        m = plant.step(np.array([0.0]))
        raw = m.true_start + errors[k + 1, 0]
        expected = [math.floor(raw[0] / 0.05 + 0.5) * 0.05, raw[1]]
        np.testing.assert_allclose(m.start, expected, rtol=0, atol=1e-12)


def test_noise_has_the_stated_moments_and_ends_are_independent(make):
    plant = make(sensors=Sensors(noise_sd={"level": 2.0, "gauge": 0.5}, bias={"gauge": 1.0}), process_noise_sd={"level": 0.3})
    errors, process = disturbances(plant, 20_000, 1)
    assert errors.mean(axis=(0, 1)) == pytest.approx([0.0, 1.0], abs=0.05)
    assert errors.std(axis=(0, 1)) == pytest.approx([2.0, 0.5], rel=0.02)
    assert process.std() == pytest.approx(0.3, rel=0.02)
    correlations = np.corrcoef([errors[1:, 0, 0], errors[1:, 1, 0], errors[1:, 0, 1], process[:, 0], errors[:-1, 1, 0]])
    assert np.max(np.abs(correlations - np.eye(5))) < 0.03


def test_process_noise_moves_the_state_and_not_the_reading(make):
    plant = make(process_noise_sd={"level": 0.1})
    plant.reset(5)
    _, process = disturbances(plant, 3, 5)
    level = 1.0
    for k in range(3):
        m = plant.step(np.array([0.0]))
        level = LEAK * level + process[k, 0]
        np.testing.assert_allclose(m.end, [level, level], rtol=0, atol=1e-15)
        np.testing.assert_allclose(m.state, [level], rtol=0, atol=1e-15)


def test_two_seeds_differ(make):
    plant = make(sensors=Sensors(noise_sd={"level": 1.0}))
    assert not np.array_equal(disturbances(plant, 4, 0)[0], disturbances(plant, 4, 1)[0])


def test_a_state_that_is_not_finite_is_a_plant_error():
    model = Model.build(
        "burst",
        states=(Signal("x"),),
        inputs=(Signal("u"),),
        outputs=(Signal("x"),),
        parameters={"growth": 1e200},
        sampling_time_s=1.0,
        equations=lambda x, u, p: ({"x": p["growth"] * x["x"] + u["u"]}, {"x": x["x"]}),
    )
    plant = SimulatedPlant(model, {"x": 1.0})
    plant.reset(0)
    plant.step(np.array([0.0]))
    with pytest.raises(PlantError, match=r"not finite after step 1: \[inf\]"):
        plant.step(np.array([0.0]))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"start": {"lvl": 1.0}}, r"start names unknown \['lvl'\], allowed are level"),
        ({"start": {"level": math.nan}}, "start of level = nan, allowed is a finite number"),
        ({"start": {"level": "1,0"}}, "start of level = '1,0', allowed is a finite number"),
        ({"start": {"level": True}}, "start of level = True, allowed is a finite number"),
        ({"process_noise_sd": {"gauge": 1.0}}, r"process_noise_sd names unknown \['gauge'\]"),
        ({"process_noise_sd": {"level": -1.0}}, "process_noise_sd of level = -1.0, allowed is a finite number >= 0"),
        ({"sensors": Sensors(bias={"pressure": 1.0})}, r"bias names unknown \['pressure'\], allowed are level, gauge"),
    ],
)
def test_refuses(tank, arguments, message):
    with pytest.raises(ValueError, match=message):
        SimulatedPlant(tank, **({"start": {}} | arguments))
