"""What a twin cannot represent: learnt where it was seen, doubted where it was not; and the ensemble's coverage."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.stats import norm
from two_pairs import AnotherCell, TwoPairs

from chargetune.battery.cell.cell import default_cell
from chargetune.battery.cell.thermal import Thermal
from chargetune.battery.charging.evaluate import run_charge
from chargetune.battery.charging.tunables import ResistanceRatio
from chargetune.battery.charging.twin_loop import ChargingTwin
from chargetune.learning.black_box.gaussian_process import SurrogateWarning
from chargetune.learning.twin.calibration import SCALES, calibrate_scale
from chargetune.learning.twin.discrepancy import LENGTH, Discrepancy, _fit, _Part
from chargetune.learning.twin.ensemble import condition
from charging_problems import changed, charging_problem

CELL = default_cell()
WARM = replace(CELL, thermal=Thermal(heat_capacity_J_K=45.0, cooling_W_K=0.1))


def charge(seed=1, *, pairs=False, cell=CELL, **changes):
    return charging_problem(
        cell, mismatch_seed=seed, R0=ResistanceRatio(0.1, 4.0), voltage_noise_sd_V=0.002,
        plant=TwoPairs(cell) if pairs else None, **changes,
    )  # fmt: skip


def told(episode):
    return SimpleNamespace(episode=lambda: episode)


def beliefs(problem, ratios):
    episodes = [run_charge(problem, np.full(9, ratio), seed) for seed, ratio in enumerate(ratios)]
    return condition(ChargingTwin(problem), [told(e) for e in episodes]), episodes


def gap(episode, name, where):
    """The episode without the samples of one output at ``where``."""
    column, changed = episode.output_names.index(name), {}
    for side in ("output_start", "output_end"):
        changed[side] = getattr(episode, side).copy()
        changed[side][where, column] = np.nan
    return replace(episode, **changed)


def drawn_voltages(ensemble, episode, count=48):
    """Voltages at the recorded input of an episode on drawn plants, shape (count, K, 2)."""
    replayed = ensemble.replayed(episode, count, 3).episodes
    return np.array([np.stack(e.signal("voltage_V"), axis=1) for e in replayed])


@pytest.mark.parametrize("pairs", [False, True], ids=["a circuit", "a plant that the twin cannot be"])
def test_intervals_cover_the_next_trial(pairs):
    """90 % intervals of noisy samples of a third theta, after two others, cover 85 to 95 % of them."""
    covered = []
    for seed in range(4):
        problem = charge(seed, pairs=pairs)
        ensemble, _ = beliefs(problem, (4.0, 2.0))
        following = run_charge(problem, np.full(9, 1.6), 10)
        voltages = drawn_voltages(ensemble, following)
        spread = np.sqrt(voltages.var(axis=0) + 0.002**2)
        measured = np.stack(following.signal("voltage_V"), axis=1)
        covered.append(np.mean(np.abs(measured - voltages.mean(axis=0)) < 1.645 * spread))
    assert 0.85 < np.mean(covered) < 0.95


def test_what_was_measured_is_reproduced_by_every_drawn_plant():
    ensemble, episodes = beliefs(charge(pairs=True), (4.0, 1.6))
    true = np.stack(episodes[-1].signal("voltage_V", true=True), axis=1)
    off = np.sqrt(np.mean((drawn_voltages(ensemble, episodes[-1], 8) - true) ** 2, axis=(1, 2)))
    assert np.max(off) < 3.5e-3


def test_a_sample_is_surer_where_something_was_measured():
    ensemble, episodes = beliefs(charge(pairs=True), (4.0,))
    near = drawn_voltages(ensemble, episodes[0]).std(axis=0).mean()
    far = drawn_voltages(ensemble, run_charge(charge(pairs=True), np.full(9, 1.6), 5)).std(axis=0).mean()
    assert far > 3 * near


def test_between_the_nodes_of_a_coarse_table_a_sample_is_as_sure():
    """With three features the nodes are far from what was measured, and every sampled plant has to pass through it all the same."""
    ensemble, episodes = beliefs(charge(pairs=True, cell=WARM), (4.0,))
    near = drawn_voltages(ensemble, episodes[0]).std(axis=0).mean()
    far = drawn_voltages(ensemble, run_charge(charge(pairs=True, cell=WARM), np.full(9, 1.6), 5)).std(axis=0).mean()
    assert len(ensemble.loop.features) == 3
    assert far > 20 * near


def test_the_error_of_a_state_does_not_jump_with_the_input():
    ensemble, _ = beliefs(charge(pairs=True, cell=WARM), (4.0,))
    tables = {
        name: table.reshape(ensemble.discrepancy.lookup_table.counts)
        for name, table in zip(
            ensemble.discrepancy.lookup_table.outputs, ensemble.discrepancy.error(ensemble.posterior.mode, 3).table, strict=True
        )
    }
    steps = {name: np.max(np.abs(np.diff(table, axis=1))) for name, table in tables.items()}
    assert steps["temperature_K"] < 1e-3 * np.ptp(tables["temperature_K"])
    assert steps["voltage_V"] > 0.1 * np.ptp(tables["voltage_V"])


def test_a_temperature_at_its_limit_is_foretold():
    """The cell heats faster and cools better than its model, and its temperature was held at the limit once."""
    other = replace(CELL, thermal=Thermal(heat_capacity_J_K=38.0, cooling_W_K=0.13))
    problem = charge(pairs=False, cell=WARM, temperature_max_K=302.0, steps=240)
    problem = changed(problem, plant=AnotherCell(other))
    ensemble, episodes = beliefs(problem, (1.0,))
    highest = np.max(episodes[0].signal("temperature_K")[1])
    assert abs(highest - 302.0) < 0.1
    drawn = ensemble.predict(np.full(9, 1.0), 16, 0).episodes
    np.testing.assert_allclose([np.max(e.signal("temperature_K")[1]) for e in drawn], highest, rtol=0, atol=0.05)


@pytest.mark.parametrize(("name", "seen"), [("temperature_K", True), ("temperature_K", False), ("soc", True)])
def test_a_gap_in_a_feature_is_bridged(name, seen):
    """A sensor that fails for a third of a trial, or for all of it where the twin predicts what it measures."""
    problem = charge(cell=WARM)
    episode = run_charge(problem, np.full(9, 4.0), 0)
    holed = gap(episode, name, slice(100, 200) if seen else slice(None))
    whole, bridged = (
        Discrepancy(condition(ChargingTwin(problem), [told(e)]).posterior, (e,), ChargingTwin(problem).features) for e in (episode, holed)
    )
    off = np.abs(bridged.signals(holed) - whole.signals(episode)) / [1.0, 6.0, 35.0]
    assert np.max(off) < 0.05
    assert np.all(np.isfinite(bridged.error(bridged.posterior.mode)(holed).signal("voltage_V")[1]))


def test_a_feature_that_was_never_measured_is_named():
    problem = charge(cell=WARM)
    holed = gap(run_charge(problem, np.full(9, 4.0), 0), "soc", slice(None))
    with pytest.raises(ValueError, match="soc was never measured in an episode of"):
        condition(ChargingTwin(problem), [told(holed)] * 2)


def test_the_scale_grows_with_what_was_not_foretold():
    scales = []
    for pairs in (False, True):
        problem = charge(pairs=pairs)
        before, _ = beliefs(problem, (4.0,))
        scales.append(calibrate_scale([before.discrepancy.predicted_before(run_charge(problem, np.full(9, 1.6), 7))]))
    assert scales[0] < 2.0 < scales[1]


def test_a_repeat_says_nothing_of_elsewhere():
    """A plant that the twin cannot be, the newest theta tried again: it comes out as before, and what is not known stays so."""
    problem = charge(pairs=True)
    before, _ = beliefs(problem, (4.0, 1.6))
    predicted_before = before.discrepancy.predicted_before(run_charge(problem, np.full(9, 1.6), 7))
    assert predicted_before.standardised_error < 1.0
    for sure in (0.5, 0.84):
        # ln s ~ N(0, 1) as before: its quantile, on a grid of 8 %.
        assert calibrate_scale([predicted_before], sure) == pytest.approx(np.exp(norm.ppf(sure)), rel=0.1)


def test_repeats_do_not_make_what_was_learnt_of_the_scale_forgotten():
    """The second trial says that the errors are larger than stated; four repeats of it change that little."""
    problem = charge(pairs=True)
    ratios = (4.0, 1.6, 1.6, 1.6, 1.6, 1.6)
    trials = [told(run_charge(problem, np.full(9, ratio), seed)) for seed, ratio in enumerate(ratios)]
    loop = ChargingTwin(problem)
    scales = [condition(loop, trials[:n]).discrepancy.scale for n in (2, 6)]
    assert scales[0] > 2.0
    assert scales[1] > 0.7 * scales[0]


def test_a_factor_of_a_covariance_that_rounding_left_indefinite():
    """What the data take away is a little more than there is: of 2 by 2, the eigenvalues 2 and -1e-6."""
    taken = np.array([[1e-6, 0.0], [0.0, 1e-6]])
    root = _Part(taken, np.ones((2, 2)), np.eye(2)).root
    np.testing.assert_allclose(root @ root.T, np.ones((2, 2)), atol=2e-6)


@pytest.mark.usefixtures("virtual_machine")
def test_what_was_foretold_once_is_remembered_and_the_same_for_a_new_loop():
    problem = charge(steps=60)
    trials = [told(run_charge(problem, np.full(9, ratio), seed)) for seed, ratio in enumerate((4.0, 2.0, 1.6))]
    loop = ChargingTwin(problem)
    fits = []
    for n in (2, 3, 3):
        ensemble = condition(loop, trials[:n])
        fits.append(len(loop.twin.predicted_before))
    assert fits == [1, 2, 2]
    assert len(loop.twin.ways) == 3
    assert len(loop.twin.newest) == 1
    fresh = condition(ChargingTwin(problem), trials)
    assert fresh.discrepancy.scale == ensemble.discrepancy.scale
    assert fresh.standardised_error == ensemble.standardised_error
    np.testing.assert_array_equal(fresh.posterior.mode, ensemble.posterior.mode)


@pytest.mark.usefixtures("virtual_machine")
def test_before_a_trial_was_foretold_errors_may_be_as_large_as_the_prior_of_the_scale_says():
    problem = charge(steps=60)
    trials = [told(run_charge(problem, np.full(9, 4.0), 1))]
    scales = [condition(ChargingTwin(problem), trials, sure).discrepancy.scale for sure in (0.5, 0.84)]
    # The quantiles of exp(N(0, 1)) on a grid of 8 %.
    np.testing.assert_allclose(scales, [1.0, np.exp(norm.ppf(0.84))], rtol=0.08)


@pytest.mark.usefixtures("virtual_machine")
def test_features_are_one_to_three():
    ensemble, episodes = beliefs(charge(steps=60), (4.0,))
    with pytest.raises(ValueError, match="allowed are 1 to 3"):
        Discrepancy(ensemble.posterior, tuple(episodes), {})


@pytest.mark.usefixtures("virtual_machine")
@pytest.mark.parametrize("scale", [0.1, 1.0, 6.3])
def test_the_scale_is_inferred_of_what_it_is_applied_to(scale):
    """The variance that a scale is judged by is that of drawn errors with this scale: Monte Carlo, and through the table."""
    problem = charge(pairs=True, steps=90)
    ensemble, _ = beliefs(problem, (4.0,))
    episode = run_charge(problem, np.full(9, 1.6), 5)
    k = int(np.argmin(np.abs(SCALES - scale)))
    scaled = ensemble.discrepancy.scaled(1.0).scaled(SCALES[k])
    judged = ensemble.discrepancy.scaled(1.0)._off(episode).unmodelled[k, :, 0]
    weights = scaled.lookup_table.weights(scaled._at(episode))
    np.testing.assert_allclose(judged, scaled._parts[0].variance(weights), rtol=1e-6, atol=1e-14)
    drawn = np.array([error.table[0] @ weights.T for error in scaled.errors(np.tile(ensemble.posterior.mode, (600, 1)), range(600))])
    np.testing.assert_allclose(np.sum(drawn.var(axis=0)), np.sum(judged), rtol=0.25)


def test_where_no_hyperparameters_are_found_they_are_the_prior_medians_and_nothing_is_random():
    """A feature that is infinite has no likelihood. Matern 3/2 in closed form."""
    draw = np.random.default_rng(0)
    x, left, variance = np.full((1, 20, 2), np.inf), draw.standard_normal((1, 20)), np.full((1, 20), 1e-4)
    nodes = draw.uniform(size=(1, 6, 2))
    before = torch.random.get_rng_state()
    with pytest.warns(SurrogateWarning, match="the error of the twin in 20 stretches could not be fitted"):
        (found,) = _fit(x, left, variance, nodes)
    assert torch.equal(torch.random.get_rng_state(), before)
    distance = np.sqrt(3.0) * np.linalg.norm((nodes[0, :, None] - nodes[0]) / LENGTH[:2], axis=-1)
    np.testing.assert_allclose(found.kernel, (1 + distance) * np.exp(-distance), atol=1e-6)
    assert found.variance == pytest.approx(np.mean(left**2))
