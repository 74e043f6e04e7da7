"""Windows of a charge: times against the metrics, excess against the trace, smoothing against a regression and Monte Carlo."""

from dataclasses import replace

import numpy as np
import pytest

from chargetune.battery.cell.cell import default_cell
from chargetune.battery.charging.evaluate import run_charge
from chargetune.battery.charging.soc_windows import ChargingWindows, smoothed
from chargetune.battery.charging.tunables import Backoff, ResistanceRatio
from chargetune.battery.charging.verdict import score_episode
from chargetune.battery.studies.open_study import make_tuner
from chargetune.learning import Composite
from charging_problems import changed, charging_problem

NOISE_V = 2e-3
PROBLEM = charging_problem(default_cell(), mismatch_seed=1, charge_time_to_soc=0.95, backoff=Backoff(lower_V=0.0, upper_V=0.2))
NOISY = changed(PROBLEM, voltage_noise_sd_V=NOISE_V, verdict_samples=5)


def ends(episode):
    return np.stack(episode.signal("voltage_V"), axis=1)


@pytest.mark.parametrize("wanted", [0.95, 0.83, 0.5])
def test_the_time_to_an_soc_is_the_sum_over_the_windows(wanted):
    windows = ChargingWindows(changed(PROBLEM, charge_time_to_soc=wanted))
    episode = run_charge(PROBLEM)
    rate, counts = windows.window_outputs(episode).rate, windows.costs > 0
    seconds = np.sum((windows.costs * windows.widths / rate)[counts])
    assert wanted in windows.edges
    assert -seconds / windows.duration_s == pytest.approx(score_episode(windows.problem, episode).objective, rel=1e-3)


def test_without_a_wanted_soc_the_windows_give_the_mean_squared_lack_of_charge():
    problem = changed(PROBLEM, charge_time_to_soc=None)
    windows, episode = ChargingWindows(problem, windows=50), run_charge(problem)
    rate = windows.window_outputs(episode).rate
    done = np.isfinite(rate)
    cost = np.sum((windows.costs * windows.widths / rate)[done]) / windows.duration_s
    assert -cost == pytest.approx(score_episode(problem, episode).objective, rel=2e-2)


def test_the_excess_of_a_window_is_the_worst_in_the_trace():
    windows, episode = ChargingWindows(PROBLEM), run_charge(PROBLEM)
    passage = windows.window_outputs(episode)
    _, soc = episode.signal("soc")
    worst = ends(episode).max(axis=1) - 4.2
    for b, (low, high) in enumerate(zip(windows.edges[:-1], windows.edges[1:], strict=True)):
        assert passage.excess[0, b] == pytest.approx(worst[(soc >= low) & (soc < high)].max(), abs=1e-12)
    assert passage.excess.shape == passage.spread.shape == (2, len(windows.widths))


def test_a_charge_that_gets_stuck_leaves_the_last_windows_open():
    windows = ChargingWindows(PROBLEM)
    episode = run_charge(PROBLEM, np.full(7, 0.15))
    last = episode.signal("soc")[1][-1]
    assert last < 0.9
    passage = windows.window_outputs(episode)
    beyond = windows.edges[:-1] > last
    assert np.isnan(passage.rate[beyond]).all()
    assert np.isnan(passage.excess[:, beyond]).all()
    stuck = int(np.searchsorted(windows.edges, last)) - 1
    # The window it is stuck in was passed as slowly as that.
    assert 0 < passage.rate[stuck] < 0.2 * passage.rate[stuck - 3]
    assert np.isfinite(passage.rate[:stuck]).all()


def test_smoothing_is_a_local_regression_on_time_and_current():
    episode = run_charge(NOISY, np.full(7, 0.02), 3)
    _, soc = episode.signal("soc")
    current, k = episode.input[:, 0], 40
    out, factor = smoothed(ends(episode), current, soc)
    near = np.flatnonzero((np.abs(np.arange(len(soc)) - k) <= 5) | (np.abs(soc - soc[k]) <= 0.025))
    t = np.concatenate([near - k, near - k + 1]).astype(float)
    rows = np.column_stack([np.ones_like(t), t, t**2, t**3, np.tile(current[near], 2)])
    values = np.concatenate([ends(episode)[near, 0], ends(episode)[near, 1]])
    found = np.linalg.lstsq(rows / np.abs(rows).max(axis=0), values, rcond=None)[0] / np.abs(rows).max(axis=0)
    at = np.array([[1, 0, 0, 0, current[k]], [1, 1, 1, 1, current[k]]])
    np.testing.assert_allclose(out[k], at @ found, atol=2e-5)
    covariance = at @ np.linalg.pinv(rows.T @ rows) @ at.T
    np.testing.assert_allclose(factor[k], np.sqrt(np.diag(covariance)), rtol=2e-2)


def test_smoothed_noise_is_as_large_as_stated_and_corners_stay_sharp():
    clean = run_charge(PROBLEM, np.full(7, 0.04))
    _, soc = clean.signal("soc")
    current, draw = clean.input[:, 0], np.random.default_rng(0)
    exact, factor = smoothed(ends(clean), current, soc)
    # Within a millivolt at the switch from constant current to constant voltage, where a moving mean is several off.
    near = ends(clean) > 4.14
    assert np.max(np.abs(exact - ends(clean))[near]) < 2e-3
    assert np.sqrt(np.mean((exact - ends(clean))[near] ** 2)) < 3e-4
    noisy = [smoothed(ends(clean) + NOISE_V * draw.standard_normal(exact.shape), current, soc)[0] for _ in range(60)]
    np.testing.assert_allclose(np.sqrt(np.mean(np.var(noisy, axis=0))), NOISE_V * np.sqrt(np.mean(factor**2)), rtol=0.05)


def test_a_sample_that_is_missing_is_left_out():
    episode = run_charge(NOISY, np.full(7, 0.02), 3)
    start = episode.output_start.copy()
    start[100, episode.output_names.index("voltage_V")] = np.nan
    whole, holed = (ChargingWindows(NOISY).window_outputs(e) for e in (episode, replace(episode, output_start=start)))
    np.testing.assert_allclose(holed.excess, whole.excess, atol=2e-3)
    assert np.isfinite(holed.excess).all()


def test_the_tuner_is_made_by_its_name_and_improves_the_charge():
    problem = changed(NOISY, R0=ResistanceRatio(0.5, 2.0, scale=True), backoff=None)
    tuner = make_tuner("composite", 0, problem)
    assert isinstance(tuner, Composite)
    theta = tuner.ask(problem.space, [])
    np.testing.assert_allclose(theta, [problem.space.default])


@pytest.mark.parametrize("windows", [1, 101, 2.5, True])
def test_refuses_windows_that_are_none(windows):
    with pytest.raises((ValueError, TypeError), match="windows"):
        ChargingWindows(PROBLEM, windows=windows)
