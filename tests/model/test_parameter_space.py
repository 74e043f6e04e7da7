"""The space of theta."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from chargetune.model.parameter_space import Parameter, ParameterSpace

SPACE = ParameterSpace(
    (Parameter("b", -0.1, 0.3, 0.0, unit="V", size=3), Parameter("r", 0.1, 6.0, 1.0, scale="log"), Parameter("q", 1.0, 2.0, 1.5))
)


def test_layout():
    assert SPACE.dimension == 5
    assert SPACE.entries == ("b[0]", "b[1]", "b[2]", "r", "q")
    assert SPACE.slices == {"b": slice(0, 3), "r": slice(3, 4), "q": slice(4, 5)}
    np.testing.assert_array_equal(SPACE.default, [0, 0, 0, 1, 1.5])
    np.testing.assert_array_equal(SPACE.from_dict({"b": 0.2, "q": 2.0}), [0.2, 0.2, 0.2, 1.0, 2.0])
    np.testing.assert_array_equal(SPACE.from_dict({"b[1]": 0.1}), [0, 0.1, 0, 1, 1.5])


@given(st.lists(st.floats(0, 1), min_size=5, max_size=5))
def test_unit_cube_and_back(point):
    theta = SPACE.from_unit(point)
    assert np.all((theta >= SPACE.lower) & (theta <= SPACE.upper))
    np.testing.assert_allclose(SPACE.to_unit(theta), point, atol=1e-9)
    np.testing.assert_array_equal(SPACE.validate(theta), theta)


def test_the_log_scale_is_uniform_in_the_logarithm():
    middle = SPACE.from_unit(np.full(5, 0.5))
    assert middle[3] == pytest.approx(np.sqrt(0.1 * 6.0))
    assert middle[0] == pytest.approx(0.1)
    assert SPACE.to_unit(np.tile(middle, (4, 1))).shape == (4, 5)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("", 0, 1, 0.5), ["name"]),
        (("a b", 0, 1, 0.5), ["name 'a b'"]),
        (("a", 1, 1, 1), ["lower = 1", "upper = 1"]),
        (("a", 2, 1, 1), ["lower = 2", "upper = 1"]),
        (("a", np.nan, 1, 1), ["lower = nan"]),
        (("a", 0, np.inf, 1), ["upper = inf"]),
        (("a", 0, True, 1), ["upper = True"]),
        (("a", 0, 1, 2), ["default = 2", "[0, 1]"]),
        (("a", 0, 1, "x"), ["default = 'x'"]),
        (("a", 0, 1, (0.1, 0.2)), ["2 values, expected 1"]),
        (("a", 0, 1, 0.5, "1", "log"), ["lower = 0", "log"]),
        (("a", 0, 1, 0.5, "1", "cubic"), ["scale = 'cubic'"]),
        (("a", 0, 1, 0.5, "1", "linear", 0), ["size = 0"]),
        (("a", 0, 1, 0.5, "1", "linear", True), ["size = True"]),
    ],
)
def test_parameter_refuses(arguments, words):
    with pytest.raises(ValueError) as refused:  # noqa: PT011 - the words are what is tested
        Parameter(*arguments)
    assert all(word in str(refused.value) for word in words), refused.value


@pytest.mark.parametrize(
    ("theta", "words"),
    [
        ([0, 0, 0, 1], ["shape (4,)", "(5,)"]),
        ([0, 0, 0.4, 1, 1.5], ["b[2] = 0.4", "[-0.1, 0.3] V"]),
        ([0, 0, 0, np.nan, 1.5], ["r = nan", "[0.1, 6]"]),
    ],
)
def test_theta_outside_is_refused(theta, words):
    with pytest.raises(ValueError) as refused:  # noqa: PT011 - the words are what is tested
        SPACE.validate(theta)
    assert all(word in str(refused.value) for word in words)


def test_unknown_and_double_names_are_refused():
    with pytest.raises(ValueError, match=r"unknown name 'x'.*b, r, q"):
        SPACE.from_dict({"x": 1.0})
    with pytest.raises(ValueError, match=r"given twice.*'b'"):
        ParameterSpace((Parameter("b", 0, 1, 0.5), Parameter("b", 0, 1, 0.5)))
