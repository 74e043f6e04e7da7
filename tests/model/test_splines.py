"""Splines against SciPy, and what they promise beyond it."""

import casadi as ca
import numpy as np
import pytest
from scipy.interpolate import CubicSpline, PchipInterpolator

from chargetune.model.splines import natural_spline, natural_spline_matrix, pchip, piecewise_linear

NODES = [
    [0.0, 1.0],
    [0.0, 0.3, 1.0],
    list(np.linspace(0, 1, 7)),
    [0.0, 0.005, 0.0352, 0.0854, 0.1357, 0.2915, 0.4523, 0.8392, 0.9548, 1.0],
]


def evaluate(make, nodes, values, at):
    z = ca.SX.sym("z")
    return np.array(ca.Function("s", [z], [make(z, nodes, values)])(np.asarray(at).reshape(1, -1))).ravel()


@pytest.mark.parametrize("nodes", NODES)
def test_natural_spline_is_that_of_scipy(nodes):
    values = np.random.default_rng(0).normal(size=len(nodes))
    at = np.linspace(nodes[0], nodes[-1], 301)
    expected = np.interp(at, nodes, values) if len(nodes) == 2 else CubicSpline(nodes, values, bc_type="natural")(at)
    np.testing.assert_allclose(evaluate(natural_spline, nodes, values, at), expected, atol=1e-8)


@pytest.mark.parametrize("nodes", NODES)
def test_pchip_is_that_of_scipy_and_monotone(nodes):
    values = np.cumsum(np.random.default_rng(1).uniform(0.01, 1, len(nodes)))
    at = np.linspace(nodes[0], nodes[-1], 301)
    found = evaluate(pchip, nodes, values, at)
    np.testing.assert_allclose(found, PchipInterpolator(nodes, values)(at), atol=1e-8)
    assert np.all(np.diff(found) > 0)


@pytest.mark.parametrize("nodes", NODES)
def test_piecewise_linear_is_numpys_and_linear_beyond(nodes):
    values = np.random.default_rng(2).normal(size=len(nodes))
    at = np.linspace(nodes[0], nodes[-1], 301)
    np.testing.assert_allclose(evaluate(piecewise_linear, nodes, values, at), np.interp(at, nodes, values), atol=1e-12)
    beyond = evaluate(piecewise_linear, nodes, values, [nodes[-1] + 0.1])
    slope = (values[-1] - values[-2]) / (nodes[-1] - nodes[-2])
    np.testing.assert_allclose(beyond, values[-1] + 0.1 * slope, atol=1e-12)


@pytest.mark.parametrize("make", [natural_spline, pchip])
@pytest.mark.parametrize("nodes", NODES)
def test_first_derivative_is_continuous_and_outside_is_a_straight_line(make, nodes):
    values = np.cumsum(np.random.default_rng(2).uniform(0.1, 1, len(nodes)))
    z = ca.SX.sym("z")
    s = make(z, nodes, values)
    slope = ca.Function("d", [z], [ca.jacobian(s, z)])
    for node in nodes:
        assert float(slope(node - 1e-9)) == pytest.approx(float(slope(node + 1e-9)), abs=1e-3 * (1 + abs(float(slope(node)))))
    for outside in (np.array([-3.0, -2.0, -1.0]), np.array([2.0, 3.0, 4.0])):
        second = np.diff(evaluate(make, nodes, values, outside), 2)
        np.testing.assert_allclose(second, 0, atol=1e-5)
    middle = 0.37
    step = 1e-6
    numbers = evaluate(make, nodes, values, [middle - step, middle + step])
    assert float(slope(middle)) == pytest.approx(np.diff(numbers)[0] / (2 * step), rel=1e-5)


def test_coefficients_are_linear_in_node_values_that_are_parameters():
    z, values = ca.SX.sym("z"), ca.SX.sym("v", 7)
    nodes = np.linspace(0, 1, 7)
    s = ca.Function("s", [z, values], [natural_spline(z, nodes, values)])
    a, b = np.random.default_rng(3).normal(size=(2, 7))
    assert float(s(0.41, 2 * a - 3 * b)) == pytest.approx(2 * float(s(0.41, a)) - 3 * float(s(0.41, b)))
    np.testing.assert_allclose([float(s(n, a)) for n in nodes], a, atol=1e-12)
    assert natural_spline_matrix(nodes).shape == (9, 7)


@pytest.mark.parametrize("nodes", [[0.0], [0.0, 0.0], [1.0, 0.0], [0.0, np.nan], [0.0, np.inf], [[0.0, 1.0]]])
def test_bad_nodes_are_refused(nodes):
    with pytest.raises(ValueError, match="strictly increasing"):
        natural_spline(ca.SX.sym("z"), nodes, [1.0] * len(nodes))
    with pytest.raises(ValueError, match="strictly increasing"):
        pchip(ca.SX.sym("z"), nodes, [1.0] * len(nodes))


def test_wrong_number_of_values_is_refused():
    with pytest.raises(ValueError, match=r"\(3, 1\).*\(2, 1\)"):
        natural_spline(ca.SX.sym("z"), [0.0, 1.0], [1.0, 2.0, 3.0])
    with pytest.raises(ValueError, match="finite"):
        pchip(ca.SX.sym("z"), [0.0, 1.0], [1.0, np.nan])
