"""What a controller does on a perfect model: each error planted, none where there is none."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from chargetune.battery.cell.cell import default_cell
from chargetune.battery.charging.controller import controller_of
from chargetune.checks.nominal_loop import check_formulation, check_limits, check_longer_horizon, perfect_plant
from chargetune.control.controller import Controller, SoftLimit
from chargetune.episode.compiled import simulate
from chargetune.model.model import Model, Signal
from chargetune.model.parameter_space import Parameter, ParameterSpace
from charging_problems import charging_problem


@pytest.fixture(scope="module")
def oracle():
    """The case study's controller with a measured overpotential, which knows the cell."""
    return controller_of(charging_problem(default_cell(), mismatch_seed=None, kind="exact"))


def run(controller, steps=300):
    return simulate(controller, perfect_plant(controller), steps=steps, compiled=False)


def planted(controller, **changes):
    return replace(controller, limits=tuple(replace(limit, **changes) for limit in controller.limits))


def test_the_oracle_has_no_error(oracle):
    assert check_limits(oracle, run(oracle)) == []


def test_a_limit_at_the_start_of_intervals_only_is_broken_between_samples(oracle):
    """At Ts = 10 s a perfect model overshoots by some millivolts."""
    controller = planted(oracle, at="start")
    (found,) = check_limits(controller, run(controller))
    assert (found.code, found.severity) == ("between-samples", "warning")
    assert 5e-3 < found.numbers["excess"] < 12e-3
    assert found.numbers["excess_where_limited"] < 1e-5
    assert 'at = "both"' in found.remedy
    # The same from the voltages of the episode itself.
    assert found.numbers["excess"] == pytest.approx(np.max(run(controller).signal("voltage_V")[1]) - 4.2, abs=1e-9)


def test_a_penalty_that_is_too_small_is_found_with_one_that_is_not(oracle):
    small = planted(oracle, penalty=1e-3)
    (found,) = check_limits(small, run(small))
    assert (found.code, found.severity) == ("inexact-penalty", "error")
    assert found.numbers["excess"] > 0.1
    mended = planted(oracle, penalty=found.numbers["penalty_exact"])
    assert check_limits(mended, run(mended)) == []


BOX = {"input_lower": {"u": -1.0}, "input_upper": {"u": 1.0}}


def mass(sampling_time_s=0.1):
    """x+ = x + Ts v, v+ = v + Ts u."""
    return Model.build(
        "mass",
        states=(Signal("x", "m"), Signal("v", "m/s")),
        inputs=(Signal("u"),),
        outputs=(Signal("x", "m"), Signal("v", "m/s")),
        parameters={},
        sampling_time_s=sampling_time_s,
        equations=lambda x, u, p: (
            {"x": x["x"] + sampling_time_s * x["v"], "v": x["v"] + sampling_time_s * u["u"]},
            {"x": x["x"], "v": x["v"]},
        ),
    )


def braking(horizon, start=None, at="end", cost=lambda s: (s.x["x"] - 2) ** 2 + 0.01 * s.u["u"] ** 2):
    """A mass that shall go to x = 2 and not beyond 1: it has to brake in time."""
    return Controller.build(
        mass(), ParameterSpace(()), horizon=horizon, stage_cost=cost, terminal_cost=lambda s: 0 * s.x["x"], **BOX,
        limits=[SoftLimit("x", upper=1.0, at=at, penalty=1e4, scale=0.1)], start=start or {},
    )  # fmt: skip


def test_a_limit_that_cannot_be_kept_is_told_apart_from_a_small_penalty():
    controller = braking(20, start={"x": 0.9, "v": 2.0})
    (found,) = check_limits(controller, run(controller, 40))
    assert (found.code, found.severity) == ("limit-not-kept", "warning")
    # Full braking from 2 m/s takes 2 m.
    assert found.numbers["excess"] == pytest.approx(1.9, abs=0.15)


def test_a_horizon_that_cannot_brake_is_found_and_a_longer_one_is_not():
    short, long = braking(4), braking(25)
    (found,) = check_longer_horizon(short, run(short, 60))
    assert found.code == "short-horizon"
    assert found.numbers["cost_longer"] < 0.95 * found.numbers["cost"]
    assert check_longer_horizon(long, run(long, 60)) == []
    assert check_longer_horizon(replace(long, horizon=50), run(long, 60)) == []


def test_the_closed_loop_costs_what_each_solve_takes_for_its_first_interval():
    """l(x_k, u_k) with x_k as ``now``: here each solve wants to go half of what is left to 2 m."""

    def cost(s):
        ahead = s.now["x"] + 0.5 * (2 - s.now["x"])
        return (s.x["x"] - ahead) ** 2 + 0.1 * s.x["v"] ** 2 + 0.01 * s.u["u"] ** 2

    short = braking(2, cost=cost)
    whole = run(short, 60)
    (found,) = check_longer_horizon(short, whole)
    far = run(replace(short, horizon=20), 60)
    for name, episode in (("cost", whole), ("cost_longer", far)):
        (x, v), u = episode.state[:-1].T, episode.input[:, 0]
        beyond = episode.state[1:, 0] - 1.0
        penalty = 1e4 * np.where(beyond > 1e-3, beyond, 0.0)
        assert found.numbers[name] == pytest.approx(np.sum((0.5 * (2 - x)) ** 2 + 0.1 * v**2 + 0.01 * u**2 + penalty), rel=1e-6)


def test_what_rises_and_falls_inside_an_interval_is_found_by_a_finer_model():
    controller = braking(25)
    whole = run(controller, 60)
    assert check_limits(controller, whole, finer=mass(0.01)) == []
    (found,) = check_limits(controller, whole, finer=there_and_back())
    assert found.code == "between-samples"
    assert found.numbers["excess"] == pytest.approx(0.05, abs=2e-3)
    assert "both ends keep it" in found.message
    assert "sampling time" in found.remedy


def there_and_back():
    """In the middle of an interval of 0.1 s a mass at its limit of 1 m is 0.05 m further on, at the end back."""
    model = mass(0.05)
    return Model.build(
        "there and back",
        states=model.states,
        inputs=model.inputs,
        outputs=model.outputs,
        parameters={},
        sampling_time_s=0.05,
        equations=lambda x, u, p: (
            {"x": x["x"] + ca.if_else(x["x"] > 1.01, -0.05, 0.05), "v": x["v"]},
            {"x": x["x"], "v": x["v"]},
        ),
    )


@pytest.mark.usefixtures("virtual_machine")
def test_everything_at_once_on_a_system_that_is_no_battery():
    def built(**changes):
        space = ParameterSpace((Parameter("weight", 0.1, 10.0, 1.0, scale="log"), Parameter("nothing", 0.0, 1.0, 0.5)))
        return Controller.build(
            mass(), space, horizon=25, stage_cost=lambda s: s.theta["weight"] * (s.x["x"] - 2) ** 2 + 0.1 * s.u["u"] ** 2, **BOX,
            limits=[SoftLimit("x", upper=1.0, at="end", penalty=1e4, scale=0.1)], **changes,
        )  # fmt: skip

    (found,) = check_formulation(built(), steps=50, signs={("v", "u"): 1}, quick=True)
    assert found.code == "no-influence"
    assert found.message.startswith("nothing: ")
    turned = check_formulation(built(), steps=50, signs={("v", "u"): -1}, quick=True)
    assert [f.code for f in turned] == ["wrong-sign", "no-influence"]
    # From an unsafe start nothing else is worth telling.
    assert [f.code for f in check_formulation(built(start={"x": 1.5}), steps=50, signs={("v", "u"): -1})] == ["unsafe-start"]
