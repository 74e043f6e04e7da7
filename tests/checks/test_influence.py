"""Entries of theta without influence, limits that no theta keeps, a theta declared safe that is not."""

from dataclasses import replace

import numpy as np
import pytest

from chargetune.checks import influence
from chargetune.checks.influence import check_influence, check_theta
from chargetune.model.parameter_space import Parameter, ParameterSpace

SPACE = ParameterSpace((Parameter("a", 0.0, 1.0, 0.2), Parameter("b", -1.0, 1.0, 0.0, size=2)))


@pytest.fixture
def controller(tank_controller):
    return replace(tank_controller(), theta=SPACE)


def inputs(weights):
    """Inputs that answer to theta with these weights; the tank's range is 0.5."""
    return lambda theta: np.full((4, 1), float(np.dot(weights, theta)))


@pytest.mark.parametrize(
    ("weights", "idle", "severity"),
    [
        ((1.0, 1.0, 1.0), None, None),
        ((1.0, 0.0, 1.0), "b[0]", "warning"),
        ((1.0, 0.0, 0.0), "b", "warning"),
        ((0.0, 1.0, 1.0), "a", "warning"),
        ((0.0, 0.0, 0.0), "a, b", "error"),
        ((1.0, 1e-4, 1.0), "b[0]", "warning"),  # 2e-4 of a range of 0.5 is below what is called a change
    ],
)
def test_entries_without_influence(weights, idle, severity, controller, monkeypatch):
    monkeypatch.setattr("chargetune.checks.influence._ranges", lambda _, given=None: np.array([0.5]))
    found = check_influence(inputs(weights), controller)
    if idle is None:
        assert found == []
        return
    assert found[0].code == "no-influence"
    assert found[0].severity == severity
    assert found[0].message.startswith(f"{idle}: ")
    # b[1] is moved from -1..1 to either end, from anywhere: the largest change is from one bound to the other at most.
    assert found[0].numbers["influence b[1]"] == pytest.approx(abs(weights[2]) / 0.5, rel=1.0)


def test_an_influence_elsewhere_than_at_the_default_counts(controller, monkeypatch):
    monkeypatch.setattr("chargetune.checks.influence._ranges", lambda _, given=None: np.array([0.5]))
    # b[0] acts only while a is above its default.
    assert check_influence(lambda t: np.array([[t[2] + t[0] + max(0.0, t[0] - 0.2) * t[1]]]), controller) == []


def test_an_episode_that_ends_early_is_a_change(controller, monkeypatch):
    monkeypatch.setattr("chargetune.checks.influence._ranges", lambda _, given=None: np.array([0.5]))
    found = check_influence(lambda t: np.zeros((4 if t[0] < 0.9 else 2, 1)), controller)
    assert found[0].message.startswith("b: ")


def test_the_range_of_an_input_is_what_the_controller_allows(tank_controller):
    assert influence._ranges(tank_controller()) == pytest.approx([0.5])


def test_no_theta_keeps_the_limits():
    (found,) = check_theta(lambda theta: 0.05 - 0.01 * theta[0], SPACE)
    assert (found.code, found.severity) == ("no-safe-theta", "warning")
    assert found.numbers["untuned_excess"] == pytest.approx(0.048)
    assert found.numbers["least_excess"] == pytest.approx(0.04, abs=1e-3)


@pytest.mark.parametrize(
    "worst",
    [
        lambda t: -0.1,  # untuned it keeps them
        lambda t: 0.05 - 0.1 * t[0],  # one parameter at its bound does
        lambda t: 0.05 + 0.1 * t[1] + 0.1 * t[2],  # a whole vector at its bound does
        lambda t: 0.05 if abs(t[0] - 0.2) < 1e-9 else 0.02,  # more than half of it goes
    ],
)
def test_some_theta_keeps_the_limits(worst):
    assert check_theta(worst, SPACE) == []


def test_a_start_declared_safe_is_checked():
    (found,) = check_theta(lambda theta: theta[0] - 0.5, SPACE, start=[0.7, 0.0, 0.0])
    assert (found.code, found.severity) == ("unsafe-start", "error")
    assert found.numbers["excess"] == pytest.approx(0.2)
    assert check_theta(lambda theta: theta[0] - 0.5, SPACE, start=[0.3, 0.0, 0.0]) == []
    with pytest.raises(ValueError, match="allowed is"):
        check_theta(lambda theta: 0.0, SPACE, start=[2.0, 0.0, 0.0])
