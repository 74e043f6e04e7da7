"""Expected improvement, the method of the paper: one Gaussian process on the scalar performance G."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from botorch.acquisition.acquisition import AcquisitionFunction
from botorch.acquisition.analytic import LogExpectedImprovement
from botorch.acquisition.logei import qLogExpectedImprovement
from botorch.sampling.normal import SobolQMCNormalSampler
from numpy.typing import NDArray

from chargetune.learning.black_box.failure_penalty import AwayFromFailures
from chargetune.learning.black_box.gaussian_process import GaussianProcess
from chargetune.learning.black_box.optimize_acquisition import candidates, maximise, reproducible
from chargetune.learning.initial_design import initial_design
from chargetune.learning.tuner import TrialLike, check_count
from chargetune.model.parameter_space import ParameterSpace

__all__ = ["ExpectedImprovement", "expected_improvement"]

# Samples of the Monte Carlo form of the acquisition, used with pending points.
SAMPLES = 128


def expected_improvement(mean: torch.Tensor, sd: torch.Tensor, best: float) -> torch.Tensor:
    """EI = (mu - best) Phi(u) + sd phi(u), u = (mu - best) / sd, for maximisation; any shape.

    Source: Jones, Schonlau, Welch, J. Global Optimization 13 (1998). The tuner maximises its logarithm, which has the
    same maximiser and does not underflow (Ament et al., NeurIPS 2023).
    """
    u = (mean - best) / sd
    density = torch.exp(-(u**2) / 2) / math.sqrt(2 * math.pi)
    improvement: torch.Tensor = (mean - best) * torch.special.ndtr(u) + sd * density
    return improvement


@dataclass(frozen=True)
class ExpectedImprovement:
    """Algorithm 1 of Hirt et al. (ADCHEM 2024): GP on G(theta), next theta by expected improvement.

    The initial design is theta_0 and ``n_initial`` scrambled Sobol points. In a batch, and while trials are running, the Monte Carlo
    form of log EI takes the pending points into account jointly, without an invented value. Failed trials have no
    G; the acquisition is lowered near them.
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
        done = [t for t in trials if t.score is not None]
        failed = space.to_unit(
            np.array([t.theta for t in trials if t.score is None and t.status != "running"]).reshape(-1, space.dimension)
        )
        pending = [space.to_unit(np.array(t.theta)) for t in trials if t.score is None and t.status == "running"]
        pending += list(space.to_unit(first))
        proposed: list[NDArray[np.float64]] = []
        seed = self.seed * 100_003 + len(trials)
        with reproducible(seed):
            x = torch.as_tensor(space.to_unit(np.array([t.theta for t in done]).reshape(-1, space.dimension)))
            g = torch.tensor([t.score.performance for t in done if t.score is not None])
            model = self.surrogate.fit(x, g) if done else None
            for k in range(n - len(first)):
                points = candidates(space.dimension, seed + 7919 * (k + 1), x[g.argmax()] if model else None)
                if model is None:
                    proposed.append(points[k].numpy())
                    continue
                waiting = torch.as_tensor(np.array([*pending, *proposed]).reshape(-1, space.dimension))
                acquisition: AcquisitionFunction = LogExpectedImprovement(model, best_f=g.max())
                if len(waiting):
                    sampler = SobolQMCNormalSampler(torch.Size([SAMPLES]), seed=seed)
                    acquisition = qLogExpectedImprovement(model, best_f=g.max(), sampler=sampler, X_pending=waiting)
                taken = np.vstack([x.numpy(), failed, waiting.numpy()])
                proposed.append(maximise(AwayFromFailures(acquisition, torch.as_tensor(failed)), points, taken).numpy())
        return np.vstack([first, space.from_unit(np.array(proposed))])
