"""The scale of the discrepancy, against closed forms and on plants that are and are not what was stated."""

import numpy as np
import pytest
from scipy.stats import norm
from toy_loop import NOISE, SPACE, Plant, ToyLoop, structural

from chargetune.learning.twin.calibration import SCALES, PredictionCheck, check_prediction, scale_quantile
from chargetune.learning.twin.ensemble import condition
from chargetune.learning.twin.settings import TwinSettings

pytestmark = pytest.mark.usefixtures("virtual_machine")

STEP = SCALES[1] / SCALES[0]
SHARES = (0.1, 0.3, 0.5, 0.7, 0.84)


def test_before_anything_was_checked_scales_are_quantiles_of_the_prior():
    for sd in (0.3, 0.8):
        found = [scale_quantile((), sd, share) for share in SHARES]
        np.testing.assert_allclose(found, np.exp(sd * norm.ppf(SHARES)), rtol=STEP - 1)
    assert scale_quantile((), 1e-3, 0.9) == pytest.approx(1.0)


@pytest.mark.parametrize("true", [0.5, 1.0, 3.0])
def test_scales_are_quantiles_of_the_closed_form_posterior(true):
    """n errors r ~ N(0, s^2): for a wide prior n mean(r^2) / s^2 is chi-squared, ln s nearly N(ln rms, 1 / (2 n))."""
    n, sd = 60, 20.0
    errors = true * np.random.default_rng(3).standard_normal(n)
    likelihood = -0.5 * (n * np.log(SCALES**2) + np.sum(errors**2) / SCALES**2)
    parts = [PredictionCheck(share * likelihood, 0.0) for share in (0.25, 0.75)]
    found = [scale_quantile(parts, sd, share) for share in SHARES]
    expected = np.sqrt(np.mean(errors**2)) * np.exp(norm.ppf(SHARES) / np.sqrt(2 * n))
    np.testing.assert_allclose(found, expected, rtol=1.2 * (STEP - 1))


def test_a_prior_and_a_likelihood_of_gaussian_shape_multiply():
    """ln s ~ N(0, 0.5^2), and a likelihood exp(-(ln s - 1)^2 / (2 0.4^2))."""
    likelihood = -0.5 * ((np.log(SCALES) - 1.0) / 0.4) ** 2
    precision = 1 / 0.5**2 + 1 / 0.4**2
    mean, sd = 1.0 / 0.4**2 / precision, precision**-0.5
    found = [scale_quantile([PredictionCheck(likelihood, 0.0)], 0.5, share) for share in SHARES]
    np.testing.assert_allclose(found, np.exp(mean + sd * norm.ppf(SHARES)), rtol=STEP - 1)


def checked(plant, levels, following, floor=1e-3):
    loop = ToyLoop(discrepancy_sd_floor={"gauge": floor})
    trials = [plant.trial(k, np.full(3, level)) for k, level in enumerate(levels)]
    return check_prediction(condition(loop, trials).discrepancy, plant.episode(np.full(3, following), 77))


def test_the_scale_grows_with_what_was_not_predicted():
    right, wrong = (checked(plant, (3.0,), 1.6) for plant in (Plant(), Plant(unmodelled=structural)))
    medians = [scale_quantile([one], 1.0, 0.5) for one in (right, wrong)]
    assert medians[0] < 1.5 < medians[1]
    assert right.standardised_error < 2.0 < wrong.standardised_error


def test_a_repeat_says_nothing_of_elsewhere():
    """A plant that the twin cannot be, the newest theta tried again: it comes out as before, and what is not known stays so."""
    check = checked(Plant(unmodelled=structural), (3.0, 1.6), 1.6)
    assert check.standardised_error < 1.5
    for share in SHARES:
        assert scale_quantile([check], 1.0, share) == pytest.approx(scale_quantile((), 1.0, share), rel=0.25)


def test_repeats_do_not_make_what_was_learnt_of_the_scale_forgotten():
    plant = Plant(unmodelled=structural)
    trials = [plant.trial(k, np.full(3, level)) for k, level in enumerate((3.0, 1.6, 1.6, 1.6, 1.6, 1.6))]
    scales = [scale_quantile(condition(ToyLoop(), trials[:n]).learnt.checks, 1.0, 0.5) for n in (2, 6)]
    assert scales[0] > 1.5
    assert scales[1] > 0.7 * scales[0]


def test_an_episode_of_which_nothing_was_measured_says_nothing():
    loop, trial = ToyLoop(), Plant().trial(0, SPACE.upper)
    episode = Plant().episode(SPACE.upper, 5)
    for side in (episode.output_start, episode.output_end):
        side[:, 1] = np.nan
    found = check_prediction(condition(loop, [trial]).discrepancy, episode)
    assert found.standardised_error == 0.0
    np.testing.assert_array_equal(found.log_likelihood, 0.0)


def test_the_likelihood_is_largest_at_the_scale_that_errors_were_drawn_with():
    """Simulated: the true plant is a sample of the process with a known scale; the posterior of several such checks has it."""
    loop = ToyLoop(discrepancy_sd_floor={"gauge": 0.01})
    trial = Plant().trial(0, SPACE.upper)
    found = condition(loop, [trial], TwinSettings()).discrepancy
    for true in (0.4, 3.0):
        plants = found.samples(np.tile(found.posterior.mode, (40, 1)), true, range(100, 140))
        episodes = loop.simulate([(np.full(3, 1.4), found.posterior.mode, error) for error in plants])
        noise = np.random.default_rng(0)
        for episode in episodes:
            for side in (episode.output_start, episode.output_end):
                side[:, 1] += NOISE * noise.standard_normal(len(side))
        scale = scale_quantile([check_prediction(found, e) for e in episodes], 10.0, 0.5)
        assert true / 1.4 < scale < 1.4 * true
