"""The systems of the literature: the closed loop is that of IPOPT on the same expressions, and every step is solved."""

import runpy
from pathlib import Path

import numpy as np
import pytest

from chargetune.control.ipopt_reference import ipopt_act
from chargetune.episode.compiled import simulate
from chargetune.episode.episode import Ending
from chargetune.episode.stepwise import run_episode

SYSTEMS = runpy.run_path(str(Path(__file__).parents[2] / "examples" / "mpc_systems.py"))
# What can be seen ahead and what is long is short here.
SHORT = {
    "linear_cost": {},
    "oscillating_masses": {"steps": 15},
    "stirred_tank": {"steps": 12},
    "four_tanks": {"steps": 25},
    "rotating_masses": {"steps": 8, "horizon": 10},
    "building": {"steps": 30, "horizon": 20},
    "fed_batch": {"steps": 12},
    "swing_up": {"steps": 25},
}


def test_no_system_is_forgotten():
    assert [make.__name__ for make in SYSTEMS["CASES"]] == list(SHORT)


@pytest.mark.parametrize("name", SHORT)
def test_closed_loop_is_that_of_ipopt(name):
    case = SYSTEMS[name](**SHORT[name])
    one, two = (
        run_episode(case.controller, case.plant, steps=case.steps, given=case.given, control=control) for control in (None, ipopt_act)
    )
    assert (one.ending, two.ending) == (Ending.DONE, Ending.DONE)
    assert one.failures == 0
    span = np.ptp(two.input, axis=0) + 1e-9
    assert np.max(np.abs(one.input - two.input) / span) <= case.tolerance
    # It is no loop in which nothing happens.
    assert np.all(np.ptp(two.input, axis=0) > 1e-3)


@pytest.mark.parametrize("name", ["linear_cost", "oscillating_masses", "four_tanks", "fed_batch"])
def test_whole_episode_is_that_of_step_by_step(name):
    case = SYSTEMS[name](**SHORT[name])
    run = {"steps": case.steps, "given": case.given}
    one, two = run_episode(case.controller, case.plant, **run), simulate(case.controller, case.plant, compiled=False, **run)
    np.testing.assert_allclose(one.input, two.input, rtol=0, atol=1e-6 * (1 + np.max(np.abs(one.input))))


@pytest.mark.parametrize(("name", "rated"), [("stirred_tank", (0, 20.0)), ("building", (0, 2.0))])
def test_rates_are_kept(name, rated):
    case = SYSTEMS[name](**SHORT[name])
    episode = run_episode(case.controller, case.plant, steps=case.steps, given=case.given)
    column, most = rated
    moves = np.diff(np.concatenate([[case.controller.input_before[column]], episode.input[:, column]]))
    assert np.max(np.abs(moves)) <= most + 1e-9
