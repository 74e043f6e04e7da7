"""Score: feasible is every limit within its tolerance."""

import math

import pytest

from chargetune.episode.score import Score


@pytest.mark.parametrize(
    ("excess", "tolerance", "feasible"),
    [
        ({}, {}, True),
        ({"a": -1.0}, {}, True),
        ({"a": 0.0}, {}, True),
        ({"a": 1e-9}, {}, False),
        ({"a": 5e-4}, {"a": 5e-4}, True),
        ({"a": 5.1e-4}, {"a": 5e-4}, False),
        ({"a": -1.0, "b": 0.2}, {"a": 5e-4}, False),
        ({"a": float("nan")}, {"a": 5e-4}, False),
    ],
)
def test_feasible(excess, tolerance, feasible):
    assert Score(objective=0.0, performance=0.0, excess=excess, tolerance=tolerance).feasible is feasible


def test_excesses_of_different_units_are_compared_in_tolerances():
    slight = Score(0.0, 0.0, {"V": 0.002, "K": 0.6}, {"V": 0.001, "K": 0.5})
    gross = Score(0.0, 0.0, {"V": 0.5, "K": -1.0}, {"V": 0.001, "K": 0.5})
    assert slight.beyond == pytest.approx({"V": 1.0, "K": 0.2})
    assert slight.worst == pytest.approx(1.0)
    assert gross.worst == pytest.approx(499.0)
    # Without tolerance a limit counts in its own unit.
    assert Score(0.0, 0.0, {"V": 0.25, "s": -3.0}, {"s": 0.0}).beyond == pytest.approx({"V": 0.25, "s": -3.0})
    assert Score(0.0, 0.0, {}, {}).worst == -math.inf
    assert Score(0.0, 0.0, {}, {}).feasible
    for score in (slight, gross):
        assert (score.worst <= 0) == score.feasible
