"""Bounds that hold together against Monte Carlo, what a twin that is none says, and that nothing depends on what was learnt before."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from toy_loop import NOISE, SPACE, Failing, Plant, Told, ToyLoop

from chargetune.episode.score import Score
from chargetune.learning.twin.calibration import SCALES, PredictionCheck
from chargetune.learning.twin.ensemble import Ensemble, Learnt, Prediction, condition
from chargetune.learning.twin.settings import TwinSettings

pytestmark = pytest.mark.usefixtures("virtual_machine")


@dataclass(frozen=True)
class Windows:
    """An episode is its own excess by window, in tolerances beyond the tolerance."""

    def score(self, episode):
        known = [None if np.isnan(e) else 1e-3 * (1.0 + e) for e in episode]
        return Score(0.0, 0.0, {"limit": max(e for e in known if e is not None)}, {"limit": 1e-3}, profile={"limit": tuple(known)})


def prediction(excess, near=100.0):
    return Prediction(Windows(), tuple(excess), near)


@pytest.mark.parametrize("probability", [0.5, 0.9, 0.975])
@pytest.mark.parametrize("rank", [1, 3, 8])
def test_upper_bounds_hold_together_on_the_stated_share_of_the_plants(probability, rank):
    """Windows of any correlation, standard deviation and mean: the joint share of the plants that are within all of them."""
    draw = np.random.default_rng(rank)
    excess = draw.standard_normal((400, rank)) @ draw.standard_normal((rank, 8)) * draw.uniform(0.1, 5.0, 8) + draw.normal(0, 3, 8)
    upper = prediction(excess).upper_windows(probability)
    assert np.mean(np.all(excess <= upper + 1e-9, axis=1)) == pytest.approx(probability, abs=1.5 / 400)
    # As many standard deviations of each window.
    k = (upper - excess.mean(axis=0)) / excess.std(axis=0)
    np.testing.assert_allclose(k, k[0], rtol=1e-6)


def test_of_independent_windows_as_many_deviations_are_kept_as_they_need_together():
    """k with Phi(k)^8 = 0.9, and with a single window Phi(k) = 0.9."""
    draw = np.random.default_rng(0).standard_normal((20_000, 8))
    for windows, expected in ((8, 2.22), (1, 1.2816)):
        np.testing.assert_allclose(prediction(draw[:, :windows]).upper_windows(0.9), expected, atol=0.06)


def test_windows_far_below_their_limit_are_bounded_but_do_not_count():
    draw = np.random.default_rng(0).standard_normal((4000, 8))
    draw[:, 1:] -= 50.0
    upper = prediction(draw, near=3.0).upper_windows(0.9)
    np.testing.assert_allclose(upper[0], 1.28, atol=0.1)
    np.testing.assert_allclose(upper[1:], -50 + 1.28, atol=0.2)


def test_windows_that_few_plants_visit_have_no_bound():
    excess = np.random.default_rng(0).standard_normal((10, 3))
    excess[:6, 1], excess[:4, 2] = np.nan, np.nan
    upper = prediction(excess).upper_windows(0.9)
    np.testing.assert_array_equal(np.isnan(upper), [False, True, False])


def test_a_plant_whose_loop_fails_keeps_nothing():
    found = Prediction(Windows(), (np.array([-1.0]), None, np.array([0.5]), np.array([-0.1])), 3.0)
    assert found.probability() == 0.5
    assert len(found.scores) == 3


def test_members_fail_where_the_loop_does_and_the_others_do_not():
    loop = Failing(ToyLoop(), lambda theta: theta[0] > 2.0)
    ensemble = Ensemble(loop, Learnt(loop.twin, TwinSettings(plants=4), None))
    assert ensemble.predict(SPACE.upper, 0).probability() == 0.0
    assert ensemble.central(SPACE.upper) is None
    assert ensemble.central(SPACE.default) is not None


def flat(error):
    return PredictionCheck(np.zeros_like(SCALES), error)


def test_a_twin_is_none_where_the_newest_prediction_failed_or_no_scale_is_large_enough():
    settings = TwinSettings()
    most = settings.standardised_error_max

    def says(*checks):
        return Learnt(ToyLoop().twin, settings, None, checks).rejected

    assert says() == says(flat(1.0), flat(0.99 * most)) == says(flat(2 * most), flat(1.0)) == ""
    # One prediction alone rests on a single trace.
    assert says(flat(2 * most)) == ""
    assert f"{1.5 * most:.1f} stated standard deviations" in says(flat(1.0), flat(1.5 * most))
    beyond = PredictionCheck(np.where(np.arange(len(SCALES)) == len(SCALES) - 1, 0.0, -1e3), 1.0)
    assert "as large as stated" in says(beyond)


def test_without_a_trace_the_plants_are_those_of_the_prior():
    trials = [Told(0, tuple(SPACE.default), "failed"), Told(1, tuple(SPACE.default), "running")]
    ensemble = condition(ToyLoop(), trials)
    assert ensemble.discrepancy is None
    assert ensemble.learnt.checks == ()
    shares = [ensemble.predict(np.full(3, level), 0).probability() for level in (0.5, 1.0, 1.5, 3.0)]
    assert shares == sorted(shares)
    assert shares[0] < 0.2
    assert shares[-1] > 0.9


def test_plants_depend_on_seed_and_count_alone():
    ensemble = condition(ToyLoop(), [Plant().trial(0, SPACE.upper)])
    one, again, other = (ensemble.predict(SPACE.default, seed).excess for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, again)
    assert not np.array_equal(one, other)
    assert len(ensemble.predict(SPACE.default, 1, 7).episodes) == 7
    fresh = condition(ToyLoop(), [Plant().trial(0, SPACE.upper)])
    np.testing.assert_array_equal(fresh.predict(SPACE.default, 1).excess, one)
    drawn, anew = (ensemble.replayed(Plant().episode(SPACE.upper, 0), seed).excess for seed in (1, 2))
    assert not np.array_equal(drawn, anew)


def test_what_happened_is_known_better_than_what_would_happen():
    """Under recorded inputs the plants are as far apart as the noise leaves them; with a controller they are not closer."""
    trial = Plant().trial(0, np.full(3, 1.5))
    ensemble = condition(ToyLoop(), [trial])
    true = Plant().truth(trial.theta)
    replayed = ensemble.replayed(trial.episode(), 1)
    worst = np.array([s.excess["gauge"] for s in replayed.scores])
    assert abs(worst.mean() - true.excess["gauge"]) < 2 * NOISE
    assert worst.std() < NOISE


@pytest.mark.parametrize("own", [0.0, 0.1])
def test_what_was_learnt_before_changes_nothing_that_is_said(monkeypatch, own):
    """After more trials than it learns from, and after other studies have gone through the same memory."""
    plant, settings = Plant(), TwinSettings(traces=2, of_episode=own)
    trials = [plant.trial(k, np.full(3, level)) for k, level in enumerate((3.0, 2.5, 2.0, 1.7))]
    for n in (1, 2, 3, 4):
        condition(ToyLoop(), trials[:n], settings)
    condition(ToyLoop(), trials[::-1], settings)
    for known in (trials[:2], trials):
        warm = condition(ToyLoop(), known, settings)
        with monkeypatch.context() as patched:
            for name in ("_FITTED", "_LEARNT", "_CHECKED"):
                patched.setattr(f"chargetune.learning.twin.ensemble.{name}", Nothing())
            fresh = condition(ToyLoop(), known, settings)
        np.testing.assert_array_equal(warm.discrepancy.posterior.mode, fresh.discrepancy.posterior.mode)
        np.testing.assert_array_equal(warm.discrepancy.posterior.root, fresh.discrepancy.posterior.root)
        for one, other in zip(warm.learnt.checks, fresh.learnt.checks, strict=True):
            np.testing.assert_array_equal(one.log_likelihood, other.log_likelihood)
        np.testing.assert_array_equal(*(one.predict(np.full(3, 1.5), 3).excess for one in (warm, fresh)))


class Nothing:
    """A memory that forgets at once."""

    def get(self, _key, build):
        return build()


def test_other_settings_and_other_twins_do_not_share_what_was_learnt():
    trials = [Plant().trial(k, np.full(3, level)) for k, level in enumerate((3.0, 1.5))]
    base = condition(ToyLoop(), trials)
    others = [
        condition(ToyLoop(noise_sd={"gauge": 3e-3}), trials),
        condition(ToyLoop(), trials, TwinSettings(traces=1)),
        condition(ToyLoop(discrepancy_sd_floor={"gauge": 2e-2}), trials),
        condition(ToyLoop(), [trials[0], replace(trials[1], episode=lambda: Plant().episode(np.full(3, 1.5), 99))]),
    ]
    for other in others:
        assert not np.array_equal(other.predict(SPACE.default, 1).excess, base.predict(SPACE.default, 1).excess)
