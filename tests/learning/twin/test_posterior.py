"""Draws of a posterior against its moments, and what it states of new samples against draws."""

import numpy as np
import pytest
from toy_loop import NOISE, SPACE, Plant, ToyLoop

from chargetune.episode.episode import Ending
from chargetune.learning.twin.laplace import fit
from chargetune.learning.twin.posterior import Posterior
from chargetune.learning.twin.rollout import predict_each

pytestmark = pytest.mark.usefixtures("virtual_machine")


def test_without_data_it_is_the_prior():
    posterior = fit(ToyLoop().twin, [])
    steps = np.abs(np.subtract.outer(np.arange(3), np.arange(3)))
    np.testing.assert_array_equal(posterior.mode, 0.0)
    np.testing.assert_allclose(posterior.covariance[:3, :3], 0.4**2 * 0.3**steps, atol=1e-12)
    draws = posterior.draw(8000, 0)
    np.testing.assert_allclose(np.cov(draws.T), posterior.covariance, atol=0.015)
    np.testing.assert_allclose(draws.mean(axis=0), 0.0, atol=0.02)


def test_draws_have_the_moments_of_the_components():
    """A sum of two Gaussians: mean and variance in closed form."""
    parts = tuple((share, Posterior(None, np.array([at]), np.array([[sd]]), np.zeros(1), np.ones(1))) for share, at, sd in
                  ((0.25, -2.0, 0.5), (0.75, 1.0, 1.0)))  # fmt: skip
    draws = Posterior(None, np.zeros(1), np.eye(1), np.zeros(1), np.ones(1), parts).draw(8000, 4)[:, 0]
    mean = 0.25 * -2.0 + 0.75 * 1.0
    assert draws.mean() == pytest.approx(mean, abs=0.03)
    assert draws.var() == pytest.approx(0.25 * (0.25 + 4.0) + 0.75 * (1.0 + 1.0) - mean**2, rel=0.05)


def test_the_stated_sd_of_a_new_sample_is_that_of_draws_with_noise():
    twin = ToyLoop().twin
    posterior = fit(twin, [Plant().episode(SPACE.upper, 0).cut(4, Ending.DONE, "")])
    inputs = Plant().episode(SPACE.default, 1).input
    (drawn,) = predict_each(twin, posterior.draw(4000, 2), [inputs])
    expected = np.sqrt(drawn.var(axis=0) + NOISE**2 + posterior.discrepancy_sd**2)
    stated = posterior.predicted_sd(inputs)
    assert stated.max() > 10 * NOISE
    np.testing.assert_allclose(stated, expected, rtol=0.25)


def test_draws_do_not_depend_on_how_many_cores_there_are(monkeypatch):
    posterior = fit(ToyLoop().twin, [Plant().episode(SPACE.upper, 0)])
    drawn = posterior.draw(6, 3)
    monkeypatch.setattr("chargetune.runtime.threads.usable_cores", lambda: 1)
    again = fit(ToyLoop().twin, [Plant().episode(SPACE.upper, 0)])
    np.testing.assert_array_equal(again.draw(6, 3), drawn)
