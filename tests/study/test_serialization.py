from dataclasses import dataclass, field

import numpy as np
import pytest
from study_toy import SPACE, Halfway

from chargetune.episode.score import Score
from chargetune.study.serialization import (
    canonical_json,
    describe,
    differences,
    score_from_json,
    score_to_json,
    space_from_json,
    space_to_json,
)

SCORE = Score(-1.5, -2.0, {"voltage": 0.001}, {"voltage": 5e-4}, {"t80_min": None, "t95_min": 36.2}, {"voltage": (None, 0.001)})


def test_score_and_space_come_back_equal():
    assert score_from_json(score_to_json(SCORE)) == SCORE
    assert space_from_json(space_to_json(SPACE)) == SPACE


NO_NUMBERS = [float("nan"), float("inf"), "1", True, 1j]
NO_SCORES = [(f, v) for f in ("objective", "performance", "excess", "tolerance", "metrics", "profile") for v in NO_NUMBERS]
# None has a meaning in metrics and profile, and only there.
NO_SCORES += [(f, None) for f in ("objective", "performance", "excess", "tolerance")]


@pytest.mark.parametrize(("field", "value"), NO_SCORES)
def test_score_refuses_what_is_no_finite_number(field, value):
    fields = {"objective": 1.0, "performance": 1.0, "excess": {}, "tolerance": {}, "metrics": {}, "profile": {}}
    fields[field] = {"v": (0.0, value) if field == "profile" else value} if isinstance(fields[field], dict) else value
    with pytest.raises(ValueError, match=rf"score\.{field}.* = .*, allowed is a finite number"):
        score_to_json(Score(**fields))


def test_numpy_numbers_are_numbers():
    assert score_to_json(Score(np.float64(1.5), np.float32(2), {"v": np.int64(3)}, {}))["excess"] == {"v": 3.0}


def test_canonical_json_is_independent_of_order_and_container():
    assert canonical_json({"a": 1, "b": (1, 2)}, "x") == canonical_json({"b": np.array([1, 2]), "a": np.int32(1)}, "x")


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ({"a": {"b": [1, float("nan")]}}, r"config\.a\.b\[1\] = nan"),
        ({"a": {3: 1}}, r"config\.a has the key 3"),
        ({"a": {1, 2}}, r"config\.a is a set"),
    ],
)
def test_canonical_json_names_the_place(value, message):
    with pytest.raises(ValueError, match=message):
        canonical_json(value, "config")


@pytest.mark.parametrize(
    ("old", "new", "lines"),
    [
        ({"a": 1}, {"a": 1.0}, []),
        ({"a": 1}, {"a": True}, ["a: 1 -> true"]),
        ({"a": {"b": 1, "c": 2}}, {"a": {"b": 2, "d": 2}}, ["a.b: 1 -> 2", "a.c: 2 -> (absent)", "a.d: (absent) -> 2"]),
        ({"a": [1, {"b": 2}]}, {"a": [1, {"b": 3}]}, ["a[1].b: 2 -> 3"]),
        ({"a": [1]}, {"a": [1, 2]}, ["a: [1] -> [1, 2]"]),
        ({"a": "x" * 100}, {"a": None}, ['a: "' + "x" * 56 + "... -> (not given)"]),
    ],
)
def test_differences(old, new, lines):
    assert differences(old, new) == lines


def test_describe_tells_apart_and_holds_no_address():
    @dataclass(frozen=True)
    class Tuner:
        inner: Halfway
        function: object = np.sin
        limit: float = float("inf")
        plain: object = None
        known: int = field(default=0, metadata={"identity": False})

    class Plain:
        pass

    # What the configuration holds already is left out.
    assert describe(Tuner(Halfway(1), known=1)) == describe(Tuner(Halfway(1), known=2))
    one = describe(Tuner(Halfway(1), plain=Plain()))
    assert one == describe(Tuner(Halfway(1), plain=Plain()))
    assert one != describe(Tuner(Halfway(2), plain=Plain()))
    assert one["inner"] == {"type": "Halfway", "seed": 1}
    assert one["limit"] == "inf"
    assert "0x" not in canonical_json(one, "tuner")
