"""Estimators against their textbook forms."""

import casadi as ca
import numpy as np
import pytest

from chargetune.control.estimators import ExactState, Propagated
from chargetune.model.model import Model, Signal

A = np.array([[1.0, 0.1], [-0.2, 0.9]])
B = np.array([0.05, 0.1])
C = np.array([[1.0, 0.3], [0.2, -1.0]])
D = np.array([0.5, 0.1])


def linear():
    def equations(x, u, p):
        after = ca.mtimes(ca.DM(A), x.vector) + ca.DM(B) * u["u"]
        out = ca.mtimes(ca.DM(C), x.vector) + ca.DM(D) * u["u"]
        return {"a": after[0], "b": after[1]}, {"y": out[0], "w": out[1]}

    return Model.build(
        "linear",
        states=(Signal("a"), Signal("b")),
        inputs=(Signal("u"),),
        outputs=(Signal("y"), Signal("w")),
        parameters={},
        sampling_time_s=1.0,
        equations=equations,
    )


def functions(estimator, own):
    names = estimator.signals(own)
    memory = ca.SX.sym("m", estimator.initial(own, np.zeros(2)).size)
    y, u, x, p = ca.SX.sym("y", len(names)), ca.SX.sym("u", 1), ca.SX.sym("x", 2), ca.SX.sym("p", own.nominal.size)
    x_hat, corrected = estimator.correct(own, memory, {n: y[i] for i, n in enumerate(names)}, u, p)
    correct = ca.Function("correct", [memory, y, u, p], [x_hat, corrected])
    return correct, ca.Function("predict", [x, memory, u, p], [estimator.predict(own, x, memory, u, p)])


def test_propagated_states_follow_the_model_and_measured_ones_the_plant():
    own = linear()
    estimator = Propagated(("a",))
    correct, predict = functions(estimator, own)
    memory = estimator.initial(own, np.array([0.0, 1.0]))
    x_hat, corrected = correct(memory, [3.0], 0.0, [])
    np.testing.assert_array_equal(np.array(x_hat).ravel(), [3.0, 1.0])
    ahead = np.array(predict(x_hat, corrected, 0.7, [])).ravel()
    np.testing.assert_allclose(ahead, A @ [3.0, 1.0] + B * 0.7)
    blind, _ = correct(ahead, [np.nan], 0.7, [])
    np.testing.assert_allclose(np.array(blind).ravel(), ahead)


def test_exact_state_is_what_was_measured():
    own = linear()
    correct, _ = functions(ExactState(), own)
    np.testing.assert_array_equal(np.array(correct([], [1.0, 2.0], 0.0, [])[0]).ravel(), [1.0, 2.0])


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Propagated(("z",)).signals(linear()), ["'z'", "a, b"]),
    ],
)
def test_refusals(make, words):
    with pytest.raises(ValueError) as refused:  # noqa: PT011 - the words are what is tested
        make()
    assert all(word in str(refused.value) for word in words)
