"""A small plant for the tests of this folder: a leaking tank with direct feedthrough of the inflow."""

import pytest

from chargetune.model.model import Model, Signal
from chargetune.plants.simulated import SimulatedPlant

LEAK, SPLASH = 0.9, 0.25


@pytest.fixture(scope="session")
def tank() -> Model:
    """level+ = leak * level + inflow; outputs level and gauge = level + splash * inflow."""
    return Model.build(
        "tank",
        states=(Signal("level", "m"),),
        inputs=(Signal("inflow", "m"),),
        outputs=(Signal("level", "m"), Signal("gauge", "m")),
        parameters={"leak": LEAK, "splash": SPLASH},
        sampling_time_s=2.0,
        equations=lambda x, u, p: (
            {"level": p["leak"] * x["level"] + u["inflow"]},
            {"level": x["level"], "gauge": x["level"] + p["splash"] * u["inflow"]},
        ),
    )


@pytest.fixture
def make(tank):
    """A plant that starts at level 1 with what is asked for."""
    return lambda **more: SimulatedPlant(tank, {"level": 1.0}, **more)
