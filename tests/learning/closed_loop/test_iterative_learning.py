"""IterativeLearning steps: slopes against finite differences, what they reach on exact plants, and the tuner under noise."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from chargetune.battery.cell.cell import default_cell
from chargetune.battery.cell.plating import Anode
from chargetune.battery.cell.thermal import Thermal
from chargetune.battery.charging.kalman import Kalman
from chargetune.battery.charging.problem import Backoff, ChargingProblem, ResistanceRatio
from chargetune.battery.charging.tunables import LimitBackoff
from chargetune.battery.charging.twin_loop import ChargingTwin
from chargetune.learning import IterativeLearning
from chargetune.learning.closed_loop.covering import _rolled, covering, predicted_rows
from chargetune.plants.sensors import Sensors

pytestmark = pytest.mark.usefixtures("virtual_machine")

CELL = default_cell()


def charge(**changes):
    return ChargingProblem(CELL, mismatch_seed=1, **changes)


def trial(number, theta, score, episode):
    return SimpleNamespace(number=number, theta=tuple(theta), status="done", score=score, episode=lambda: episode)


@pytest.mark.parametrize(
    "problem",
    [
        charge(ratios=(ResistanceRatio("R0"),)),
        charge(ratios=(ResistanceRatio("R1"),)),  # theta moves the propagated overpotential as well
        charge(backoff=Backoff(nodes=5)),
        charge(ratios=(ResistanceRatio("R1"),), kalman=Kalman()),
    ],
    ids=["R0", "R1", "backoff", "R1 with a filter"],
)
def test_slopes_along_a_trace_are_those_of_finite_differences(problem):
    episode, theta = problem.episode(), problem.space.default
    _, slopes = predicted_rows(problem.controller, episode, theta)
    for i in (0, problem.space.dimension - 1):
        step = np.zeros(problem.space.dimension)
        step[i] = 1e-5
        ahead, behind = (predicted_rows(problem.controller, episode, theta + s * step)[0] for s in (1, -1))
        np.testing.assert_allclose(slopes[..., i], (ahead - behind) / 2e-5, atol=5e-5)


@pytest.mark.parametrize(
    ("problem", "straight"),
    [(charge(backoff=Backoff(nodes=5)), True), (charge(ratios=(ResistanceRatio("R1"),)), False)],
    ids=["backoff", "R1"],
)
def test_rows_that_are_called_linear_in_theta_are(problem, straight):
    """A second linear program would say nothing new of them; of a resistance that the estimator works with it does."""
    episode, theta = problem.episode(), problem.space.default
    assert _rolled(problem.controller).straight is straight
    ahead = theta + 0.3 * (problem.space.upper - theta)
    rows, slopes = predicted_rows(problem.controller, episode, theta)
    off = predicted_rows(problem.controller, episode, ahead)[0] - (rows + slopes @ (ahead - theta))
    assert bool(np.nanmax(np.abs(off)) < 1e-12) is straight


def test_predictions_at_the_recorded_theta_are_the_controllers_own():
    """Where the controller rode its limit, its predicted row is 0: by the solver, not by this module."""
    problem = charge(backoff=Backoff(nodes=5))
    theta = np.full(5, 0.05)
    episode = problem.episode(theta)
    rows, _ = predicted_rows(problem.controller, episode, theta)
    riding = (episode.input[:, 0] < 0.99 * problem.current_max_A) & (np.arange(len(episode)) > 5)
    assert riding.sum() > 100
    assert np.max(np.abs(np.max(rows[riding, :, 0], axis=1))) < 1e-4


@pytest.mark.parametrize(
    ("parts", "attainable"),
    # Minutes that 4000 evaluations of CMA-ES reach on these plants.
    [
        ({"ratios": (ResistanceRatio("R0", 0.1, 4.0),)}, 36.7),
        ({"ratios": (ResistanceRatio("R1"),)}, 36.8),
        ({"backoff": Backoff(lower_V=0.0)}, 41.4),
    ],
    ids=["R0", "R1", "backoff"],
)
def test_a_few_steps_ride_the_limit_of_an_exact_plant(parts, attainable):
    problem = charge(**parts)
    theta = problem.space.default
    assert problem.score(problem.episode()).metrics["overshoot_mV"] > 60
    for _ in range(5):
        episode = problem.episode(theta)
        theta = covering(problem.controller, episode, theta, problem.measured_rows(episode))
    metrics = problem.score(problem.episode(theta)).metrics
    assert metrics["overshoot_mV"] < 1.0
    assert metrics["t95_min"] < 1.02 * attainable


def test_every_limit_that_holds_the_controller_back_is_covered():
    """Voltage, temperature and anode potential, far apart in their units, each with a backoff that was far too large."""
    warm = replace(
        CELL,
        thermal=Thermal(heat_capacity_J_K=45.0, cooling_W_K=0.1),
        anode=Anode((0.0, 1.0), (0.25, 0.05), (0.02, 0.02)),
    )
    parts = (LimitBackoff("temperature", -5.0, 10.0), LimitBackoff("anode", -0.1, 0.1, nodes=3))
    problem = ChargingProblem(warm, mismatch_seed=1, backoff=Backoff(), limit_backoffs=parts, temperature_max_K=308.0, anode_min_V=0.0)
    theta = problem.space.upper
    slow = problem.score(problem.episode(theta))
    assert slow.metrics["t80_min"] is None
    for _ in range(6):
        episode = problem.episode(theta)
        theta = covering(problem.controller, episode, theta, problem.measured_rows(episode))
    verdict = problem.score(problem.episode(theta))
    assert verdict.metrics["overshoot_mV"] < 1.0
    assert verdict.excess["temperature_max_K"] < 0.05
    assert verdict.excess["anode_min_V"] < 1e-3
    # The controller's model of both is exact, so it needs no backoff, and one of them is ridden.
    assert max(verdict.excess["temperature_max_K"] / 0.1, verdict.excess["anode_min_V"] / 1e-3) > -1
    assert verdict.metrics["t80_min"] < 40


def test_what_no_sample_asks_for_stays():
    problem = charge(backoff=Backoff(nodes=5))
    short = problem.episode(np.full(5, 0.02)).cut(30, problem.episode().ending, "")
    moved = covering(problem.controller, short, np.full(5, 0.02), problem.measured_rows(short))
    assert moved[-1] == pytest.approx(0.02)
    with pytest.raises(ValueError, match="nothing to cover"):
        covering(problem.controller, short, moved, np.full((30, 2, 2), np.nan))


def test_the_tuner_learns_under_noise_without_a_model_of_the_plant():
    noisy = charge(ratios=(ResistanceRatio("R0", 0.1, 4.0),), sensors=Sensors(noise_sd={"voltage_V": 0.002}), verdict_samples=5)
    exact = replace(noisy, sensors=Sensors())
    tuner, trials = IterativeLearning(ChargingTwin(noisy)), []
    for number in range(4):
        theta = tuner.ask(noisy.space, trials)[0]
        score, episode, _ = noisy(theta, number)
        trials.append(trial(number, theta, score, episode))
    np.testing.assert_array_equal(trials[0].theta, noisy.space.default)
    metrics = exact.score(exact.episode(trials[-1].theta)).metrics
    assert metrics["overshoot_mV"] < 5.0
    assert metrics["t95_min"] < 1.3 * 36.7


def test_a_trace_with_holes_is_bridged():
    problem = charge(ratios=(ResistanceRatio("R0", 0.1, 4.0),))
    episode = problem.episode()
    holes = episode.output_start.copy()
    holes[::4, 0] = np.nan
    theta = IterativeLearning(ChargingTwin(problem)).ask(
        problem.space, [trial(0, problem.space.default, None, replace(episode, output_start=holes))]
    )[0]
    whole = IterativeLearning(ChargingTwin(problem)).ask(problem.space, [trial(0, problem.space.default, None, episode)])[0]
    assert np.all(np.isfinite(theta))
    np.testing.assert_allclose(theta, whole, atol=0.15)


@pytest.mark.parametrize(
    ("given", "said"), [({"relax": 0.0}, "relax = 0.0"), ({"relax": 1.5}, "relax = 1.5"), ({"window": 2}, "window = 2")]
)
def test_nonsense_is_refused_by_name(given, said):
    with pytest.raises(ValueError, match="iterative learning") as caught:
        IterativeLearning(ChargingTwin(charge(ratios=(ResistanceRatio("R0"),))), **given)
    assert said in str(caught.value)


def test_a_step_that_cannot_be_found_is_warned_of_and_theta_stays():
    """HiGHS takes what is beyond 1e20 for infinite."""
    problem = charge(ratios=(ResistanceRatio("R0"),), steps=60)
    episode, theta = problem.episode(), problem.space.default
    with pytest.warns(RuntimeWarning, match="has no solution, theta stays"):
        np.testing.assert_array_equal(covering(problem.controller, episode, theta, problem.measured_rows(episode) + 1e25), theta)
