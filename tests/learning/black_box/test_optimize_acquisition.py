"""Acquisition functions against Monte Carlo and against BoTorch's own."""

import warnings

import numpy as np
import pytest
import torch
from botorch.acquisition.acquisition import AcquisitionFunction
from botorch.acquisition.analytic import (
    ExpectedImprovement as BotorchEI,
)
from botorch.acquisition.analytic import LogConstrainedExpectedImprovement, LogExpectedImprovement
from botorch.models import ModelListGP

from chargetune.episode.score import Score
from chargetune.learning.black_box.constrained_ei import _ExpectedImprovement, _Models, limits_of, marginals
from chargetune.learning.black_box.expected_improvement import expected_improvement
from chargetune.learning.black_box.failure_penalty import RADIUS, AwayFromFailures
from chargetune.learning.black_box.gaussian_process import GaussianProcess
from chargetune.learning.black_box.optimize_acquisition import candidates, maximise, reproducible

RNG = np.random.default_rng(0)
X = torch.tensor(RNG.uniform(size=(15, 2)))
Y = torch.stack([torch.sin(4 * X[:, 0]), X[:, 1] - 0.4, X[:, 0] * X[:, 1] - 0.2], 1)
NEW = torch.tensor(RNG.uniform(size=(9, 1, 2)))


@pytest.mark.parametrize(("mean", "sd", "best"), [(0.0, 1.0, 0.0), (1.0, 0.5, 2.0), (-0.3, 2.0, 0.1), (5.0, 0.1, 1.0)])
def test_expected_improvement_is_that_of_monte_carlo(mean, sd, best):
    samples = mean + sd * np.random.default_rng(1).standard_normal(2_000_000)
    gain = np.maximum(samples - best, 0)
    closed = float(expected_improvement(torch.tensor(mean, dtype=torch.float64), torch.tensor(sd, dtype=torch.float64), best))
    assert closed == pytest.approx(gain.mean(), abs=5 * gain.std() / np.sqrt(gain.size) + 1e-12)


def test_expected_improvement_is_that_of_botorch_and_its_logarithm():
    with reproducible(0):
        model = GaussianProcess().fit(X, Y[:, 0])
        found = model.posterior(NEW)
        mean, sd = found.mean[:, 0, 0].detach(), found.variance[:, 0, 0].sqrt().detach()
        own = expected_improvement(mean, sd, 0.7)
        with warnings.catch_warnings():
            # BoTorch recommends the logarithm, which is what the tuner takes.
            warnings.simplefilter("ignore")
            peer = BotorchEI(model, 0.7)(NEW).detach()
        np.testing.assert_allclose(own, peer, rtol=1e-8, atol=1e-14)
        usable = own > 1e-30  # below, EI itself underflows
        assert usable.sum() > 4
        np.testing.assert_allclose(own.log()[usable], LogExpectedImprovement(model, 0.7)(NEW).detach()[usable], rtol=1e-5)


@pytest.mark.parametrize("standardise", [True, False])
def test_quick_marginals_and_acquisition_are_those_of_the_general_way(standardise):
    with reproducible(0):
        surrogate = GaussianProcess(standardise=standardise)
        model = ModelListGP(surrogate.fit(X, Y[:, :2]), surrogate.fit(X[:9], Y[:9, 2]))
        found = model.posterior(NEW)
        mean, sd = marginals(model, NEW)
        np.testing.assert_allclose(mean.detach(), found.mean[:, 0].detach(), atol=1e-10)
        np.testing.assert_allclose(sd.detach(), found.variance[:, 0].sqrt().detach(), atol=1e-8)
        arguments = (model, 0.5, 0, {1: (None, 0.1), 2: (None, 0.0)})
        np.testing.assert_allclose(
            _ExpectedImprovement(*arguments)(NEW).detach(), LogConstrainedExpectedImprovement(*arguments)(NEW).detach(), atol=1e-7
        )


def test_failures_lower_the_acquisition_by_their_closed_form():
    with reproducible(0):
        base = LogExpectedImprovement(GaussianProcess().fit(X, Y[:, 0]), 0.5)
        failed = torch.tensor([[0.2, 0.3], [0.9, 0.9]])
        found = AwayFromFailures(base, failed)(NEW).detach()
        square = ((NEW[:, 0, None] - failed) ** 2).sum(-1)
        penalty = torch.log(1 - torch.exp(-square / (2 * RADIUS**2 * 2))).sum(-1)
        np.testing.assert_allclose(found, base(NEW).detach() + penalty, atol=1e-6)
        assert AwayFromFailures(base, failed)(failed[:1, None])[0] < -20
        np.testing.assert_array_equal(AwayFromFailures(base, failed[:0])(NEW).detach(), base(NEW).detach())


def test_search_improves_on_its_candidates_and_avoids_what_was_tried():
    with reproducible(0):
        acquisition = LogExpectedImprovement(GaussianProcess().fit(X, Y[:, 0]), 0.5)
        points = candidates(2, 0, X[0])
        assert points.shape[1] == 2
        assert bool(((points >= 0) & (points <= 1)).all())
        found = maximise(acquisition, points, X.numpy())
        assert acquisition(found[None, None]) >= acquisition(points[:, None]).max() - 1e-9
        again = maximise(acquisition, points, found[None].numpy())
        assert (again - found).abs().max() > 1e-6


def score(excess, tolerance=0.01, profile=None):
    return Score(0.0, 0.0, {"v": excess}, {"v": tolerance}, profile={} if profile is None else {"v": profile})


class Trial:
    def __init__(self, own):
        self.score = own


def test_limits_keep_what_is_kept_and_break_what_is_broken():
    values = [-0.5, -0.01, 0.0, 0.0099, 0.01, 0.0101, 0.3, 40.0]
    (limit,) = limits_of([Trial(score(v)) for v in values])
    np.testing.assert_array_equal(limit.values <= limit.bound, np.array(values) <= 0.01)
    assert np.all(np.diff(limit.values) > 0)


def test_windows_are_limits_of_their_own_and_gaps_have_no_value():
    profiles = [(0.1, None, -0.2), (0.2, -0.1, -0.3), (-0.1, 0.05, -0.9), (0.0, 0.1, -0.25), (0.3, 0.2, -0.3)]
    found = {limit.name: limit for limit in limits_of([Trial(score(0.3, profile=p)) for p in profiles])}
    # The third window is never within a quarter of its spread of the limit: it does not restrict theta.
    assert sorted(found) == ["v[0]", "v[1]"]
    np.testing.assert_array_equal(found["v[0]"].rows, range(5))
    np.testing.assert_array_equal(found["v[1]"].rows, range(1, 5))


@pytest.mark.parametrize("values", [[-1.0] * 5, [-1.0, -1.01, -0.99, -1.0]])
def test_a_limit_out_of_reach_is_left_out(values):
    assert limits_of([Trial(score(v)) for v in values]) == []


def test_tolerance_zero_works():
    (limit,) = limits_of([Trial(score(v, tolerance=0.0)) for v in (-0.2, 0.1, 0.3, 0.0)])
    np.testing.assert_array_equal(limit.values <= limit.bound, [True, False, False, True])


class Rough(AcquisitionFunction):
    """Finite everywhere, and where it is to be improved without a gradient, or of a standardised_error in the program."""

    def __init__(self, failure):
        super().__init__(GaussianProcess().fit(X, Y[:, 0]))
        self.failure = failure

    def forward(self, x):
        if x.requires_grad and self.failure == "standardised_error":
            raise RuntimeError("shapes do not fit")
        return x[:, 0, 0] + (0.0 * x).sum(-1).sum(-1).sqrt()


def test_a_search_that_fails_is_warned_of_and_a_mistake_is_none_of_its_failures():
    with reproducible(0):
        points = candidates(2, 0, None)
        with pytest.warns(RuntimeWarning, match="the best of 128 points stands"):
            found = maximise(Rough("gradient"), points, X.numpy())
        assert found[0] == points[:, 0].max()
        with pytest.raises(RuntimeError, match="shapes do not fit"):
            maximise(Rough("standardised_error"), points, X.numpy())


def test_where_no_trial_keeps_the_limits_the_incumbent_is_the_closest_in_tolerances():
    """0.5 V over with 1 K to spare is further away than 1.5 mV and 0.6 K over, which as plain numbers are more."""
    tolerance = {"V": 0.001, "K": 0.5}
    excesses = [(0.5, -1.0), (0.0025, 0.6), (0.3, 0.0)]
    scores = [Score(-1.0 - n, 0.0, dict(zip(tolerance, pair, strict=True)), tolerance) for n, pair in enumerate(excesses)]
    x = torch.tensor([[0.1], [0.4], [0.7]], dtype=torch.double)
    models = _Models.fit(GaussianProcess(), x, [Trial(one) for one in scores])
    assert (models.incumbent, models.best) == (1, None)
