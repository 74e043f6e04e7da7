"""The default tuner: objective and limits as separate surrogates, constrained log expected improvement."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from botorch.acquisition.acquisition import AcquisitionFunction
from botorch.acquisition.analytic import LogConstrainedExpectedImprovement, LogProbabilityOfFeasibility
from botorch.acquisition.logei import qLogExpectedImprovement
from botorch.acquisition.objective import GenericMCObjective
from botorch.models.model_list_gp_regression import ModelListGP
from botorch.sampling.normal import SobolQMCNormalSampler
from numpy.typing import NDArray

from chargetune.learning.black_box.failure_penalty import AwayFromFailures
from chargetune.learning.black_box.gaussian_process import GaussianProcess
from chargetune.learning.black_box.optimize_acquisition import candidates, maximise, reproducible
from chargetune.learning.initial_design import initial_design
from chargetune.learning.tuner import TrialLike, check_count
from chargetune.model.parameter_space import ParameterSpace

__all__ = ["ConstrainedLogEI", "LimitSamples", "limits_of", "marginals"]

# Samples of the Monte Carlo form of the acquisition, used with pending points.
SAMPLES = 128
# Scale of the transform asinh(excess / scale), in tolerances: linear near the limit, where the optimum lies, and logarithmic far away.
SCALE_TOLERANCES = 20.0
# A limit restricts theta only if its excess came closer to the bound than this share of the range of its values.
REACH = 0.25


@dataclass(frozen=True)
class LimitSamples:
    """Excess over one limit, or in one window of it, in the trials that have it: transformed by asinh, kept where <= ``bound``."""

    name: str
    rows: NDArray[np.int64]
    values: NDArray[np.float64]
    bound: float


def limits_of(trials: Sequence[TrialLike]) -> list[LimitSamples]:
    """The limits that can restrict theta, from the finished trials; each window of a profile counts as a limit.

    The transform is monotone and maps the tolerance to the bound, so that it does not change which limits are kept. A window that an
    episode did not reach has no value.
    """
    columns: dict[str, list[tuple[int, float, float]]] = {}
    for row, trial in enumerate(trials):
        score = trial.score
        if score is None:
            continue
        for name, excess in score.excess.items():
            tolerance = score.tolerance.get(name, 0.0)
            windows = score.profile.get(name)
            named = {name: excess} if windows is None else {f"{name}[{i}]": v for i, v in enumerate(windows)}
            for key, value in named.items():
                if value is not None:
                    columns.setdefault(key, []).append((row, value, tolerance))
    out = []
    for name, entries in columns.items():
        rows, values, tolerances = (np.array(column) for column in zip(*entries, strict=True))
        tolerance = float(tolerances[0])
        worst, spread = float(np.max(values)), float(np.ptp(values))
        if len(values) < 3 or (worst <= tolerance and worst < -REACH * spread):
            continue
        scale = SCALE_TOLERANCES * tolerance or 0.1 * float(np.median(np.abs(values))) or 1.0
        out.append(LimitSamples(name, rows.astype(np.int64), np.arcsinh(values / scale), float(np.arcsinh(tolerance / scale))))
    return out


@dataclass(frozen=True)
class ConstrainedLogEI:
    """Constrained log expected improvement over the best theta that kept every limit.

    The objective and the excess over each limit (in each window, where the score has a profile) are separate
    Gaussian processes. As long as no trial kept the limits, the probability of keeping them is maximised instead. The objective is
    learnt as -log(1 + (best - objective) / median), which is monotone and prevents bad trials from dominating the fit.
    Failed trials have no score; the acquisition is lowered near them. For batches and running trials the Monte Carlo form
    with pending points is used. The initial design is theta_0 and ``n_initial`` Sobol points.
    Sources: Gardner et al., ICML 2014; Ament et al., NeurIPS 2023.
    """

    seed: int = 0
    n_initial: int = 8
    surrogate: GaussianProcess = field(default_factory=GaussianProcess)

    def ask(self, space: ParameterSpace, trials: Sequence[TrialLike], n: int = 1) -> NDArray[np.float64]:
        """The next ``n`` thetas, shape (n, d)."""
        check_count(n)
        first = initial_design(space, self.n_initial, self.seed, len(trials), n)
        if len(first) == n:
            return first
        d = space.dimension
        done = [t for t in trials if t.score is not None]
        failed = space.to_unit(np.array([t.theta for t in trials if t.score is None and t.status != "running"]).reshape(-1, d))
        pending = [space.to_unit(np.array(t.theta)) for t in trials if t.score is None and t.status == "running"]
        pending += list(space.to_unit(first))
        proposed: list[NDArray[np.float64]] = []
        seed = self.seed * 100_003 + len(trials)
        with reproducible(seed):
            x = torch.as_tensor(space.to_unit(np.array([t.theta for t in done]).reshape(-1, d)))
            models = _Models.fit(self.surrogate, x, done) if done else None
            for k in range(n - len(first)):
                points = candidates(d, seed + 7919 * (k + 1), x[models.incumbent] if models else None)
                if models is None:
                    proposed.append(points[k].numpy())
                    continue
                waiting = torch.as_tensor(np.array([*pending, *proposed]).reshape(-1, d))
                acquisition = AwayFromFailures(models.acquisition(waiting, seed), torch.as_tensor(failed))
                taken = np.vstack([x.numpy(), failed, waiting.numpy()])
                proposed.append(maximise(acquisition, points, taken).numpy())
        return np.vstack([first, space.from_unit(np.array(proposed))])


@dataclass(frozen=True)
class _Models:
    """Fitted models: output 0 is the objective, the others are the limits; ``incumbent`` is an index into the finished trials."""

    model: ModelListGP
    bounds: tuple[float, ...]
    incumbent: int
    best: float | None

    @classmethod
    def fit(cls, surrogate: GaussianProcess, x: torch.Tensor, done: Sequence[TrialLike]) -> _Models:
        scores = [t.score for t in done if t.score is not None]
        behind = np.max([s.objective for s in scores]) - np.array([s.objective for s in scores])
        objective = -np.log1p(behind / (np.median(behind) or 1.0))
        feasible = np.array([s.feasible for s in scores])
        limits = limits_of(done)
        # Outputs that all trials have are fitted in one batch, several times faster than one by one.
        limits.sort(key=lambda limit: len(limit.rows) < len(done))
        whole = [limit.values for limit in limits if len(limit.rows) == len(done)]
        fitted = [surrogate.fit(x, torch.as_tensor(np.column_stack([objective, *whole])))]
        fitted += [surrogate.fit(x[limit.rows], torch.as_tensor(limit.values)) for limit in limits[len(whole) :]]
        if feasible.any():
            incumbent = int(np.argmax(np.where(feasible, objective, -np.inf)))
            best = float(objective[incumbent])
        else:
            incumbent, best = int(np.argmin([s.worst for s in scores])), None
        return cls(ModelListGP(*fitted), tuple(limit.bound for limit in limits), incumbent, best)

    def acquisition(self, waiting: torch.Tensor, seed: int) -> AcquisitionFunction:
        constraints: dict[int, tuple[float | None, float | None]] = {i + 1: (None, bound) for i, bound in enumerate(self.bounds)}
        if self.best is None and constraints:
            return _ProbabilityOfFeasibility(self.model, constraints)
        best = self.best if self.best is not None else float("-inf")
        if constraints and not len(waiting):
            return _ExpectedImprovement(self.model, best, 0, constraints)
        sampler = SobolQMCNormalSampler(torch.Size([SAMPLES]), seed=seed)
        return qLogExpectedImprovement(
            self.model,
            best_f=torch.tensor(best),
            sampler=sampler,
            objective=GenericMCObjective(_first),
            constraints=[_above(i + 1, bound) for i, bound in enumerate(self.bounds)] or None,
            X_pending=waiting if len(waiting) else None,
        )


def marginals(model: Any, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Mean and sd of each output at single points x (b, 1, d), shapes (b, m); the same as from ``model.posterior``.

    The models are independent, so that the joint covariance, which ``model.posterior`` builds, is not needed: 6 times faster.
    """
    means, deviations = [], []
    for part in model.models:
        m = part.num_outputs
        marginal = part(x.unsqueeze(-3).expand(*x.shape[:-2], m, *x.shape[-2:]) if m > 1 else x)
        shape = (*x.shape[:-2], m)
        mean, sd = marginal.mean.reshape(shape), marginal.variance.clamp_min(1e-12).sqrt().reshape(shape)
        scaling = getattr(part, "outcome_transform", None)
        if scaling is not None:
            mean, sd = mean * scaling.stdvs[0] + scaling.means[0], sd * scaling.stdvs[0]
        means.append(mean)
        deviations.append(sd)
    return torch.cat(means, -1), torch.cat(deviations, -1)


class _ExpectedImprovement(LogConstrainedExpectedImprovement):
    """BoTorch's constrained log expected improvement, with `marginals` for speed."""

    def _mean_and_sigma(self, X: torch.Tensor, *_: object, **__: object) -> tuple[torch.Tensor, torch.Tensor]:
        return marginals(self.model, X)


class _ProbabilityOfFeasibility(LogProbabilityOfFeasibility):
    """BoTorch's log probability of feasibility, with `marginals` for speed."""

    def _mean_and_sigma(self, X: torch.Tensor, *_: object, **__: object) -> tuple[torch.Tensor, torch.Tensor]:
        return marginals(self.model, X)


def _first(samples: torch.Tensor, X: torch.Tensor | None = None) -> torch.Tensor:  # noqa: ARG001 - the signature BoTorch calls
    return samples[..., 0]


def _above(index: int, bound: float) -> Callable[[torch.Tensor], torch.Tensor]:
    return lambda samples: samples[..., index] - bound
