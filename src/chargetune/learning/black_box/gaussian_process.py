"""Gaussian-process surrogate with mean and covariance functions of the user's choice."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gpytorch
import torch
from botorch.exceptions.errors import ModelFittingError, OptimizationGradientError
from botorch.fit import fit_gpytorch_mll
from botorch.models import SingleTaskGP
from botorch.models.transforms.outcome import Standardize
from botorch.models.utils.gpytorch_modules import get_covar_module_with_dim_scaled_prior
from gpytorch.constraints import GreaterThan
from gpytorch.kernels import Kernel, MaternKernel, ScaleKernel
from gpytorch.likelihoods import GaussianLikelihood
from gpytorch.means import Mean
from gpytorch.mlls import ExactMarginalLogLikelihood
from linear_operator.utils.errors import NanError, NotPSDError
from torch.linalg import LinAlgError  # type: ignore[attr-defined] # documented, but not in its __all__

from chargetune.runtime.counted import counted

__all__ = ["FAILURES", "GaussianProcess", "SurrogateWarning", "fitted", "posterior"]

# Iterations of a fit, at most: later ones change the hyperparameters in their third digit.
FIT_ITERATIONS = 30
# Lower bound of a learnt noise variance, in units of the scaled output.
NOISE_LEAST = 1e-6
# Exceptions that a matrix that is singular to rounding, or a flat function, can raise. Any other exception is a defect of the program.
FAILURES = (ModelFittingError, OptimizationGradientError, NanError, NotPSDError, LinAlgError)


class SurrogateWarning(UserWarning):
    """A surrogate could not be fitted; it keeps the hyperparameters from which the fit started."""


@dataclass(frozen=True)
class GaussianProcess:
    """y = m(x) + f(x) + noise, f ~ GP(0, k), x in the unit cube, y standardised inside.

    mean, covariance
        Factories of GPyTorch modules: ``mean()``, ``covariance(d)``. Default: a constant, and Matern 5/2 with ARD, of
        unit variance with BoTorch's dimension-scaled length-scale priors (``priors=True``) or scaled without priors.
    priors
        Maximise marginal likelihood times priors (BoTorch's, dimension-scaled), or the marginal likelihood alone.
    standardise
        Fit (y - mean) / sd instead of y.
    noise
        Fixed noise variance, in the unit in which it is fitted; None: it is learnt.
    iterations
        Largest number of iterations of the search for the hyperparameters.
    """

    mean: Callable[[], Mean] | None = None
    covariance: Callable[[int], Kernel] | None = None
    priors: bool = True
    standardise: bool = True
    noise: float | None = None
    iterations: int = FIT_ITERATIONS

    def fit(self, x: torch.Tensor, y: torch.Tensor) -> SingleTaskGP:
        """The surrogate for x (n, d) and y (n,), or m independent surrogates for y (n, m) fitted in one batch, by log marginal likelihood.

        Raises ValueError for shapes that do not fit or values that are not finite.
        """
        y = y[:, None] if y.ndim == 1 else y
        if x.ndim != 2 or y.ndim != 2 or len(y) != len(x) or not len(x):
            raise ValueError(f"surrogate: x has shape {tuple(x.shape)} and y {tuple(y.shape)}, expected (n, d) and (n, m) with n >= 1")
        if not (torch.isfinite(x).all() and torch.isfinite(y).all()):
            raise ValueError("surrogate: x and y must be finite")
        model = fitted(lambda: self._model(x, y), f"the surrogate of {counted(len(y), 'trial')}", attempts=2, iterations=self.iterations)
        model.eval()
        return model

    def _model(self, x: torch.Tensor, y: torch.Tensor) -> SingleTaskGP:
        d, m = x.shape[1], y.shape[1]
        batch = torch.Size([m]) if m > 1 else torch.Size()
        likelihood = None
        if self.covariance is not None:
            kernel = self.covariance(d)
        elif self.priors:
            kernel = get_covar_module_with_dim_scaled_prior(ard_num_dims=d, batch_shape=batch, use_rbf_kernel=False)
        else:
            matern = MaternKernel(nu=2.5, ard_num_dims=d, batch_shape=batch, lengthscale_constraint=GreaterThan(1e-3))
            kernel = ScaleKernel(matern, batch_shape=batch)
        if not self.priors and self.noise is None:
            likelihood = GaussianLikelihood(noise_constraint=GreaterThan(NOISE_LEAST), batch_shape=batch)
            likelihood.initialize(noise=1e-3)
        with warnings.catch_warnings():
            # BoTorch warns of outputs that are not standardised, which is the user's choice here.
            warnings.simplefilter("ignore")
            model = SingleTaskGP(
                x,
                y,
                train_Yvar=None if self.noise is None else torch.full_like(y, self.noise),
                likelihood=likelihood,
                covar_module=kernel,
                mean_module=self.mean() if self.mean is not None else None,
                outcome_transform=Standardize(m) if self.standardise else None,
            )
        return model.to(x)


def fitted(make: Callable[[], SingleTaskGP], what: str, *, attempts: int, iterations: int | None = None) -> SingleTaskGP:
    """The model of ``make`` with fitted hyperparameters: maximum of marginal likelihood times priors.

    If the fit fails (`FAILURES`), the model keeps its initial hyperparameters, with a `SurrogateWarning` that names ``what``. ``attempts``
    after the first start from a draw of torch's global generator, so that the caller has to be inside `reproducible`.
    """
    model = make()
    options = None if iterations is None else {"options": {"maxiter": iterations}}
    try:
        with warnings.catch_warnings():
            # BoTorch warns when the iteration limit is reached, which is no failure here, see FIT_ITERATIONS.
            warnings.simplefilter("ignore")
            fit_gpytorch_mll(ExactMarginalLogLikelihood(model.likelihood, model), optimizer_kwargs=options, max_attempts=attempts)
    except FAILURES as error:
        warnings.warn(f"{what} could not be fitted ({error})", SurrogateWarning, stacklevel=3)
        model = make()
    return model


def posterior(model: SingleTaskGP, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Mean (m,) and covariance (m, m) of f at x (m, d), without noise, in the unit of y."""
    exact = gpytorch.settings.fast_computations(covar_root_decomposition=False, log_prob=False, solves=False)
    with torch.no_grad(), exact:
        found: Any = model.posterior(x)
        return found.mean[:, 0], found.distribution.covariance_matrix
