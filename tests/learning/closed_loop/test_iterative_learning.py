"""IterativeLearning steps: slopes against finite differences, what they reach on exact plants, and the tuner under noise."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from chargetune.battery.cell.cell import default_cell
from chargetune.battery.cell.plating import Anode
from chargetune.battery.cell.thermal import Thermal
from chargetune.battery.charging.controller import controller_of, measured_rows
from chargetune.battery.charging.evaluate import evaluate, run_charge
from chargetune.battery.charging.kalman import Kalman
from chargetune.battery.charging.settings import SensorSettings
from chargetune.battery.charging.tunables import Backoff, LimitBackoff, ResistanceRatio
from chargetune.battery.charging.twin_loop import ChargingTwin
from chargetune.battery.charging.verdict import score_episode
from chargetune.learning import IterativeLearning
from chargetune.learning.closed_loop.covering import _rolled, covering, predicted_rows
from chargetune.model.model import Signal
from charging_problems import changed, charging_problem

pytestmark = pytest.mark.usefixtures("virtual_machine")

CELL = default_cell()


def charge(**changes):
    return charging_problem(CELL, mismatch_seed=1, **changes)


def trial(number, theta, score, episode):
    return SimpleNamespace(number=number, theta=tuple(theta), status="done", score=score, episode=lambda: episode)


@pytest.mark.parametrize(
    "problem",
    [
        charge(R0=ResistanceRatio()),
        charge(R1=ResistanceRatio()),  # theta moves the propagated overpotential as well
        charge(backoff=Backoff(nodes=5)),
        charge(R1=ResistanceRatio(), kalman=Kalman()),
    ],
    ids=["R0", "R1", "backoff", "R1 with a filter"],
)
def test_slopes_along_a_trace_are_those_of_finite_differences(problem):
    episode, theta = run_charge(problem), problem.space.default
    _, slopes = predicted_rows(controller_of(problem), episode, theta)
    for i in (0, problem.space.dimension - 1):
        step = np.zeros(problem.space.dimension)
        step[i] = 1e-5
        ahead, behind = (predicted_rows(controller_of(problem), episode, theta + s * step)[0] for s in (1, -1))
        np.testing.assert_allclose(slopes[..., i], (ahead - behind) / 2e-5, atol=5e-5)


@pytest.mark.parametrize(
    ("problem", "straight"),
    [(charge(backoff=Backoff(nodes=5)), True), (charge(R1=ResistanceRatio()), False)],
    ids=["backoff", "R1"],
)
def test_rows_that_are_called_linear_in_theta_are(problem, straight):
    """A second linear program would say nothing new of them; of a resistance that the estimator works with it does."""
    episode, theta = run_charge(problem), problem.space.default
    assert _rolled(controller_of(problem)).straight is straight
    ahead = theta + 0.3 * (problem.space.upper - theta)
    rows, slopes = predicted_rows(controller_of(problem), episode, theta)
    off = predicted_rows(controller_of(problem), episode, ahead)[0] - (rows + slopes @ (ahead - theta))
    assert bool(np.nanmax(np.abs(off)) < 1e-12) is straight


def test_predictions_at_the_recorded_theta_are_the_controllers_own():
    """Where the controller rode its limit, its predicted row is 0: by the solver, not by this module."""
    problem = charge(backoff=Backoff(nodes=5))
    theta = np.full(5, 0.05)
    episode = run_charge(problem, theta)
    rows, _ = predicted_rows(controller_of(problem), episode, theta)
    riding = (episode.input[:, 0] < 0.99 * problem.current_max_A) & (np.arange(len(episode)) > 5)
    assert riding.sum() > 100
    assert np.max(np.abs(np.max(rows[riding, :, 0], axis=1))) < 1e-4


@pytest.mark.parametrize(
    ("parts", "attainable"),
    # Minutes that 4000 evaluations of CMA-ES reach on these plants.
    [
        ({"R0": ResistanceRatio(0.1, 4.0)}, 36.7),
        ({"R1": ResistanceRatio()}, 36.8),
        ({"backoff": Backoff(lower_V=0.0)}, 41.4),
    ],
    ids=["R0", "R1", "backoff"],
)
def test_a_few_steps_ride_the_limit_of_an_exact_plant(parts, attainable):
    problem = charge(**parts)
    theta = problem.space.default
    assert score_episode(problem, run_charge(problem)).metrics["overshoot_mV"] > 60
    for _ in range(5):
        episode = run_charge(problem, theta)
        theta = covering(controller_of(problem), episode, theta, measured_rows(problem, episode))
    metrics = score_episode(problem, run_charge(problem, theta)).metrics
    assert metrics["overshoot_mV"] < 1.0
    assert metrics["t95_min"] < 1.02 * attainable


def test_every_limit_that_holds_the_controller_back_is_covered():
    """Voltage, temperature and anode potential, far apart in their units, each with a backoff that was far too large."""
    warm = replace(
        CELL,
        thermal=Thermal(heat_capacity_J_K=45.0, cooling_W_K=0.1),
        anode=Anode((0.0, 1.0), (0.25, 0.05), (0.02, 0.02)),
    )
    parts = {"temperature_backoff": LimitBackoff(-5.0, 10.0), "anode_backoff": LimitBackoff(-0.1, 0.1, nodes=3)}
    problem = charging_problem(warm, mismatch_seed=1, backoff=Backoff(), **parts, temperature_max_K=308.0, anode_min_V=0.0)
    theta = problem.space.upper
    slow = score_episode(problem, run_charge(problem, theta))
    assert slow.metrics["t80_min"] is None
    for _ in range(6):
        episode = run_charge(problem, theta)
        theta = covering(controller_of(problem), episode, theta, measured_rows(problem, episode))
    verdict = score_episode(problem, run_charge(problem, theta))
    assert verdict.metrics["overshoot_mV"] < 1.0
    assert verdict.excess["temperature_max_K"] < 0.05
    assert verdict.excess["anode_min_V"] < 1e-3
    # The controller's model of both is exact, so it needs no backoff, and one of them is ridden.
    assert max(verdict.excess["temperature_max_K"] / 0.1, verdict.excess["anode_min_V"] / 1e-3) > -1
    assert verdict.metrics["t80_min"] < 40


def test_what_no_sample_asks_for_stays():
    problem = charge(backoff=Backoff(nodes=5))
    short = run_charge(problem, np.full(5, 0.02)).cut(30, run_charge(problem).ending, "")
    moved = covering(controller_of(problem), short, np.full(5, 0.02), measured_rows(problem, short))
    assert moved[-1] == pytest.approx(0.02)
    with pytest.raises(ValueError, match="nothing to cover"):
        covering(controller_of(problem), short, moved, np.full((30, 2, 2), np.nan))


def test_the_tuner_learns_under_noise_without_a_model_of_the_plant():
    noisy = charge(R0=ResistanceRatio(0.1, 4.0), voltage_noise_sd_V=0.002, verdict_samples=5)
    exact = changed(noisy, sensors=SensorSettings())
    tuner, trials = IterativeLearning(ChargingTwin(noisy)), []
    for number in range(4):
        theta = tuner.ask(noisy.space, trials)[0]
        score, episode, _ = evaluate(noisy, theta, number)
        trials.append(trial(number, theta, score, episode))
    np.testing.assert_array_equal(trials[0].theta, noisy.space.default)
    metrics = score_episode(exact, run_charge(exact, trials[-1].theta)).metrics
    assert metrics["overshoot_mV"] < 5.0
    assert metrics["t95_min"] < 1.3 * 36.7


def test_a_trace_with_holes_is_bridged():
    problem = charge(R0=ResistanceRatio(0.1, 4.0))
    episode = run_charge(problem)
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
        IterativeLearning(ChargingTwin(charge(R0=ResistanceRatio())), **given)
    assert said in str(caught.value)


def test_a_controller_with_given_signals_is_refused():
    problem = charge(R0=ResistanceRatio())
    told = SimpleNamespace(controller=replace(controller_of(problem), given=(Signal("price"),)))
    with pytest.raises(ValueError, match="given = price, allowed is none"):
        IterativeLearning(told)


def test_a_step_that_cannot_be_found_is_warned_of_and_theta_stays():
    """HiGHS takes what is beyond 1e20 for infinite."""
    problem = charge(R0=ResistanceRatio(), steps=60)
    episode, theta = run_charge(problem), problem.space.default
    with pytest.warns(RuntimeWarning, match="has no solution, theta stays"):
        np.testing.assert_array_equal(covering(controller_of(problem), episode, theta, measured_rows(problem, episode) + 1e25), theta)
