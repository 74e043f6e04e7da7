"""Dynamics with an infinite derivative at the start: what was not solved must never be called solved."""

import casadi as ca
import numpy as np
import pytest

import chargetune as ct
from chargetune.control.sqp import SolveStatus


@pytest.mark.usefixtures("virtual_machine")
def test_an_infinite_derivative_is_no_optimum():
    """T+ = sqrt(T + u) at T = u = 0, cost (u - 1)^2: u = 0 is not optimal, whatever the scaling of the problem becomes."""
    model = ct.Model.build(
        "root", states=(ct.Signal("T"),), inputs=(ct.Signal("u"),), outputs=(ct.Signal("T"),), parameters={"gain": 1.0},
        sampling_time_s=1.0, equations=lambda x, u, p: ({"T": ca.sqrt(x["T"] + p["gain"] * u["u"])}, {"T": x["T"]}),
    )  # fmt: skip
    space = ct.ParameterSpace((ct.Parameter("power", 0.05, 2.0, default=1.0),))
    controller = ct.Controller.build(
        model, space, horizon=1, stage_cost=lambda s: (s.u["u"] - s.theta["power"]) ** 2, input_lower={"u": 0.0}, input_upper={"u": 2.0}
    )
    episode = ct.simulate(controller, ct.SimulatedPlant(model, {}), steps=3)
    solved = episode.status == SolveStatus.CONVERGED
    np.testing.assert_allclose(episode.input[solved, 0], 1.0, atol=1e-3)
    assert np.all(episode.kkt[~solved] > 1e-4)
