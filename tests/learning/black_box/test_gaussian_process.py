"""The Gaussian process against dense algebra."""

import warnings

import gpytorch
import numpy as np
import pytest
import torch
from gpytorch.kernels import MaternKernel, RBFKernel, ScaleKernel
from gpytorch.means import ConstantMean, ZeroMean

from chargetune.learning.black_box.gaussian_process import GaussianProcess, SurrogateWarning, posterior
from chargetune.learning.black_box.optimize_acquisition import reproducible

RNG = np.random.default_rng(0)
X = torch.tensor(RNG.uniform(size=(12, 2)))
Y = torch.sin(5 * X[:, 0]) + X[:, 1] ** 2
NEW = torch.tensor(RNG.uniform(size=(7, 2)))


def constant():
    mean = ConstantMean()
    mean.initialize(constant=0.3)
    return mean


def dense(model, mean, noise):
    with torch.no_grad():
        covariance = model.covar_module
        k, ks, kss = (covariance(a, b).to_dense() for a, b in ((X, X), (NEW, X), (NEW, NEW)))
        weights = torch.linalg.solve(k + noise * torch.eye(len(X)), torch.cat([(Y - mean)[:, None], ks.T], 1))
        return mean + ks @ weights[:, 0], kss - ks @ weights[:, 1:], k


@pytest.mark.parametrize(
    "kernel", [lambda d: ScaleKernel(RBFKernel(ard_num_dims=d)), lambda d: ScaleKernel(MaternKernel(nu=1.5, ard_num_dims=d))]
)
@pytest.mark.parametrize(("make_mean", "level"), [(ZeroMean, 0.0), (constant, 0.3)])
def test_posterior_is_that_of_dense_algebra(kernel, make_mean, level):
    with reproducible(0):
        surrogate = GaussianProcess(mean=make_mean, covariance=kernel, priors=False, standardise=False, noise=1e-3)
        model = surrogate.fit(X, Y)
        level = float(model.mean_module.constant.detach()) if make_mean is constant else level
        mean, covariance = posterior(model, NEW)
        expected_mean, expected_covariance, _ = dense(model, level, 1e-3)
    np.testing.assert_allclose(mean, expected_mean, atol=1e-8)
    np.testing.assert_allclose(covariance, expected_covariance, atol=1e-8)


def test_standardised_posterior_is_the_same_in_the_unit_of_y():
    with reproducible(0):
        model = GaussianProcess(covariance=lambda d: ScaleKernel(RBFKernel(ard_num_dims=d)), mean=ZeroMean, priors=False, noise=1e-3).fit(
            X, Y
        )
        found, _ = posterior(model, NEW)
        scale, shift = Y.std(), Y.mean()
        with torch.no_grad():
            k, ks = (model.covar_module(a, X).to_dense() for a in (X, NEW))
        # BoTorch gives a fixed noise in the unit of y.
        expected = shift + scale * (ks @ torch.linalg.solve(k + 1e-3 / scale**2 * torch.eye(len(X)), (Y - shift) / scale))
    np.testing.assert_allclose(found, expected, atol=1e-8)


def test_fit_raises_the_marginal_likelihood_which_is_that_of_dense_algebra():
    with reproducible(0):
        surrogate = GaussianProcess(
            covariance=lambda d: ScaleKernel(RBFKernel(ard_num_dims=d)), mean=ZeroMean, priors=False, standardise=False, noise=1e-2
        )
        start = surrogate._model(X, Y[:, None])
        fitted = surrogate.fit(X, Y)

        def likelihood(model):
            with torch.no_grad():
                k = model.covar_module(X, X).to_dense() + 1e-2 * torch.eye(len(X))
                return float(torch.distributions.MultivariateNormal(torch.zeros(len(X)), k).log_prob(Y))

        assert likelihood(fitted) > likelihood(start) + 1.0
        fitted.train()
        with gpytorch.settings.fast_computations(False, False, False):
            mll = gpytorch.mlls.ExactMarginalLogLikelihood(fitted.likelihood, fitted)
            value = float(mll(fitted(X), Y).detach()) * len(X)
    assert value == pytest.approx(likelihood(fitted), abs=1e-6)


@pytest.mark.parametrize("priors", [True, False])
def test_several_outputs_at_once_are_independent(priors):
    with reproducible(0):
        both = GaussianProcess(priors=priors).fit(X, torch.stack([Y, -3 * Y + 1], 1))
        mean = both.posterior(NEW).mean.detach()
    np.testing.assert_allclose(mean[:, 1], -3 * mean[:, 0] + 1, atol=0.02)


@pytest.mark.parametrize(
    ("x", "y", "words"),
    [(X, Y[:3], "shape"), (X[:0], Y[:0], "n >= 1"), (X, torch.full_like(Y, torch.nan), "finite"), (X * torch.inf, Y, "finite")],
)
def test_bad_data_is_refused(x, y, words):
    with pytest.raises(ValueError, match=words):
        GaussianProcess().fit(x, y)


@pytest.mark.parametrize("kind", ["constant", "one point", "duplicates", "far outlier"])
def test_awkward_data_gives_a_usable_surrogate(kind):
    x, y = X.clone(), Y.clone()
    if kind == "constant":
        y[:] = 2.0
    if kind == "one point":
        x, y = x[:1], y[:1]
    if kind == "duplicates":
        x[1:] = x[0]
    if kind == "far outlier":
        y[0] = -1e9
    with reproducible(0), warnings.catch_warnings():
        warnings.simplefilter("ignore", SurrogateWarning)
        mean, covariance = posterior(GaussianProcess().fit(x, y), NEW)
    assert torch.isfinite(mean).all()
    assert torch.isfinite(covariance).all()
