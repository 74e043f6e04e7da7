"""Model, its names, and the Runge-Kutta step."""

import pickle

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from chargetune.model.integrators import rk4
from chargetune.model.model import Model, Named, Signal

GOOD = {
    "states": (Signal("a", "m"), Signal("b")),
    "inputs": (Signal("u"),),
    "outputs": (Signal("y"),),
    "parameters": {"gain": 2.0, "table": [1.0, 2.0]},
    "sampling_time_s": 0.5,
    "equations": lambda x, u, p: ({"a": x["a"] + p["gain"] * u["u"], "b": x["b"] + p["table"][1]}, {"y": x["a"] * p["table"][0]}),
}


def test_equations_become_functions_of_numbers():
    own = Model.build("m", **GOOD)
    np.testing.assert_array_equal(np.array(own.f([1.0, 5.0], 3.0, own.nominal)).ravel(), [7.0, 7.0])
    assert float(own.h([4.0, 0.0], 0.0, own.nominal)) == 4.0
    assert own.parameter_blocks == {"gain": 1, "table": 2}
    other = own.with_parameters(table=[10.0, 20.0])
    assert float(other.h([4.0, 0.0], 0.0, other.nominal)) == 40.0
    assert own.nominal.tolist() == [2.0, 1.0, 2.0]


def test_a_model_crosses_processes():
    own = pickle.loads(pickle.dumps(Model.build("m", **GOOD)))  # noqa: S301 - what was pickled a moment ago
    np.testing.assert_array_equal(np.array(own.f([1.0, 5.0], 3.0, own.nominal)).ravel(), [7.0, 7.0])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"sampling_time_s": 0.0}, ["sampling_time_s = 0.0", "> 0"]),
        ({"sampling_time_s": -1.0}, ["sampling_time_s = -1.0"]),
        ({"sampling_time_s": np.nan}, ["sampling_time_s = nan"]),
        ({"sampling_time_s": True}, ["sampling_time_s = True"]),
        ({"parameters": {"gain": np.inf, "table": [1.0, 2.0]}}, ["gain", "finite"]),
        ({"equations": lambda x, _, __: ({"a": x["a"]}, {"y": 0})}, ["missing b; expected exactly a, b"]),
        ({"equations": lambda x, _, __: ({"a": 0, "b": 0, "c": 0}, {"y": x["a"]})}, ["unknown c"]),
        ({"equations": lambda x, _, __: ({"a": 0, "b": 0}, {})}, ["outputs", "missing y"]),
        ({"states": (Signal("a"), Signal("a"))}, ["states"]),
    ],
)
def test_build_refuses(change, words):
    with pytest.raises(ValueError) as refused:  # noqa: PT011 - the words are what is tested
        Model.build("m", **{**GOOD, **change})
    assert all(word in str(refused.value) for word in words), refused.value


@pytest.mark.parametrize("name", ["", "two words", "1st", "a-b"])
def test_signal_names_are_identifiers(name):
    with pytest.raises(ValueError, match="signal name"):
        Signal(name)


def test_unknown_names_are_told():
    named = Named({"a": 1, "b": 2}, ca.SX.sym("v", 3))
    assert (list(named), len(named), named["b"].shape) == (["a", "b"], 2, (2, 1))
    with pytest.raises(KeyError, match=r"'c'.*a, b"):
        named["c"]
    with pytest.raises(ValueError, match="3 rows, expected 2"):
        Named({"a": 2}, ca.SX.sym("v", 3))
    own = Model.build("m", **GOOD)
    with pytest.raises(ValueError, match=r"unknown parameter 'gian'.*gain, table"):
        own.with_parameters(gian=1.0)
    with pytest.raises(ValueError, match=r"table has shape \(3,\), expected \(2,\)"):
        own.with_parameters(table=[1.0, 2.0, 3.0])


def test_runge_kutta_is_of_fourth_order():
    def rate(x):
        return np.array([x[1], -np.sin(x[0]) - 0.1 * x[1]])

    start = np.array([1.0, 0.5])
    exact = solve_ivp(lambda _, x: rate(x), (0, 2), start, rtol=1e-12, atol=1e-12).y[:, -1]
    errors = [np.max(np.abs(rk4(rate, start, 2.0, n) - exact)) for n in (4, 8, 16, 32)]
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    assert np.all((orders > 3.7) & (orders < 4.5)), orders
    with pytest.raises(ValueError, match="substeps = 0"):
        rk4(rate, start, 1.0, 0)
