"""A schedule of theta over contexts: its interpolation in closed form, its space, and what is refused."""

import numpy as np
import pytest

from chargetune.model.parameter_space import Parameter, ParameterSpace
from chargetune.model.schedule import Axis, Schedule

BASE = ParameterSpace((Parameter("b", -1.0, 3.0, 0.0, size=2), Parameter("r", 0.1, 10.0, 1.0, scale="log"), Parameter("c", 0.0, 1.0, 0.5)))
AMBIENT, AGE = Axis("ambient_K", (280.0, 290.0, 310.0), "K"), Axis("age", (0.0, 1.0))


def test_bilinear_in_closed_form():
    """A table of what is linear in each quantity gives it everywhere: b = T a, log r = T + a, and c is the same in each context."""
    own = Schedule((AMBIENT, AGE), ("b", "r"))
    grid = [((t - 280) / 30, a) for t in AMBIENT.nodes for a in AGE.nodes]
    table = np.concatenate([np.ravel([(t * a, -t * a) for t, a in grid]), [np.exp(t + a) for t, a in grid], [0.7]])
    for ambient, age in ((280.0, 0.0), (285.0, 0.3), (290.0, 1.0), (303.0, 0.55), (310.0, 0.5)):
        t, a = (ambient - 280) / 30, age
        found = own.theta(BASE, table, {"ambient_K": ambient, "age": age, "more": 1.0})
        np.testing.assert_allclose(found, [t * a, -t * a, np.exp(t + a), 0.7], rtol=1e-12, atol=1e-12)


def test_piecewise_between_uneven_nodes():
    own = Schedule((AMBIENT,), ("c",))
    table = np.concatenate([[0.0, 0.0], [1.0], [0.0, 1.0, 0.0]])
    found = [own.theta(BASE, table, {"ambient_K": t})[3] for t in (280, 285, 290, 300, 310)]
    np.testing.assert_allclose(found, [0.0, 0.5, 1.0, 0.5, 0.0], atol=1e-12)


def test_space_and_the_constant_table():
    own = Schedule((AMBIENT, AGE))
    space = own.space(BASE)
    assert [p.size for p in space.parameters] == [12, 6, 6]
    theta = np.array([1.0, -0.5, 2.0, 0.25])
    table = own.constant(BASE, theta)
    np.testing.assert_allclose(own.theta(BASE, table, {"ambient_K": 287.0, "age": 0.9}), theta, rtol=1e-12)
    np.testing.assert_array_equal(own.constant(BASE, BASE.default), space.default)


@pytest.mark.parametrize(
    ("context", "named"),
    [
        ({"ambient_K": 279.9, "age": 0.5}, r"ambient_K = 279.9, allowed is what the schedule spans, \[280, 310\] K"),
        ({"ambient_K": 300.0, "age": 1.01}, r"age = 1.01, allowed is what the schedule spans, \[0, 1\]"),
        ({"ambient_K": float("nan"), "age": 0.0}, "ambient_K = nan"),
        ({"age": 0.0}, "ambient_K is not told"),
    ],
)
def test_context_outside_is_refused(context, named):
    own = Schedule((AMBIENT, AGE))
    with pytest.raises(ValueError, match=named):
        own.theta(BASE, own.space(BASE).default, context)


def test_wrong_tables_are_refused():
    with pytest.raises(ValueError, match=r"age = \[1, 0\], allowed are at least 2 finite, increasing"):
        Axis("age", (1, 0))
    with pytest.raises(ValueError, match=r"schedule: axes \[\], allowed is at least one"):
        Schedule(())
    with pytest.raises(ValueError, match=r"parts names unknown \['x'\], allowed are b, r, c"):
        Schedule((AGE,), ("x",)).space(BASE)
