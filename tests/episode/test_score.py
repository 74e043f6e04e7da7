"""Score: feasible is every limit within its tolerance."""

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
