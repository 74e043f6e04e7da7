"""theta in each slot: changing it changes the loop, leaving it out leaves the loop as it is, bit for bit."""

import numpy as np
import pytest
from systems import SLOTS, controller, plant_model

from chargetune.episode.compiled import simulate
from chargetune.episode.stepwise import run_episode
from chargetune.plants.simulated import SimulatedPlant

STEPS = 20
COMPILED = pytest.mark.compiled_code(quick=True)


def loop(slot, t, compiled):
    return simulate(controller(slot), SimulatedPlant(plant_model(), {}), steps=STEPS, theta=[t], compiled=compiled).input


# What a slot does is decided before the loop is compiled: one compilation shows that nothing is lost there.
@pytest.mark.parametrize(("slot", "compiled"), [*((slot, False) for slot in SLOTS), pytest.param("l", True, marks=COMPILED)])
def test_theta_in_this_slot_changes_the_loop(slot, compiled):
    untuned, tuned = loop(slot, 1.0, compiled), loop(slot, 0.7, compiled)
    assert np.max(np.abs(tuned - untuned)) > 1e-3
    np.testing.assert_array_equal(loop(slot, 1.0, compiled), untuned)


@pytest.mark.parametrize("compiled", [pytest.param(True, marks=COMPILED), False])
def test_theta_left_out_leaves_the_loop_bit_identical(compiled):
    untuned = loop(None, 1.0, compiled)
    for t in (0.5, 0.7, 2.0):
        np.testing.assert_array_equal(loop(None, t, compiled), untuned)


@pytest.mark.parametrize("slot", SLOTS)
def test_the_neutral_theta_is_the_controller_without_theta(slot):
    if slot == "E":
        # Without theta in E the terminal limit is another number.
        assert np.max(np.abs(loop("E", 1.0, False) - loop(None, 1.0, False))) > 1e-3
    else:
        np.testing.assert_allclose(loop(slot, 1.0, False), loop(None, 1.0, False), atol=1e-6)


@pytest.mark.parametrize("slot", SLOTS)
def test_step_by_step_is_the_same_loop(slot):
    episode = run_episode(controller(slot), SimulatedPlant(plant_model(), {}), steps=STEPS, theta=[0.7])
    assert episode.failures == 0
    np.testing.assert_allclose(episode.input, loop(slot, 0.7, False), atol=1e-5)
