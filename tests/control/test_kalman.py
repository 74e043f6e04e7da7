"""The extended Kalman filter against its textbook form, moving-horizon estimation and its own intervals."""

import casadi as ca
import numpy as np
import pytest
from scipy.linalg import solve_discrete_are
from scipy.optimize import least_squares
from test_estimators import A, B, C, D, functions, linear

from chargetune.control.control_step import begin, control_step, problem_of
from chargetune.control.controller import Controller
from chargetune.control.kalman import ExtendedKalman
from chargetune.episode.compiled import simulate
from chargetune.episode.filter_trace import filter_trace
from chargetune.episode.stepwise import run_episode
from chargetune.model.model import Model, Signal
from chargetune.model.parameter_space import Parameter, ParameterSpace
from chargetune.plants.faults import Fault, FaultKind, Faulty
from chargetune.plants.sensors import Sensors
from chargetune.plants.simulated import SimulatedPlant

SD, PROCESS, START = (0.1, 0.2), (0.02, 0.03), (1.0, 2.0)


def run(estimator, own, measurements, inputs, p=(), start=None):
    """Estimates and `FilterMemory` after each measurement; inputs[k] is applied between the measurements k and k + 1."""
    correct, predict = functions(estimator, own)
    memory = estimator.initial(own, np.zeros(len(own.states)) if start is None else start)
    last, out = 0.0, []
    for y, u in zip(measurements, inputs, strict=True):
        x_hat, corrected = correct(memory, y, last, p)
        out.append((np.array(x_hat).ravel(), estimator.memory(own, np.array(corrected).ravel())))
        memory, last = np.array(predict(x_hat, corrected, u, p)).ravel(), u
    return out


@pytest.mark.parametrize("measured", [("y",), ("y", "w")])
@pytest.mark.parametrize("iterations", [1, 3])
def test_it_is_the_textbook_filter_on_a_linear_system(measured, iterations):
    own, count = linear(), len(measured)
    estimator = ExtendedKalman(measured, SD[:count], PROCESS, START, iterations=iterations)
    rng = np.random.default_rng(0)
    measurements, inputs = rng.normal(size=(20, count)), rng.normal(size=20)
    x, covariance, last = np.array([0.5, -0.5]), np.diag(np.square(START)), 0.0
    c, d, noise = C[:count], D[:count], np.diag(np.square(SD[:count]))
    for (x_hat, memory), y, u in zip(run(estimator, own, measurements, inputs, start=x), measurements, inputs, strict=True):
        gain = covariance @ c.T @ np.linalg.inv(c @ covariance @ c.T + noise)
        x, covariance = x + gain @ (y - c @ x - d * last), (np.eye(2) - gain @ c) @ covariance
        np.testing.assert_allclose(x_hat, x, atol=1e-10)
        np.testing.assert_allclose(memory.covariance, covariance, atol=1e-10)
        x, covariance, last = A @ x + B * u, A @ covariance @ A.T + np.diag(np.square(PROCESS)), u


def test_its_covariance_settles_at_the_solution_of_the_riccati_equation():
    own = linear()
    rng = np.random.default_rng(1)
    found = run(ExtendedKalman(("y", "w"), SD, PROCESS, START), own, rng.normal(size=(300, 2)), rng.normal(size=300))
    ahead = solve_discrete_are(A.T, C.T, np.diag(np.square(PROCESS)), np.diag(np.square(SD)))
    gain = ahead @ C.T @ np.linalg.inv(C @ ahead @ C.T + np.diag(np.square(SD)))
    np.testing.assert_allclose(found[-1][1].covariance, ahead - gain @ C @ ahead, rtol=0, atol=1e-10)


def horizon_estimate(own, measurements, inputs, x0, covariance0):
    """Moving-horizon estimate of the last state: the states of a window as variables, with the arrival cost of its first one."""
    f, h = (lambda x, u: np.array(own.f(x, u, own.nominal)).ravel()), (lambda x, u: np.array(own.h(x, u, own.nominal)).ravel())
    root = np.linalg.inv(np.linalg.cholesky(covariance0))
    steps = len(measurements)

    def residuals(flat):
        states = flat.reshape(steps, -1)
        out = [root @ (states[0] - x0)]
        for k, y in enumerate(measurements):
            out.append((y - h(states[k], inputs[k - 1] if k else 0.0)) / SD)
            if k + 1 < steps:
                out.append((states[k + 1] - f(states[k], inputs[k])) / PROCESS)
        return np.concatenate(out)

    guess = [np.asarray(x0)]
    for u in inputs[: steps - 1]:
        guess.append(f(guess[-1], u))
    return least_squares(residuals, np.concatenate(guess), xtol=1e-15, ftol=1e-15, gtol=1e-15).x.reshape(steps, -1)[-1]


def test_moving_horizon_estimation_with_its_arrival_cost_is_the_same_on_a_linear_system():
    own, rng = linear(), np.random.default_rng(2)
    measurements, inputs = rng.normal(size=(12, 2)), rng.normal(size=12)
    estimator = ExtendedKalman(("y", "w"), SD, PROCESS, START)
    found = run(estimator, own, measurements, inputs)
    whole = horizon_estimate(own, measurements, inputs, np.zeros(2), np.diag(np.square(START)))
    np.testing.assert_allclose(found[-1][0], whole, atol=1e-7)
    # A window of five: its arrival cost is the filter's prediction of its first state.
    x, memory = found[6]
    ahead = A @ x + B * inputs[6], A @ memory.covariance @ A.T + np.diag(np.square(PROCESS))
    # The first measurement of a window has an input before it.
    shifted = measurements[7:] - np.vstack([D * inputs[6], np.zeros((4, 2))])
    np.testing.assert_allclose(found[-1][0], horizon_estimate(own, shifted, inputs[7:], *ahead), atol=1e-7)


def bent():
    """A state that hardly moves, seen through a cubic."""
    return Model.build(
        "bent",
        states=(Signal("a"), Signal("b")),
        inputs=(Signal("u"),),
        outputs=(Signal("y"), Signal("w")),
        parameters={},
        sampling_time_s=1.0,
        equations=lambda x, u, p: (
            {"a": x["a"] + 0.1 * u["u"], "b": 0.9 * x["b"]},
            {"y": x["a"] + 0.5 * x["a"] ** 3, "w": x["b"] + 0.1 * x["a"]},
        ),
    )


def test_iterations_are_those_of_gauss_newton_on_a_bent_output():
    own, measurement = bent(), [4.0 + 0.5 * 64.0, 0.0]
    once, often = (run(ExtendedKalman(("y", "w"), SD, PROCESS, (2.0, 1.0), iterations=n), own, [measurement], [0.0]) for n in (1, 20))
    exact = horizon_estimate(own, [measurement], [0.0], np.zeros(2), np.diag([4.0, 1.0]))
    np.testing.assert_allclose(often[0][0], exact, atol=1e-6)
    assert abs(often[0][0][0] - 4.0) < 0.05
    assert abs(once[0][0][0] - 4.0) > 1.0


def test_a_sample_that_is_no_number_is_left_out_and_counted():
    own = linear()
    start = np.array([0.5, -0.5])
    both = ExtendedKalman(("y", "w"), SD, PROCESS, START)
    one = ExtendedKalman(("w",), SD[1:], PROCESS, START)
    x, memory = run(both, own, [[np.nan, 0.3]], [0.0], start=start)[0]
    other, alone = run(one, own, [[0.3]], [0.0], start=start)[0]
    np.testing.assert_allclose(x, other, atol=1e-12)
    np.testing.assert_allclose(memory.covariance, alone.covariance, atol=1e-12)
    np.testing.assert_array_equal(memory.lost, [1, 0])
    np.testing.assert_array_equal(memory.rejected, [0, 0])


def test_outliers_are_left_out_and_counted_and_what_lasts_is_taken():
    own = linear()
    gated, free = (ExtendedKalman(("y", "w"), SD, PROCESS, START, gate_sd=g, rejections_max=4) for g in (5.0, None))
    rng = np.random.default_rng(3)
    measurements = rng.normal(0, 0.1, size=(40, 2))
    spoilt = measurements.copy()
    spoilt[20, 0] = 50.0
    lost = measurements.copy()
    lost[20, 0] = np.nan
    a, b = (run(gated, own, values, np.zeros(40)) for values in (spoilt, lost))
    np.testing.assert_allclose(a[-1][0], b[-1][0], atol=1e-14)
    np.testing.assert_array_equal(a[-1][1].rejected, [1, 0])
    np.testing.assert_array_equal(b[-1][1].lost, [1, 0])
    # A plant that has changed for good: four samples are refused, those after them are not.
    changed = measurements.copy()
    changed[20:] += 5.0
    found, wanted = (run(e, own, changed, np.zeros(40)) for e in (gated, free))
    np.testing.assert_array_equal(found[30][1].rejected, [4, 4])
    assert np.linalg.norm(found[23][0] - wanted[23][0]) > 1.0
    assert np.linalg.norm(found[-1][0] - wanted[-1][0]) < 0.2 * np.linalg.norm(wanted[-1][0])


@pytest.mark.parametrize("iterations", [1, 3])
def test_on_the_side_that_is_believed_an_outlier_counts_as_one_at_the_gate(iterations):
    """The textbook filter, told the gate of the tenth sample; the next one beyond is taken whole. On the other side it is left out."""
    own, noise, c = linear(), SD[0] ** 2, C[:1]
    estimator = ExtendedKalman(("y",), SD[:1], PROCESS, START, gate_sd=5.0, rejections_max=1, believed="above", iterations=iterations)
    for sign in (1.0, -1.0):
        measurements = np.random.default_rng(0).normal(0, 0.1, size=(14, 1))
        measurements[[10, 11]] += 50.0 * sign
        x, covariance = np.zeros(2), np.diag(np.square(START))
        for k, (x_hat, memory) in enumerate(run(estimator, own, measurements, np.zeros(14))):
            variance = float((c @ covariance @ c.T)[0, 0] + noise)
            y = float((c @ x)[0]) + 5.0 * variance**0.5 if k == 10 else measurements[k, 0]
            if k != 10 or sign > 0:
                gain = (covariance @ c.T)[:, 0] / variance
                x, covariance = x + gain * (y - float((c @ x)[0])), (np.eye(2) - np.outer(gain, c)) @ covariance
            np.testing.assert_allclose(x_hat, x, atol=1e-9)
            np.testing.assert_allclose(memory.covariance, covariance, atol=1e-9)
            x, covariance = A @ x, A @ covariance @ A.T + np.diag(np.square(PROCESS))
        assert memory.rejected[0] == (sign < 0)


def settable(**values):
    return Model.build(
        "settable",
        states=(Signal("a"), Signal("b")),
        inputs=(Signal("u"),),
        outputs=(Signal("y"),),
        parameters=values,
        sampling_time_s=1.0,
        equations=lambda x, u, p: ({"a": x["a"] + 0.1 * x["b"] + u["u"], "b": 0.9 * x["b"]}, {"y": x["a"]}),
    )


def test_every_setting_may_be_a_run_time_value():
    values = {"noise": 0.1, "drift": 0.02, "first": 0.7, "gate": 3.0}
    own, rng = settable(**values), np.random.default_rng(4)
    measurements, inputs = rng.normal(size=(30, 1)), rng.normal(size=30)
    named = ExtendedKalman(("y",), ("noise",), ("drift", lambda p, u: 2 * p["drift"]), ("first", 1.0), gate_sd="gate")
    number = ExtendedKalman(("y",), (0.1,), (0.02, 0.04), (0.7, 1.0), gate_sd=3.0)
    correct, _ = functions(named, own)
    assert correct.size1_in(3) == 4
    a, b = (run(e, own, measurements, inputs, own.nominal) for e in (named, number))
    assert a[-1][1].rejected[0] > 0
    for (x, one), (other_x, other) in zip(a, b, strict=True):
        np.testing.assert_allclose(x, other_x, atol=1e-12)
        np.testing.assert_allclose(one.covariance, other.covariance, atol=1e-12)


def tuned_controller(estimator, *, theta=True):
    """It holds position a at a target; theta is in every setting of the filter."""
    own = settable(noise=0.1, drift=0.02, first=0.7, gate=4.0)
    names = tuple(own.parameter_blocks)
    space = ParameterSpace(tuple(Parameter(n, 1e-3, 10.0, float(v[0]), scale="log") for n, v in own.parameters) if theta else ())
    return Controller.build(
        own,
        space,
        horizon=4,
        stage_cost=lambda s: (s.x["a"] - 1.0) ** 2 + 0.1 * s.u["u"] ** 2,
        input_lower={"u": -1.0},
        input_upper={"u": 1.0},
        parameters=lambda s: {n: s.theta[n] for n in names} if theta else {},
        estimator=estimator,
    )


NAMED = ExtendedKalman(("y",), ("noise",), ("drift", "drift"), ("first", "first"), gate_sd="gate")


def test_theta_in_the_filter_acts_compiled_as_well_as_step_by_step():
    own = tuned_controller(NAMED)
    plant = SimulatedPlant(settable(noise=1.0, drift=1.0, first=1.0, gate=1.0), {"a": 0.3, "b": 0.5}, Sensors({"y": 0.1}), {"b": 0.05})
    theta = [0.05, 0.1, 0.4, 2.0]
    steps = run_episode(own, plant, steps=30, theta=theta, seed=1)
    whole = simulate(own, plant, steps=30, theta=theta, seed=1)
    np.testing.assert_allclose(steps.input, whole.input, atol=1e-6)
    np.testing.assert_allclose(steps.estimate, whole.estimate, atol=1e-6)
    fixed = tuned_controller(ExtendedKalman(("y",), (0.05,), (0.1, 0.1), (0.4, 0.4), gate_sd=2.0), theta=False)
    np.testing.assert_allclose(simulate(fixed, plant, steps=30, seed=1).estimate, whole.estimate, atol=1e-6)
    assert np.max(np.abs(simulate(own, plant, steps=30, seed=1).estimate - whole.estimate)) > 1e-3


def test_the_trace_of_a_filter_is_what_it_did():
    own = tuned_controller(NAMED)
    faults = [Fault(FaultKind.MISSING, 5, 6, ("y",)), Fault(FaultKind.SPIKE, 20, 20, ("y",), 100.0)]
    plant = Faulty(SimulatedPlant(own.model, {"a": 0.3}, Sensors({"y": 0.1}), {"b": 0.05}), faults)
    episode = run_episode(own, plant, steps=30, seed=2)
    trace = filter_trace(own, episode)
    np.testing.assert_allclose(trace.estimate, episode.estimate, atol=1e-9)
    assert (trace.lost.tolist(), trace.rejected.tolist()) == ([2], [1])
    assert np.all(trace.sd > 0)


def test_the_trace_of_a_filter_under_given_signals_and_an_input_before():
    """A gain that a given signal moves in time; at rest the plant had an input."""
    model = settable(noise=0.1, drift=0.05, first=0.3, gate=50.0)
    own = Controller.build(
        model, ParameterSpace(()), horizon=4, stage_cost=lambda s: (s.x["a"] - 1.0) ** 2 + 0.1 * s.u["u"] ** 2,
        input_lower={"u": -1.0}, input_upper={"u": 1.0}, parameters=lambda s: {"drift": s.given["wind"], "noise": 2.0 * s.given["wind"]},
        given=(Signal("wind"),), estimator=NAMED, input_before={"u": 0.4},
    )  # fmt: skip
    wind = {"wind": 0.05 + 0.04 * np.sin(np.arange(30.0))}
    plant = SimulatedPlant(model, {"a": 0.3}, Sensors({"y": 0.1}), {"b": 0.05}, input_before={"u": 0.4})
    episode = run_episode(own, plant, steps=30, seed=2, given=wind)
    np.testing.assert_allclose(filter_trace(own, episode, given=wind).estimate, episode.estimate, atol=1e-9)
    assert np.max(np.abs(filter_trace(own, episode, given={"wind": 0.05}).estimate - episode.estimate)) > 1e-4
    with pytest.raises(ValueError, match="given: missing"):
        filter_trace(own, episode)


def test_nine_of_ten_intervals_hold_the_true_state():
    """On plants that the model matches, linear and bent, with the filter's own noise."""
    held = []
    for own in (linear(), bent()):
        f, h = own.f, own.h
        estimator = ExtendedKalman(("y", "w"), SD, PROCESS, (0.3, 0.3), gate_sd=5.0)
        for seed in range(40):
            rng = np.random.default_rng(seed)
            inputs, x = rng.normal(0, 0.3, 40), rng.normal(0, 0.3, 2)
            measurements, states = [], []
            last = 0.0
            for u in inputs:
                states.append(x)
                measurements.append(np.array(h(x, last, [])).ravel() + rng.normal(0, SD))
                x, last = np.array(f(x, u, [])).ravel() + rng.normal(0, PROCESS), u
            for (x_hat, memory), true in zip(run(estimator, own, measurements, inputs), states, strict=True):
                held.append(np.abs(true - x_hat) <= 1.645 * np.sqrt(np.diag(memory.covariance)))
    assert 0.85 <= np.mean(held) <= 0.95


def test_the_first_measurement_sets_a_state():
    own = bent()
    set_a = ExtendedKalman(("y", "w"), SD, PROCESS, START, first=lambda y, p: {"a": y["y"] / 3})
    told = ExtendedKalman(("y", "w"), SD, PROCESS, START)
    values = [[3.0, 0.2], [2.5, 0.1]]
    a, b = run(set_a, own, values, [0.1, 0.2]), run(told, own, values, [0.1, 0.2], start=[1.0, 0.0])
    np.testing.assert_allclose(a[-1][0], b[-1][0], atol=1e-12)
    blind = run(set_a, own, [[np.nan, 0.2]], [0.1], start=[7.0, 0.0])
    assert blind[0][0][0] == pytest.approx(7.0, abs=1.0)


def test_the_covariance_stays_positive_over_a_long_time_of_exact_samples():
    own = linear()
    found = run(ExtendedKalman(("y", "w"), (1e-9, 1e-9), (1e-3, 0.0), (1e3, 1e3)), own, np.zeros((400, 2)), np.zeros(400))
    for _, memory in found:
        assert np.min(np.linalg.eigvalsh(memory.covariance)) > -1e-20


def test_the_memory_is_part_of_a_control_step():
    own = tuned_controller(NAMED)
    step = control_step(problem_of(own))
    assert step.size1_in(0) == begin(own).estimator.size == 2 + 3 + 1 + 3


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: ExtendedKalman(("q",), (0.1,), (0, 0), (1, 1)).signals(linear()), ["'q'", "y, w"]),
        (lambda: ExtendedKalman(("y",), (0.1,), (0,), (1, 1)).signals(linear()), ["process_sd", "1 value,"]),
        (lambda: ExtendedKalman(("y",), (0.1, 0.2), (0, 0), (1, 1)), ["measurement_sd", "2 values"]),
        (lambda: ExtendedKalman(("y", "y"), (0.1, 0.2), (0, 0), (1, 1)), ["measured", "different names"]),
        (lambda: ExtendedKalman(("y",), (0.0,), (0, 0), (1, 1)), ["measurement_sd", "> 0"]),
        (lambda: ExtendedKalman(("y",), (0.1,), (-1, 0), (1, 1)), ["process_sd", ">= 0"]),
        (lambda: ExtendedKalman(("y",), (0.1,), (1, 0), (float("nan"), 1)), ["start_sd", ">= 0"]),
        (lambda: ExtendedKalman(("y",), (0.1,), (0, 0), (1, 1), gate_sd=0.0), ["gate_sd", "> 0"]),
        (lambda: ExtendedKalman(("y",), (0.1,), (0, 0), (1, 1), believed="up"), ["believed = 'up'", "'above', 'below' or None"]),
        (lambda: ExtendedKalman(("y",), (0.1,), (0, 0), (1, 1), iterations=0), ["iterations = 0", ">= 1"]),
        (lambda: ExtendedKalman(("y",), (0.1,), (0, 0), (1, 1), rejections_max=True), ["rejections_max = True", ">= 1"]),
        (lambda: ExtendedKalman(("y",), (0.1,), ("drift", 0), (1, 1)).signals(linear()), ["process_sd", "'drift'", "scalar parameters"]),
        (lambda: ExtendedKalman((), (), (0, 0), (1, 1)), ["measurement_sd"]),
        (lambda: ExtendedKalman.of(linear(), measurement_sd={"z": 1.0}, process_sd={}, start_sd={}), ["'z'", "y, w"]),
        (lambda: ExtendedKalman.of(linear(), measurement_sd={"y": 1.0}, process_sd={"y": 1.0}, start_sd={}), ["process_sd", "a, b"]),
        (
            lambda: run(ExtendedKalman(("y",), (0.1,), (0, 0), (1, 1), first=lambda y, p: {"z": 0.0}), linear(), [[0.0]], [0.0]),
            ["'z'", "a, b"],
        ),
    ],
)
def test_refusals(make, words):
    with pytest.raises(ValueError) as refused:  # noqa: PT011 - the words are what is tested
        make()
    assert all(word in str(refused.value) for word in words)


def test_settings_by_name_are_in_the_order_of_the_model():
    found = ExtendedKalman.of(linear(), measurement_sd={"w": 0.2}, process_sd={"b": 0.1}, start_sd={"a": 3.0}, gate_sd=5.0)
    assert found == ExtendedKalman(("w",), (0.2,), (0.0, 0.1), (3.0, 0.0), gate_sd=5.0)
    assert isinstance(found.memory(linear(), ca.SX.sym("m", 9)).x, ca.SX)
