"""The compiled control step is `act`, number for number, and falls back to it without a compiler."""

import numpy as np
import pytest
from systems import SPACE, controller, linear, plant_model

from chargetune.control.control_step import act, compiled_act
from chargetune.control.controller import SoftLimit
from chargetune.control.kalman import ExtendedKalman
from chargetune.episode.compiled import simulate
from chargetune.episode.stepwise import run_episode
from chargetune.plants.simulated import SimulatedPlant

KALMAN = ExtendedKalman(measured=("position",), measurement_sd=(0.01,), process_sd=(0.001, 0.01), start_sd=(0.1, 0.1))


@pytest.mark.compiled_code
@pytest.mark.parametrize("settings", [{}, {"estimator": KALMAN}, {"limits": [SoftLimit("speed", upper=0.25, at="end")]}])
def test_the_same_closed_loop(settings):
    own, plant = controller("l", **settings), SimulatedPlant(plant_model(), {})
    loops = [run_episode(own, plant, steps=30, theta=[1.3], control=control) for control in (act, compiled_act(own))]
    for name in ("input", "estimate", "status"):
        np.testing.assert_allclose(getattr(loops[0], name), getattr(loops[1], name), atol=1e-6)


@pytest.mark.compiled_code
def test_another_theta_is_another_controller():
    own, plant = controller("U"), SimulatedPlant(plant_model(), {})
    step = compiled_act(own)
    first, second, again = (run_episode(own, plant, steps=10, theta=[t], control=step).input for t in (0.5, 2.0, 0.5))
    assert np.max(np.abs(first - second)) > 1e-3
    np.testing.assert_array_equal(first, again)


@pytest.mark.compiled_code(quick=True)
@pytest.mark.parametrize("change", [{}, {"blocks": (1, 1, 2, 6)}])
def test_a_problem_written_as_loops_is_compiled_to_the_same_closed_loop(change):
    own, plant = linear(12, 4, 6, horizon=10, **change)
    loops = [simulate(own, plant, steps=10, compiled=compiled) for compiled in (True, False)]
    np.testing.assert_allclose(loops[0].input, loops[1].input, atol=1e-6)
    assert np.all(loops[0].status == 0)


def test_without_a_compiler_it_is_act(monkeypatch):
    monkeypatch.setenv("CHARGETUNE_CC", "none")
    assert compiled_act(controller("l")) is act


def test_a_compiler_that_fails_is_told_and_act_goes_on(monkeypatch, tmp_path):
    broken = tmp_path / "cc"
    broken.write_text("#!/bin/sh\nexit 1\n")
    broken.chmod(0o755)
    monkeypatch.setenv("CHARGETUNE_CC", str(broken))
    monkeypatch.setenv("CHARGETUNE_CACHE", str(tmp_path))
    with pytest.warns(RuntimeWarning, match="virtual machine"):
        step = compiled_act(controller("U", horizon=7))
    assert step is act
    assert SPACE.dimension == 1
