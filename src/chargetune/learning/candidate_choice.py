"""The twin's prediction of the score as the prior mean of Algorithm 1; a Gaussian process learns what remains of it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from botorch.acquisition.acquisition import AcquisitionFunction
from botorch.acquisition.analytic import LogConstrainedExpectedImprovement, LogExpectedImprovement, LogProbabilityOfFeasibility
from botorch.models.model import Model
from botorch.models.model_list_gp_regression import ModelListGP
from botorch.posteriors.gpytorch import GPyTorchPosterior
from gpytorch.distributions import MultitaskMultivariateNormal
from gpytorch.means import ZeroMean
from linear_operator.operators import DiagLinearOperator
from numpy.typing import NDArray

from chargetune.episode.score import Score
from chargetune.learning.black_box.constrained_ei import marginals
from chargetune.learning.black_box.failure_penalty import AwayFromFailures
from chargetune.learning.black_box.gaussian_process import GaussianProcess
from chargetune.learning.black_box.optimize_acquisition import reproducible
from chargetune.learning.tuner import TrialLike
from chargetune.learning.twin.ensemble import Ensemble, Prediction
from chargetune.model.parameter_space import ParameterSpace

__all__ = ["Candidate", "choose_candidate"]

Candidate = tuple[NDArray[np.float64], Prediction]
"""A theta and what the ensemble of plants does with it."""

# One trial says nothing of what remains.
PROVED = 2
# Of a value: a twin that predicted_before every score to the last digit leaves nothing to be scaled by.
LEAST = 1e-9
# Of the search for the hyperparameters. It is to tell a handful of candidates apart: three times as many tell them apart no differently.
ITERATIONS = 10
# In units of s, f is never as far from its mean: the probability is 1e-15.
FAR = 8.0


def choose_candidate(
    ensemble: Ensemble, space: ParameterSpace, trials: Sequence[TrialLike], candidates: Sequence[Candidate], seed: int
) -> Candidate:
    """The candidate of the largest constrained log expected improvement on the corrected prediction, the earlier of equals.

    For the objective and for the worst excess of every limit, y(theta) = m(theta) + f(theta) + noise, where m is the score of the
    expected episode (`Ensemble.central`), f ~ GP(0, s^2 k) with s the rms of y - m over the trials and k as in `GaussianProcess`; the
    variance at a candidate is that of f plus that of the ensemble. Improvement is over the best trial that m + f
    calls kept; while there is none, the probability of keeping them decides. Near failed trials it is lower (`AwayFromFailures`).
    Candidates of which nothing is predicted_before are passed over. With fewer than `PROVED` trials the first of them is returned: a twin
    reproduces the trial that it was made from. Source of the acquisition: Ament et al., NeurIPS 2023.
    """
    seen = [t for t in trials if t.score is not None]
    known = [c for c in candidates if c[1].scores]
    done = [(t, s) for t, s in zip(seen, ensemble.scores([np.array(t.theta) for t in seen]), strict=True) if s is not None]
    if len(known) < 2 or len(done) < PROVED:
        return (known or list(candidates))[0]
    failed = [t.theta for t in trials if t.score is None and t.status != "running"]
    with reproducible(seed):
        model = _Corrected(space, done, known)
        away = torch.as_tensor(space.to_unit(np.array(failed).reshape(-1, space.dimension)))
        points = torch.as_tensor(space.to_unit(np.array([theta for theta, _ in known])))
        with torch.no_grad():
            values = AwayFromFailures(model.acquisition(), away)(points[:, None, :])
        return known[int(torch.nan_to_num(values, nan=-torch.inf).argmax())]


class _Corrected(Model):
    """Outputs: the objective, then the excess of each limit less its tolerance, each in units of its own s.

    Known at the thetas of the trials and of the candidates, nowhere else.
    """

    def __init__(self, space: ParameterSpace, done: Sequence[tuple[TrialLike, Score]], known: Sequence[Candidate]) -> None:
        super().__init__()
        measured = np.array([_values(t.score) for t, _ in done if t.score is not None])
        ensembles = [np.array([_values(s) for s in predicted.scores]) for _, predicted in known]
        # A trial is known, and the expected episode says it all; of a candidate the worst of many windows is worse than the expected one.
        predicted_before = np.array([*(_values(s) for _, s in done), *(e.mean(axis=0) for e in ensembles)])
        scale = np.sqrt(np.mean((measured - predicted_before[: len(done)]) ** 2, axis=0))
        scale = np.maximum(scale, LEAST * np.max(np.abs(predicted_before), axis=0)) + np.finfo(float).tiny
        # A limit that nothing comes near has the probability 1, and needs no process to say so.
        near = np.max(np.vstack([measured, predicted_before]) / scale, axis=0) > -FAR
        near[0] = True
        measured, predicted_before, scale = measured[:, near], predicted_before[:, near], scale[near]
        points = space.to_unit(np.array([*(t.theta for t, _ in done), *(theta for theta, _ in known)]))
        x, left = torch.as_tensor(points[: len(done)]), torch.as_tensor((measured - predicted_before[: len(done)]) / scale)
        self._model = ModelListGP(GaussianProcess(mean=ZeroMean, standardise=False, iterations=ITERATIONS).fit(x, left))
        self._foretold = _Table(points, predicted_before / scale)
        self._spread = _Table(points[len(done) :], np.array([e.std(axis=0) for e in ensembles])[:, near] / scale)
        self._outputs = len(scale)
        with torch.no_grad():
            mean, _ = self._marginals(x[:, None, :])
        kept = mean[(mean[:, 1:] <= 0.0).all(dim=-1), 0]
        self._best = float(kept.max()) if len(kept) else None

    @property
    def num_outputs(self) -> int:
        return self._outputs

    @property
    def batch_shape(self) -> torch.Size:
        return torch.Size()

    def _marginals(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Mean and sd of m + f at single points x (b, 1, d), shapes (b, outputs)."""
        mean, sd = marginals(self._model, x)
        return self._foretold(x) + mean, sd

    def posterior(self, X: torch.Tensor, *_: Any, **__: Any) -> GPyTorchPosterior:
        """At single points X (b, 1, d); the outputs are independent."""
        mean, sd = self._marginals(X)
        return GPyTorchPosterior(MultitaskMultivariateNormal(mean[..., None, :], DiagLinearOperator(sd**2 + self._spread(X) ** 2)))

    def acquisition(self) -> AcquisitionFunction:
        limits: dict[int, tuple[float | None, float | None]] = dict.fromkeys(range(1, self.num_outputs), (None, 0.0))
        if self._best is None:
            return LogProbabilityOfFeasibility(self, limits)
        if not limits:
            return LogExpectedImprovement(self, self._best)
        return LogConstrainedExpectedImprovement(self, self._best, 0, limits)


def _values(score: Score) -> list[float]:
    return [score.objective, *(worst - score.tolerance.get(name, 0.0) for name, worst in score.excess.items())]


class _Table:
    """Values of every output that are known at some points."""

    def __init__(self, points: NDArray[np.float64], values: NDArray[np.float64]) -> None:
        self._values = {p.tobytes(): v for p, v in zip(points, values, strict=True)}

    def __call__(self, x: torch.Tensor) -> torch.Tensor:
        """x (b, 1, d) -> (b, outputs)."""
        return torch.as_tensor(np.array([self._values[np.ascontiguousarray(row).tobytes()] for row in x.detach().numpy()[:, 0]]))
