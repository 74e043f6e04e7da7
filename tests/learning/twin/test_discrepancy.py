"""What a twin cannot represent: learnt where it was seen, doubted where it was not; and the ensemble's coverage."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from scipy.linalg import cho_factor, cho_solve
from toy_loop import NOISE, SPACE, UNKNOWNS, Plant, ToyLoop, holed, structural

from chargetune.learning.black_box.gaussian_process import SurrogateWarning
from chargetune.learning.twin.discrepancy import Discrepancy, _fit, _Part, _part
from chargetune.learning.twin.ensemble import condition
from chargetune.learning.twin.settings import TwinSettings

pytestmark = pytest.mark.usefixtures("virtual_machine")

WRONG = Plant(unmodelled=structural)
WITH_SWIRL = ToyLoop(noise_sd={"gauge": NOISE, "swirl": NOISE}, discrepancy_sd_floor={"gauge": 1e-3, "swirl": 1e-3})


def conditioned(levels, plant=WRONG, loop=None, seed=0, **settings):
    """The ensemble after trials with all entries of theta at these levels, and the trials."""
    trials = [plant.trial(k, np.full(3, level), seed) for k, level in enumerate(levels)]
    return condition(loop or ToyLoop(), trials, TwinSettings(**settings)), trials


def drawn_gauges(ensemble, episode):
    """On the plants of the ensemble at the recorded inputs of an episode, shape (plants, K, 2)."""
    return np.array([np.stack(e.signal("gauge"), axis=1) for e in ensemble.replayed(episode, 3).episodes])


@pytest.mark.parametrize("plant", [Plant(), WRONG], ids=["of the model", "structural"])
def test_intervals_cover_the_next_trial(plant):
    """90 % intervals of noisy samples of a third theta, after two others, cover at least 85 % of them, and are not vain."""
    covered, width = [], []
    for seed in range(4):
        ensemble, _ = conditioned((3.0, 2.0), plant, seed=seed)
        following = plant.episode(np.full(3, 1.6), 1000 + seed)
        gauges = drawn_gauges(ensemble, following)
        spread = np.sqrt(gauges.var(axis=0) + NOISE**2)
        off = np.stack(following.signal("gauge"), axis=1) - gauges.mean(axis=0)
        covered.append(np.mean(np.abs(off) < 1.645 * spread))
        width.append(np.mean(spread))
    assert np.mean(covered) > 0.85
    assert np.mean(width) < 6 * NOISE


def test_what_was_measured_is_reproduced_by_every_drawn_plant():
    ensemble, trials = conditioned((3.0, 1.6))
    true = np.stack(WRONG.episode(np.full(3, 1.6)).signal("gauge"), axis=1)
    off = np.sqrt(np.mean((drawn_gauges(ensemble, trials[-1].episode()) - true) ** 2, axis=(1, 2)))
    assert np.max(off) < 3 * NOISE


def test_it_is_so_although_a_feature_is_predicted_wrongly():
    """A swirl that is three times what the model has: data and samples are looked up at the same, predicted, swirl."""

    @dataclass(frozen=True)
    class Swirling(ToyLoop):
        @property
        def features(self):
            return {"level": (0.0, 1.0), "swirl": (0.0, 0.3), "inflow": (0.0, 1.0)}

    wild = Plant(gain=0.3, unmodelled=structural)
    loop = Swirling(UNKNOWNS[:1], WITH_SWIRL.noise_sd, WITH_SWIRL.discrepancy_sd_floor)
    ensemble, trials = conditioned((3.0, 1.6), wild, loop)
    true = np.stack(wild.episode(np.full(3, 1.6)).signal("gauge"), axis=1)
    off = np.sqrt(np.mean((drawn_gauges(ensemble, trials[-1].episode()) - true) ** 2, axis=(1, 2)))
    assert np.max(off) < 4 * NOISE


def test_a_sample_is_surer_where_something_was_measured():
    ensemble, trials = conditioned((3.0,))
    near = drawn_gauges(ensemble, trials[0].episode()).std(axis=0).mean()
    far = drawn_gauges(ensemble, WRONG.episode(np.full(3, 1.3), 5)).std(axis=0).mean()
    assert far > 3 * near


def test_the_error_of_a_state_does_not_jump_with_the_input():
    ensemble, _ = conditioned((3.0, 2.0), loop=WITH_SWIRL)
    found = ensemble.discrepancy
    (sample,) = found.samples(found.posterior.mode[None], 1.0, [3])
    tables = dict(zip(found.lookup_table.outputs, (t.reshape(found.lookup_table.counts) for t in sample.table), strict=True))
    steps = {name: np.max(np.abs(np.diff(table, axis=1))) for name, table in tables.items()}
    assert steps["swirl"] < 1e-2 * np.ptp(tables["swirl"])
    assert steps["gauge"] > 0.05 * np.ptp(tables["gauge"])


@pytest.mark.parametrize("where", [slice(20, 40), slice(None)], ids=["for a while", "never"])
def test_a_gap_in_an_output_is_bridged(where):
    """A sensor that fails for a third of a trial, or for all of it, beside another that goes on."""
    trial = WRONG.trial(0, SPACE.upper)
    lost = replace(trial, episode=lambda: holed(trial.episode(), "swirl", where))
    mean = condition(WITH_SWIRL, [lost]).discrepancy
    filled = mean.mean(mean.posterior.mode)(trial.episode())
    assert np.all(np.isfinite(filled.output_end))


def test_a_gap_in_a_feature_lies_between_its_neighbours_and_one_that_was_never_measured_is_named():
    trial = WRONG.trial(0, SPACE.upper)
    found = condition(ToyLoop(), [trial]).discrepancy
    bridged = found.signals(holed(trial.episode(), "level", slice(20, 30)))
    np.testing.assert_allclose(bridged, found.signals(trial.episode()), atol=0.02)
    never = holed(trial.episode(), "level", slice(None))
    with pytest.raises(ValueError, match="level was never measured in an episode of 60"):
        found.signals(never)


def test_a_feature_that_the_twin_predicts_is_taken_from_it_where_it_was_not_measured():
    @dataclass(frozen=True)
    class Swirling(ToyLoop):
        @property
        def features(self):
            return {"level": (0.0, 1.0), "inflow": (0.0, 1.0), "swirl": (0.0, 0.2)}

    loop = Swirling(noise_sd=WITH_SWIRL.noise_sd, discrepancy_sd_floor=WITH_SWIRL.discrepancy_sd_floor)
    trials = [Plant().trial(k, SPACE.upper) for k in range(1)]
    found = condition(loop, trials).discrepancy
    episode = trials[0].episode()
    predicted = found.signals(holed(episode, "swirl", slice(None)))
    np.testing.assert_allclose(predicted, found.signals(episode), atol=5 * NOISE)


def test_the_mean_is_that_of_textbook_algebra():
    """K W' (W K W' + N)^-1 r for the residuals r of the mode, with the nodes' covariance K that the process states."""
    ensemble, _trials = conditioned((3.0, 1.7))
    found = ensemble.discrepancy
    mode, data, (prior,) = found.posterior.mode, found.data, found.priors
    left = found._residuals(mode)[:, 0]
    expected = prior @ data.weights.T @ np.linalg.solve(data.weights @ prior @ data.weights.T + np.diag(data.variance[:, 0]), left)
    np.testing.assert_allclose(found.mean(mode).table[0], expected, atol=1e-3 * np.abs(expected).max())


@pytest.mark.parametrize(("scale", "own"), [(0.1, 0.0), (1.0, 0.0), (6.3, 0.0), (1.0, 0.3)])
def test_samples_have_the_mean_and_the_covariance_of_the_process_of_their_scale(scale, own):
    """Monte Carlo of 600 samples, against the covariance that is built and factorised directly; a sample has an own part of its own."""
    ensemble, _ = conditioned((3.0, 1.7), of_episode=own)
    found = ensemble.discrepancy
    prior, data, mode, ratio = scale**2 * found.priors[0], found.data, found.posterior.mode, found.fitted[0].ratio
    assert (ratio > 0) == (own > 0)
    of_one = np.where(data.episode[:, None] == data.episode, 1.0 + ratio, 1.0)
    seen = cho_factor(of_one * (data.weights @ prior @ data.weights.T) + np.diag(data.variance[:, 0]))
    gain = cho_solve(seen, data.weights @ prior).T
    weights = found.lookup_table.weights(found.at(WRONG.episode(np.full(3, 1.3), 1)))
    covariance = weights @ ((1.0 + ratio) * prior - gain @ data.weights @ prior) @ weights.T
    mean = weights @ gain @ found._residuals(mode)[:, 0]
    drawn = np.array([s.table[0] @ weights.T for s in found.samples(np.tile(mode, (600, 1)), scale, range(600))])
    sd = np.sqrt(np.diag(covariance))
    assert np.max(np.abs(drawn.mean(axis=0) - mean) / sd) < 5 / np.sqrt(600)
    np.testing.assert_allclose(np.cov(drawn.T), covariance, atol=0.25 * sd.max() ** 2)
    np.testing.assert_allclose(np.trace(np.cov(drawn.T)), np.trace(covariance), rtol=0.2)


def test_samples_of_several_plants_are_those_of_one_after_the_other():
    found = conditioned((3.0, 1.7))[0].discrepancy
    unknowns = found.posterior.draw(4, 0)
    together = found.samples(unknowns, 2.0, [7, 8, 9, 10])
    for m, seed, one in zip(unknowns, [7, 8, 9, 10], together, strict=True):
        (alone,) = found.samples(m[None], 2.0, [seed])
        np.testing.assert_allclose(one.table, alone.table, atol=1e-12)


@pytest.mark.parametrize(("seed", "ratio"), [(0, 0.0), (1, 0.0), (2, 0.4)])
def test_variances_of_every_scale_are_those_of_directly_built_covariances(seed, ratio):
    draw = np.random.default_rng(seed)
    nodes, count, ahead = 12, 7, 9
    half = draw.standard_normal((nodes, nodes))
    prior = half @ half.T / nodes + 0.1 * np.eye(nodes)
    weights, other = (draw.dirichlet(np.ones(nodes), n) for n in (count, ahead))
    variance = draw.uniform(0.01, 0.2, count)
    scales = np.array([0.1, 0.7, 1.0, 3.0, 10.0])
    together = (np.arange(count)[:, None] // 3 == np.arange(count) // 3).astype(float)
    found = _part(prior, ratio, variance, weights, together).variances(other, scales)
    for scale, own in zip(scales, found, strict=True):
        k = scale**2 * prior
        seen = cho_factor(weights @ k @ weights.T * (1.0 + ratio * together) + np.diag(variance))
        expected = np.diag(other @ ((1.0 + ratio) * k - k @ weights.T @ cho_solve(seen, weights @ k)) @ other.T)
        np.testing.assert_allclose(own, expected, rtol=1e-5)
        # And those of the part that samples of this scale are drawn by.
        part = _part(k, ratio, variance, weights, together)
        np.testing.assert_allclose(np.sum((other @ part.root) ** 2, axis=1), expected, rtol=1e-5)


def test_what_is_of_an_episode_is_drawn_anew():
    """Each episode has an error of 0.03 of its own sign. Without an own part every plant has that of the traces, and is sure of it."""
    signs = np.random.default_rng(1).choice([-1.0, 1.0], 5)
    trials = [Plant(unmodelled=lambda level, _, s=s: 0.03 * s + 0.0 * level).trial(k, np.full(3, 2.0)) for k, s in enumerate(signs)]
    for own, least, most in ((0.1, 0.02, 0.1), (0.0, 0.0, 0.005)):
        learnt = condition(ToyLoop(), trials, TwinSettings(of_episode=own)).learnt
        found = learnt.discrepancy
        weights = found.lookup_table.weights(found.at(trials[0].episode()))
        drawn = [weights @ one.table[0] for one in found.samples(np.tile(found.posterior.mode, (64, 1)), learnt.scale, range(64))]
        assert least <= np.mean(np.std(drawn, axis=0)) < most, own


def test_a_factor_of_a_covariance_that_rounding_left_indefinite():
    """What the data take away is a little more than there is: of 2 by 2, the eigenvalues 2 and -1e-6."""
    taken = np.array([[1e-6, 0.0], [0.0, 1e-6]])
    root = _Part(taken, np.ones((2, 2)), np.eye(2), np.ones(2), np.eye(2)).root
    np.testing.assert_allclose(root @ root.T, np.ones((2, 2)), atol=2e-6)


def test_features_are_one_to_as_many_as_have_a_length_scale():
    ensemble, trials = conditioned((3.0,))
    with pytest.raises(ValueError, match="allowed are 1 to 3"):
        Discrepancy(ensemble.discrepancy.posterior, (trials[0].episode(),), {})


def test_where_no_hyperparameters_are_found_they_are_the_prior_medians_and_nothing_is_random():
    """A feature that is infinite has no likelihood. Matern 3/2 in closed form."""
    settings, draw = TwinSettings(), np.random.default_rng(0)
    x, left, variance = np.full((1, 20, 2), np.inf), draw.standard_normal((1, 20)), np.full((1, 20), 1e-4)
    nodes = draw.uniform(size=(1, 6, 2))
    before = torch.random.get_rng_state()
    with pytest.warns(SurrogateWarning, match="the discrepancy of the twin in 20 bins could not be fitted"):
        (found,) = _fit(x, np.zeros(20, dtype=int), left, variance, nodes, settings)
    assert torch.equal(torch.random.get_rng_state(), before)
    distance = np.sqrt(3.0) * np.linalg.norm((nodes[0, :, None] - nodes[0]) / settings.length_scales[:2], axis=-1)
    np.testing.assert_allclose(found.kernel, (1 + distance) * np.exp(-distance), atol=1e-6)
    assert found.variance == pytest.approx(np.mean(left**2))
