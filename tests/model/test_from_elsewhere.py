"""Models that were written elsewhere: any CasADi function, and do-mpc."""

import warnings

import casadi as ca
import numpy as np
import pytest

from chargetune.model.do_mpc import from_do_mpc
from chargetune.model.model import Model, Signal

X, U, P = ca.MX.sym("x", 2), ca.MX.sym("u"), ca.MX.sym("p", 3)
# Of MX, which needs an expansion; p is a stiffness and two masses.
RATE = ca.Function("rate", [X, U, P], [ca.vertcat(X[1], (U - P[0] * X[0]) / (P[1] + P[2]))])
AHEAD = ca.Function("ahead", [X, U], [ca.vertcat(X[0] + 0.1 * X[1], 0.9 * X[1] + U)])
NAMES = {"states": ["place", "speed"], "inputs": [Signal("force", "N")], "sampling_time_s": 0.1}
VALUES = {"stiffness": 2.0, "masses": [1.0, 0.5]}


def test_continuous_function_is_integrated_as_by_cvodes():
    model = Model.from_casadi("swing", RATE, parameters=VALUES, continuous=True, substeps=4, **NAMES)
    x0, u, p = np.array([1.0, -0.5]), 0.7, np.array([2.0, 1.0, 0.5])
    exact = ca.integrator(
        "exact", "cvodes", {"x": X, "p": ca.vertcat(U, P), "ode": RATE(X, U, P)}, 0.0, 0.1, {"abstol": 1e-12, "reltol": 1e-12}
    )
    np.testing.assert_allclose(np.array(model.f(x0, u, p)), np.array(exact(x0=x0, p=np.r_[u, p])["xf"]), rtol=0, atol=1e-9)
    assert (model.output_names, model.parameter_blocks) == (("place", "speed"), {"stiffness": 1, "masses": 2})
    np.testing.assert_array_equal(model.nominal, p)


def test_discrete_function_and_outputs_are_taken_as_they_are():
    seen = ca.Function("seen", [X, U], [ca.vertcat(X[0] + U, X[1] ** 2)])
    model = Model.from_casadi("cart", AHEAD, seen, outputs=["gauge", "energy"], **NAMES)
    np.testing.assert_allclose(np.array(model.f([1.0, 2.0], 3.0, [])).ravel(), [1.2, 4.8])
    np.testing.assert_allclose(np.array(model.h([1.0, 2.0], 3.0, [])).ravel(), [4.0, 4.0])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"states": ["place"]}, ["f maps sizes [2, 1]", "[1, 1]"]),
        ({"parameters": {"mass": 1.0}}, ["f maps sizes [2, 1]", "[2, 1, 1]"]),
        ({"outputs": ["gauge", "energy"]}, ["outputs", "without h", "states"]),
        ({"h": ca.Function("h", [X, U], [X])}, None),
        ({"h": ca.Function("h", [X, U], [X[0]])}, ["h maps sizes [2, 1] to 1", "to 2"]),
        ({"states": ["place", "place"]}, ["states", "different names"]),
        ({"sampling_time_s": 0.0}, ["sampling_time_s = 0.0"]),
    ],
)
def test_functions_that_do_not_fit_are_refused(change, words):
    arguments = {"name": "cart", "f": AHEAD, **NAMES, **change}
    if words is None:
        assert Model.from_casadi(**arguments).output_names == ("place", "speed")
        return
    with pytest.raises(ValueError) as refused:  # noqa: PT011 - the words are what is tested
        Model.from_casadi(**arguments)
    assert all(word in str(refused.value) for word in words), refused.value


def test_an_integrator_within_is_refused_in_words():
    inner = ca.integrator("inner", "cvodes", {"x": X, "p": ca.vertcat(U, P), "ode": RATE(X, U, P)}, 0.0, 0.1)
    wrapped = ca.Function("wrapped", [X, U, P], [inner(x0=X, p=ca.vertcat(U, P))["xf"]])
    with pytest.raises(ValueError, match="cannot be written out in scalar operations"):
        Model.from_casadi("swing", wrapped, parameters=VALUES, **NAMES)


def tank(kind="continuous", *, algebraic=False):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        do_mpc = pytest.importorskip("do_mpc", reason="do-mpc is in the extra bench")
    model = do_mpc.model.Model(kind)
    levels, feed = model.set_variable("_x", "level", shape=(2, 1)), model.set_variable("_u", "feed")
    area, rain = model.set_variable("_p", "area"), model.set_variable("_tvp", "rain")
    if algebraic:
        flow = model.set_variable("_z", "flow")
        model.set_alg("flow", flow - levels[0])
    model.set_rhs("level", ca.vertcat((feed + rain - levels[0]) / area, levels[0] - 0.5 * levels[1] ** 2))
    model.set_meas("gauge", levels[1] + 0.1 * feed, meas_noise=True)
    model.setup()
    return model


@pytest.mark.parametrize("kind", ["continuous", "discrete"])
def test_model_of_do_mpc(kind):
    model = from_do_mpc(tank(kind), sampling_time_s=0.2, parameters={"area": 2.0, "rain": 0.1}, substeps=5)
    assert (model.state_names, model.input_names, model.output_names[:2]) == (("level_0", "level_1"), ("feed",), ("level_0", "level_1"))
    assert model.parameter_blocks == {"area": 1, "rain": 1}
    x, u = np.array([1.0, 0.5]), 0.3

    def rate(at):
        return np.array([(u + 0.1 - at[0]) / 2.0, at[0] - 0.5 * at[1] ** 2])

    wanted = rate(x)
    if kind == "continuous":
        wanted = x.copy()
        for _ in range(20000):
            wanted = wanted + 1e-5 * rate(wanted + 0.5e-5 * rate(wanted))
    np.testing.assert_allclose(np.array(model.f(x, u, model.nominal)).ravel(), wanted, rtol=0, atol=1e-8)
    assert float(model.h(x, u, model.nominal)[-1]) == pytest.approx(0.53)


def test_model_of_do_mpc_that_does_not_fit_is_refused():
    with pytest.raises(ValueError, match=r"parameters missing rain, unknown snow; expected exactly area, rain"):
        from_do_mpc(tank(), sampling_time_s=0.2, parameters={"area": 2.0, "snow": 0.0})
    with pytest.raises(ValueError, match=r"algebraic states \['flow'\]"):
        from_do_mpc(tank(algebraic=True), sampling_time_s=0.2, parameters={"area": 2.0, "rain": 0.1})
    with pytest.raises(ValueError, match=r"setup\(\) was not called"):
        from_do_mpc(object(), sampling_time_s=0.2, parameters={})
