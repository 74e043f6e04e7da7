"""Derivatives that are infinite at the start, and numbers that are none: never called solved, and solved where there is a solution."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from scipy.optimize import minimize

import chargetune as ct
from chargetune.control.control_step import act, begin
from chargetune.control.sqp import SolveStatus

pytestmark = pytest.mark.usefixtures("virtual_machine")

SPACE = ct.ParameterSpace((ct.Parameter("power", 0.05, 2.0, default=1.0),))


def build(following, **changes):
    """A controller of T+ = following(T, u), 0 at the start, and the plant that it knows."""
    model = ct.Model.build(
        "root", states=(ct.Signal("T"),), inputs=(ct.Signal("u"),), outputs=(ct.Signal("T"),), parameters={"gain": 1.0},
        sampling_time_s=1.0, equations=lambda x, u, p: ({"T": following(x["T"], p["gain"] * u["u"])}, {"T": x["T"]}),
    )  # fmt: skip
    settings = {
        "horizon": 3,
        "stage_cost": lambda s: (s.u["u"] - s.theta["power"]) ** 2,
        "input_lower": {"u": 0.0},
        "input_upper": {"u": 2.0},
    }
    return ct.Controller.build(model, SPACE, **(settings | changes)), ct.SimulatedPlant(model, {})


def towards_one(s):
    return (s.x["T"] - 1.0) ** 2 + 0.01 * s.u["u"] ** 2


SYSTEMS = {
    "root of state and input": (lambda t, u: ca.sqrt(t + u), {}),
    "the same with a cost of the state": (lambda t, u: ca.sqrt(t + u), {"stage_cost": towards_one}),
    "root of the state alone": (lambda t, u: 0.9 * t - 0.3 * ca.sqrt(t) + u, {"stage_cost": towards_one}),
    "in blocks": (lambda t, u: 0.9 * t - 0.3 * ca.sqrt(t) + u, {"stage_cost": towards_one, "blocks": (2, 1)}),
    "with a limit": (
        lambda t, u: 0.9 * t - 0.3 * ca.sqrt(t) + u,
        {"stage_cost": towards_one, "limits": [ct.SoftLimit("T", upper=0.6, penalty=100.0, scale=0.1)]},
    ),
}


@pytest.mark.parametrize("hessian", ["gauss_newton", "exact"])
@pytest.mark.parametrize("name", SYSTEMS)
def test_a_root_at_the_start_is_solved(name, hessian):
    """dT/du or dT/dT is infinite at T = u = 0; the plan is that of a search without derivatives of the model."""
    following, changes = SYSTEMS[name]
    controller, plant = build(following, hessian=hessian, **changes)
    episode = ct.simulate(controller, plant, steps=4)
    assert episode.failures == 0
    held = controller.input_blocks

    def total(plan):
        t, cost = 0.0, 0.0
        for u in np.repeat(plan, held):
            cost += float(controller.stage_cost(t, u, 1.0, 1.0, [0, 0], 0, 0, []))
            t = float(controller.model.f(t, u, 1.0))
            cost += 1e3 * max(0.0, t - 0.6) if controller.limits else 0.0
        return cost

    best = minimize(
        total, np.full(len(held), 0.5), method="Nelder-Mead", bounds=[(0.0, 2.0)] * len(held), options={"xatol": 1e-6, "fatol": 1e-12}
    )
    assert episode.input[0, 0] == pytest.approx(best.x[0], abs=2e-3)


BROKEN = {
    "dynamics": {"parameters": lambda s: {"gain": 1.0 + s.given["broken"]}},
    "cost": {"stage_cost": lambda s: (s.u["u"] + 0.1) ** 2 * (1 + s.given["broken"])},
    "limit": {"limits": [ct.SoftLimit("T", upper=lambda s: 1.0 + s.given["broken"], penalty=10.0)]},
    "lower bound": {"input_lower": {"u": lambda s: s.given["broken"]}},
    "upper bound": {"input_upper": {"u": lambda s: 2.0 + s.given["broken"]}},
    "rate": {"input_rate": {"u": lambda s: 0.5 + s.given["broken"]}},
}


@pytest.mark.parametrize("first", [0, 1])
@pytest.mark.parametrize("name", BROKEN)
def test_what_is_no_number_is_never_solved(name, first):
    """NaN from the first interval, or from the second one on, with the plan at its lower bound, where a maximum would hide it."""
    settings = {"stage_cost": lambda s: (s.u["u"] + s.theta["power"]) ** 2 + 0.1 * s.x["T"] ** 2} | BROKEN[name]
    controller, _ = build(lambda t, u: 0.9 * t + u, given=(ct.Signal("broken"),), **settings)
    signals = np.zeros(controller.horizon + 2)
    u, _, info = act(controller, np.array([0.0]), SPACE.default, begin(controller), signals)
    assert (info.status, u[0]) == (SolveStatus.CONVERGED, pytest.approx(0.0, abs=1e-6))
    signals[1 + first :] = np.nan
    u, _, info = act(controller, np.array([0.0]), SPACE.default, begin(controller), signals)
    assert info.status != SolveStatus.CONVERGED
    # A bound that is known is kept.
    assert np.isfinite(u[0])
    assert u[0] <= 2.0 or name == "upper bound"
    assert u[0] >= 0.0 or name == "lower bound"


def test_a_score_whose_excess_is_no_number_is_a_broken_limit():
    for order in (("a", "b"), ("b", "a")):
        score = ct.Score(1.0, 1.0, {name: {"a": np.nan, "b": -1.0}[name] for name in order}, {"a": 0.1, "b": 0.1})
        assert score.worst == np.inf
        assert not score.feasible


def test_a_true_output_that_is_no_number_is_no_lost_sample():
    """What a sensor lost is left out; an output that a simulation does not have is no kept limit."""
    controller, plant = build(lambda t, u: 0.9 * t + u)
    episode = ct.simulate(controller, plant, steps=5)
    limits = (ct.ScoredLimit("T", upper=5.0),)
    lost = episode.output_start.copy()
    lost[2] = np.nan
    assert ct.score_limits(replace(episode, output_start=lost), limits, objective=lambda _: 0.0).score.feasible
    for value in (np.nan, np.inf, -np.inf):
        wrong = episode.true_start.copy()
        wrong[2] = value
        verdict = ct.score_limits(replace(episode, output_start=wrong, true_start=wrong), limits, objective=lambda _: 0.0)
        assert verdict.score is None
