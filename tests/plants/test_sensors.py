"""Sensors: what is refused, and the vectors in the order of the outputs."""

import math

import numpy as np
import pytest

from chargetune.model.model import Signal
from chargetune.plants.sensors import Sensors

OUTPUTS = (Signal("level", "m"), Signal("flow", "m3/s"))


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ({"noise_sd": {"level": -0.1}}, ("noise_sd of level", "-0.1", ">= 0")),
        ({"noise_sd": {"level": math.nan}}, ("noise_sd of level", "nan", "finite")),
        ({"bias": {"flow": math.inf}}, ("bias of flow", "inf", "finite")),
        ({"bias": {"flow": "0,01"}}, ("bias of flow", "'0,01'", "finite number")),
        ({"bias": {"flow": True}}, ("bias of flow", "True", "finite number")),
        ({"resolution": {"level": -1}}, ("resolution of level", "-1", ">= 0")),
        ({"delay_steps": -1}, ("delay_steps", "-1", "[0, 100]")),
        ({"delay_steps": 101}, ("delay_steps", "101", "[0, 100]")),
        ({"delay_steps": 1.0}, ("delay_steps", "1.0", "integer")),
        ({"delay_steps": True}, ("delay_steps", "True", "integer")),
    ],
)
def test_refuses(arguments, named):
    with pytest.raises(ValueError, match="sensors: ") as refused:
        Sensors(**arguments)
    for part in named:
        assert part in str(refused.value)


def test_a_negative_bias_is_a_bias():
    assert Sensors(bias={"level": -0.5}).vectors(OUTPUTS)[1].tolist() == [-0.5, 0.0]


def test_vectors_follow_the_order_of_the_outputs():
    sensors = Sensors(noise_sd={"flow": 2.0, "level": 1.0}, bias={"flow": 3}, resolution={"level": 0.25})
    for found, expected in zip(sensors.vectors(OUTPUTS), ([1.0, 2.0], [0.0, 3.0], [0.25, 0.0]), strict=True):
        np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("name", ["noise_sd", "bias", "resolution"])
def test_an_unknown_signal_is_named(name):
    with pytest.raises(ValueError, match=rf"{name} names unknown \['voltage'\], allowed are level, flow"):
        Sensors(**{name: {"voltage": 1.0}}).vectors(OUTPUTS)
