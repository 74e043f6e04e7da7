"""A plant whose current or voltage is counted the other way round is found in its first intervals."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from chargetune.battery.cell.cell import default_cell
from chargetune.battery.charging.controller import controller_of
from chargetune.battery.charging.evaluate import plant_of
from chargetune.checks.plant_response import check_response
from chargetune.episode.stepwise import run_episode
from chargetune.plants.faults import Fault, FaultKind, Faulty
from charging_problems import charging_problem


@dataclass
class Reversed:
    """A plant that takes a positive current as discharging."""

    plant: object

    def __getattr__(self, name):
        return getattr(self.plant, name)

    def step(self, u):
        return self.plant.step(-u)


def loop(wrap=lambda plant: plant, seed=0, steps=40, **changes):
    problem = charging_problem(default_cell(), mismatch_seed=1, soc_start=0.4, steps=steps, **changes)
    return controller_of(problem), run_episode(controller_of(problem), wrap(plant_of(problem)), steps=steps, seed=seed)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("noise", [0.0, 0.002, 0.01])
def test_a_wrong_model_with_noise_is_no_wrong_sign(seed, noise):
    assert check_response(*loop(seed=seed, voltage_noise_sd_V=noise, soc_noise_sd=noise / 100)) == []


def test_a_reversed_current_is_found_in_voltage_and_charge():
    found = check_response(*loop(Reversed, steps=4))
    assert {f.message.split(" of the plant")[0] for f in found} >= {"voltage_V", "soc"}
    assert all((f.code, f.severity) == ("wrong-sign", "error") and f.numbers["correlation"] < -0.9 for f in found)


def test_a_reversed_voltage_is_found_and_nothing_else():
    found = check_response(*loop(lambda plant: Faulty(plant, [Fault(FaultKind.REVERSED, 0, 99, ("voltage_V",))])))
    assert [f.message.split(" of the plant")[0] for f in found] == ["voltage_V"]


def test_missing_samples_are_left_out():
    controller, episode = loop()
    holes = episode.output_end.copy()
    holes[::3] = np.nan
    assert check_response(controller, replace(episode, output_end=holes)) == []
    assert check_response(controller, episode.cut(1, episode.ending, "")) == []
