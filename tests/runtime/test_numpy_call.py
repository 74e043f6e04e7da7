"""What CasADi returns through NumPy's own memory is what it returns by its own."""

import casadi as ca
import numpy as np
import pytest

from chargetune.runtime.numpy_call import numpy_call


def test_results_are_those_of_the_function_with_a_row_for_each_column():
    a, b = ca.SX.sym("a", 2, 3), ca.SX.sym("b", 2)
    function = ca.Function("f", [a, b], [ca.mtimes(b.T, a), a + ca.repmat(b, 1, 3)])
    given, vector = np.arange(6.0).reshape(3, 2), np.array([10.0, 20.0])
    row, matrix = numpy_call(function, given, vector)
    expected = function(given.T, vector)
    assert np.array_equal(row, np.array(expected[0]).T)
    assert np.array_equal(matrix, given + vector)
    # Also of what is not stored row by row, and of whole numbers.
    again = numpy_call(function, np.asfortranarray(given), [10, 20])
    assert np.array_equal(again[1], matrix)


def test_arguments_of_no_numbers_are_allowed_and_too_few_are_not():
    a, b = ca.SX.sym("a", 0), ca.SX.sym("b", 2)
    function = ca.Function("f", [a, b], [2 * b, a])
    twice, nothing = numpy_call(function, np.zeros(0), [1.0, 2.0])
    assert np.array_equal(twice, [[2.0, 4.0]])
    assert nothing.size == 0
    with pytest.raises(RuntimeError, match=r"[Bb]uffer"):
        numpy_call(function, np.zeros(0), [1.0])
