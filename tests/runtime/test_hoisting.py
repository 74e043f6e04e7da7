"""What depends on parameters alone, apart from the rest."""

import casadi as ca
import numpy as np

from chargetune.runtime.hoisting import hoist

AT = np.array([0.3, -1.2]), np.array([0.7, 2.0, 0.1])


def test_function_of_q_is_the_function_of_what_q_is_of():
    x, p = ca.SX.sym("x", 2), ca.SX.sym("p", 3)
    expressions = [ca.exp(p[0]) * x[0] + p[1] * p[2], ca.vertcat(x[1] ** 2, ca.exp(p[0]) * x[1])]
    whole = ca.Function("whole", [x, p], expressions)
    function, of = hoist("f", [x], [p], expressions)
    for found, expected in zip(function(AT[0], of(AT[1])), whole(*AT), strict=True):
        np.testing.assert_allclose(np.array(found), np.array(expected), rtol=1e-14)
    # exp(p_0) is in both expressions and one entry of q, p_1 p_2 the other.
    assert of.size1_out(0) == 2


def test_without_parameters_q_is_empty():
    x, p = ca.SX.sym("x", 2), ca.SX.sym("p", 3)
    function, of = hoist("f", [x], [p], [x[0] * x[1]])
    assert of.size_out(0) == (0, 1)
    assert float(function(AT[0], of(AT[1]))) == AT[0][0] * AT[0][1]


def test_structural_zeros_are_numbers():
    x, p = ca.SX.sym("x", 2), ca.SX.sym("p", 3)
    function, of = hoist("f", [x], [p], [ca.SX(2, 2), p[0] * x[0]])
    zeros, value = function(AT[0], of(AT[1]))
    assert zeros.nnz() == 4
    assert not np.any(np.array(zeros))
    assert float(value) == AT[1][0] * AT[0][0]
