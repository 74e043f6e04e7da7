"""What is compiled is shared by controllers of the same content, and by no others."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from systems import controller, plant_model

from chargetune.control.control_step import problem_of
from chargetune.control.kalman import ExtendedKalman
from chargetune.episode.compiled import compiled_episode, simulate
from chargetune.episode.lookup_table import LookupTable
from chargetune.episode.stepwise import run_episode
from chargetune.model.model import Signal
from chargetune.plants.simulated import SimulatedPlant


class Shifted:
    """All states are measured, and the first one is off by a number that no text tells."""

    def __init__(self, off):
        self.off = off

    def __repr__(self):
        return "Shifted()"

    def signals(self, model):
        return model.state_names

    def initial(self, model, state):
        return np.zeros(0)

    def correct(self, model, memory, y, u, p):
        first, *others = (y[name] for name in model.state_names)
        return ca.vertcat(first + self.off, *others), memory

    def predict(self, model, x_hat, memory, u, p):
        return memory


class Nameless(Shifted):
    """Of this one Python's own text is an address, which another object may have later."""

    __repr__ = object.__repr__


PLANT = SimulatedPlant(plant_model(), {})


@pytest.mark.parametrize("kind", [Shifted, Nameless])
def test_two_estimators_of_the_same_text_run_their_own_equations(kind):
    # The first ones are gone before the next ones are made, so that an address may be used again.
    found = [simulate(controller(estimator=kind(off)), PLANT, steps=5, compiled=False) for off in (0.0, 0.1, 0.2)]
    for off, episode in zip((0.0, 0.1, 0.2), found, strict=True):
        own = controller(estimator=kind(off))
        np.testing.assert_allclose(episode.estimate[:, 0], np.r_[0.0, episode.state[1:-1, 0]] + off, rtol=0, atol=1e-12)
        np.testing.assert_allclose(episode.input, run_episode(own, PLANT, steps=5).input, rtol=0, atol=1e-6)


@pytest.mark.parametrize("kind", [Shifted, Nameless])
def test_two_estimators_of_the_same_equations_share_what_is_built(kind):
    one, other = controller(estimator=kind(0.1)), controller(estimator=kind(0.1))
    assert one.structure == other.structure
    assert problem_of(one) is problem_of(other)
    assert compiled_episode(one, PLANT, 5, compiled=False).function is compiled_episode(other, PLANT, 5, compiled=False).function
    assert controller(estimator=kind(0.2)).structure != one.structure


def test_the_numbers_of_a_filter_are_content():
    def kalman(process):
        return controller(estimator=ExtendedKalman(("position",), (0.1,), (process, 0.1), (0.1, 0.1)))

    assert kalman(0.1).structure == kalman(0.1).structure
    assert kalman(0.1).structure != kalman(0.2).structure


def test_outputs_of_other_names_are_another_plant():
    """A table adds to an output by its name, which the equations do not tell."""
    own, lookup_table = plant_model(), LookupTable.over({"force": (-1.0, 1.0)}, ["load"])
    table = np.full((1, lookup_table.size), 0.05)
    plant = SimulatedPlant(own, {})
    (episode,) = compiled_episode(controller(), plant, 3, compiled=False, lookup_table=lookup_table).run_each(
        [None], [plant], tables=[table]
    )
    np.testing.assert_allclose(episode.output_end - episode.true_end, np.tile([0.05, 0.0, 0.0], (3, 1)), atol=1e-12)
    renamed = SimulatedPlant(replace(own, outputs=(Signal("pull", "N"), *own.outputs[1:])), {})
    with pytest.raises(ValueError, match="table over 'load', allowed are pull, position"):
        compiled_episode(controller(), renamed, 3, compiled=False, lookup_table=lookup_table)
