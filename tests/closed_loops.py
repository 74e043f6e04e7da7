"""Fixtures of two closed loops: a small tank, and the cell of the case study."""

from dataclasses import replace

import numpy as np
import pytest

from chargetune.battery.cell.cell import default_cell
from chargetune.battery.charging.tunables import Backoff
from chargetune.control.controller import Controller, SoftLimit
from chargetune.control.estimators import Propagated
from chargetune.model.model import Model, Signal
from chargetune.model.parameter_space import Parameter, ParameterSpace
from chargetune.plants.simulated import SimulatedPlant
from charging_problems import charging_problem

INFLOW_MAX = 0.5


@pytest.fixture(scope="session")
def tank() -> Model:
    """level+ = leak * level + inflow, gauge = level + splash * inflow."""
    return Model.build(
        "tank",
        states=(Signal("level", "m"),),
        inputs=(Signal("inflow", "m"),),
        outputs=(Signal("level", "m"), Signal("gauge", "m")),
        parameters={"leak": 0.9, "splash": 0.25},
        sampling_time_s=2.0,
        equations=lambda x, u, p: (
            {"level": p["leak"] * x["level"] + u["inflow"]},
            {"level": x["level"], "gauge": x["level"] + p["splash"] * u["inflow"]},
        ),
    )


@pytest.fixture(scope="session")
def tank_controller(tank):
    """Fills to level 2 with gauge <= limit; theta is the limit, in [-1, 5] so that log(limit) can be no number."""

    def build(cost=lambda s: (s.x["level"] - s.x_d["level"]) ** 2, estimator=None, start=1.0):
        return Controller.build(
            tank,
            ParameterSpace((Parameter("limit", -1.0, 5.0, 1.9),)),
            horizon=3,
            stage_cost=cost,
            terminal_cost=cost,
            input_lower={"inflow": 0.0},
            input_upper={"inflow": INFLOW_MAX},
            limits=[SoftLimit("gauge", upper=lambda s: s.theta["limit"], scale=0.1)],
            fallback={"inflow": 0.125},
            setpoint={"level": 2.0},
            start={"level": start},
            estimator=estimator or Propagated(("level",)),
        )

    return build


@pytest.fixture
def tank_plant(tank):
    """A tank at level 1 with what is asked for."""
    return lambda **more: SimulatedPlant(tank, {"level": 1.0}, **more)


@pytest.fixture(scope="session")
def charging():
    """The case study with a backoff in theta, 120 steps of 10 s from SOC 0.4 so that the voltage limit is met."""
    return charging_problem(default_cell(), mismatch_seed=0, backoff=Backoff(), steps=120, soc_start=0.4)


@pytest.fixture(scope="session")
def same():
    """Two episodes are the same: every array within ``tolerance`` of its unit, names and ending exactly."""

    def check(one, two, tolerance=1e-5):
        assert one.meta() == two.meta()
        left, right = one.arrays(), two.arrays()
        assert left.keys() == right.keys()
        for name in left.keys() - {"kkt", "iterations"}:
            np.testing.assert_allclose(left[name], right[name], rtol=0, atol=tolerance, err_msg=name)

    return check


@pytest.fixture
def with_estimator(charging):
    """The case study's controller with another estimator."""
    return lambda estimator: replace(charging.controller, estimator=estimator)
