"""Errors of a controller that are seen without running it: each one planted, and none where there is none."""

import numpy as np
import pytest

from chargetune.checks.static import check_horizon, check_signs, check_start, row_values
from chargetune.control.controller import Controller, SoftLimit
from chargetune.model.model import Model, Signal
from chargetune.model.parameter_space import Parameter, ParameterSpace

TS, R0, R1, TAU = 10.0, 0.06, 0.03, 40.0
SIGNS = {("voltage_V", "current_A"): 1, ("soc", "current_A"): 1}


def circuit(sign=1.0):
    """An R-RC circuit with a straight OCV; ``sign`` = -1 is the erratum V = OCV - U1 - R0 I."""
    keep = float(np.exp(-TS / TAU))
    return Model.build(
        "circuit",
        states=(Signal("soc"), Signal("overpotential_V", "V")),
        inputs=(Signal("current_A", "A"),),
        outputs=(Signal("voltage_V", "V"), Signal("soc"), Signal("overpotential_V", "V")),
        parameters={"sign": sign, "keep": keep},
        sampling_time_s=TS,
        equations=lambda x, u, p: (
            {
                "soc": x["soc"] + TS / 7200 * u["current_A"],
                "overpotential_V": p["keep"] * x["overpotential_V"] + (1 - p["keep"]) * R1 * u["current_A"],
            },
            {
                "voltage_V": 3 + 1.2 * x["soc"] + p["sign"] * (x["overpotential_V"] + R0 * u["current_A"]),
                "soc": x["soc"],
                "overpotential_V": x["overpotential_V"],
            },
        ),
    )


def controller(sign=1.0, horizon=5, soc=0.1, least=0.0, at="both", *, tuned=False):
    return Controller.build(
        circuit(sign),
        ParameterSpace((Parameter("keep", 0.01, 0.999, 0.5),) if tuned else ()),
        horizon=horizon,
        stage_cost=lambda s: (1 - s.x["soc"]) ** 2,
        parameters=(lambda s: {"keep": s.theta["keep"]}) if tuned else (lambda s: {}),
        input_lower={"current_A": least},
        input_upper={"current_A": 6.0},
        limits=[SoftLimit("voltage_V", upper=4.2, lower=2.5, at=at, scale=0.1)],
        start={"soc": soc},
    )


STATES = np.column_stack([np.linspace(0.1, 0.9, 9), np.linspace(0.1, 0.0, 9)])
INPUTS = np.linspace(6.0, 0.5, 8)[:, None]


def test_rows_are_the_voltage_beyond_its_limit_by_hand():
    x, u = np.array([[0.5, 0.1], [0.9, 0.05]]), np.array([[6.0], [2.0]])
    by_hand = 3 + 1.2 * x[:, 0] + x[:, 1] + R0 * u[:, 0] - 4.2
    np.testing.assert_allclose(row_values(controller(), 0, x, u), by_hand, atol=1e-12)


def test_the_sign_of_the_paper_is_found():
    (found,) = check_signs(controller(sign=-1.0), SIGNS, STATES, INPUTS)
    assert (found.code, found.severity) == ("wrong-sign", "error")
    assert "voltage_V falls when current_A is raised" in found.message
    assert found.numbers["share_wrong"] == 1.0
    # d V / d I at the end of the interval: - R0 - R1 (1 - exp(-Ts / tau)), and the OCV's part.
    by_hand = -R0 - R1 * (1 - np.exp(-TS / TAU)) + 1.2 * TS / 7200
    assert found.numbers["slope_mean"] == pytest.approx(by_hand, rel=1e-9)
    (x, y) = found.evidence.lines["model"]
    assert len(x) == len(y) > 1


def test_right_signs_are_not_found_and_an_expectation_turned_round_is():
    assert check_signs(controller(), SIGNS, STATES, INPUTS) == ()
    (found,) = check_signs(controller(), {("soc", "current_A"): -1}, STATES, INPUTS)
    assert "soc rises" in found.message


@pytest.mark.parametrize(
    ("changes", "least"),
    [
        ({"soc": 1.05}, 3 + 1.2 * 1.05 - 4.2),  # above the limit at rest
        ({"soc": 0.9, "least": 4.0}, 3 + 1.2 * 0.9 + 4.0 * R0 - 4.2),  # the least current is too large
        ({"soc": -1.0}, 2.5 - (3 - 1.2 + 6.0 * R0)),  # below the lower limit even at the largest current
    ],
)
def test_a_start_that_no_input_makes_safe_is_found(changes, least):
    (found,) = check_start(controller(**changes))
    assert (found.code, found.severity) == ("unsafe-start", "error")
    assert found.numbers["least_excess"] == pytest.approx(least, abs=1e-9)


@pytest.mark.parametrize("changes", [{}, {"soc": 0.9}, {"soc": 1.0}, {"soc": 0.95, "least": -1.0}])
def test_a_safe_start_is_not_found(changes):
    assert check_start(controller(**changes)) == ()


@pytest.mark.parametrize(("horizon", "found"), [(1, True), (2, False), (5, False)])
def test_a_horizon_below_half_the_time_constant_is_found(horizon, found):
    findings = check_horizon(controller(horizon=horizon), STATES, INPUTS)
    assert [f.code for f in findings] == ["short-horizon"] * found
    if found:
        assert findings[0].numbers["time_constant_s"] == pytest.approx(TAU, rel=1e-9)
        assert findings[0].numbers["least_intervals"] == 2


def test_the_time_constant_is_that_of_theta():
    # exp(-10 / tau) = 0.9 is tau = 94.9 s, of which 20 s are less than half.
    model = controller(horizon=2, tuned=True)
    assert check_horizon(model, STATES, INPUTS) == ()
    (found,) = check_horizon(model, STATES, INPUTS, [0.9])
    assert found.numbers["time_constant_s"] == pytest.approx(-TS / np.log(0.9), rel=1e-9)
