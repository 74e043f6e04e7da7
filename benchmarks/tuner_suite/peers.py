"""Tuners of others: constrained EI and SCBO with BoTorch's parts, SMAC3's own, and a safe set after SafeOpt."""

from __future__ import annotations

import tempfile
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from botorch.acquisition.analytic import LogConstrainedExpectedImprovement
from botorch.fit import fit_gpytorch_mll
from botorch.generation.sampling import ConstrainedMaxPosteriorSampling
from botorch.models import ModelListGP, SingleTaskGP
from botorch.optim import optimize_acqf
from gpytorch.mlls import SumMarginalLogLikelihood
from numpy.typing import NDArray

import chargetune as ct
from chargetune.learning.initial_design import initial_design, sobol_points

__all__ = ["ConstrainedEI", "SafeGaussianProcess", "Scbo", "Smac"]

INITIAL = 4


def _told(space: ct.ParameterSpace, trials: Sequence[Any]) -> tuple[torch.Tensor, torch.Tensor]:
    """Points of the unit cube (n, d); objective and excess of each limit beyond its tolerance, in tolerances, (n, 1 + limits)."""
    done = [t for t in trials if t.score is not None]
    x = torch.as_tensor(np.array([space.to_unit(np.array(t.theta)) for t in done]).reshape(-1, space.dimension))
    y = torch.as_tensor(np.array([[t.score.objective, *t.score.beyond.values()] for t in done]))
    return x, y


def _fitted(x: torch.Tensor, y: torch.Tensor) -> tuple[ModelListGP, torch.Tensor, torch.Tensor]:
    """(one Gaussian process an output, of standardised values, mean and sd that they were standardised by)."""
    mean, sd = y.mean(0), y.std(0).nan_to_num(1.0).clamp_min(1e-6)
    scaled = (y - mean) / sd
    model = ModelListGP(*(SingleTaskGP(x, scaled[:, [k]], outcome_transform=None) for k in range(y.shape[1])))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        fit_gpytorch_mll(SumMarginalLogLikelihood(model.likelihood, model))
    return model.eval(), mean, sd


@dataclass(frozen=True)
class ConstrainedEI:
    """BoTorch's LogConstrainedExpectedImprovement on the objective and every limit; theta_0 and Sobol points first."""

    seed: int

    def ask(self, space: ct.ParameterSpace, trials: Sequence[Any], n: int = 1) -> NDArray[np.float64]:
        x, y = _told(space, trials)
        if len(trials) < INITIAL or len(x) < 2:
            return initial_design(space, len(trials) + 1, self.seed, len(trials), 1)
        with torch.random.fork_rng(), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            torch.manual_seed(self.seed * 1000 + len(trials))
            model, mean, sd = _fitted(x, y)
            kept = (y[:, 1:] <= 0).all(1)
            # Where nothing kept the limits the worst value counts, as in BoTorch's tutorials: any feasible point improves on it.
            best = (y[kept, 0].max() if kept.any() else y[:, 0].min()).sub(mean[0]).div(sd[0])
            limits = {k: (None, float(-mean[k] / sd[k])) for k in range(1, y.shape[1])}
            found = LogConstrainedExpectedImprovement(model, best_f=best, objective_index=0, constraints=limits)
            cube = torch.stack([torch.zeros(space.dimension), torch.ones(space.dimension)]).double()
            u, _ = optimize_acqf(found, cube, q=1, num_restarts=4, raw_samples=128)
        return space.from_unit(u.numpy())


class Scbo:
    """Constrained Thompson sampling in a trust region that grows after three successes and halves after max(4, d) failures."""

    def __init__(self, seed: int) -> None:
        self._seed, self._length, self._good, self._bad, self._seen = seed, 0.8, 0, 0, 0

    def ask(self, space: ct.ParameterSpace, trials: Sequence[Any], n: int = 1) -> NDArray[np.float64]:
        x, y = _told(space, trials)
        if len(trials) < INITIAL or len(x) < 2:
            return initial_design(space, len(trials) + 1, self._seed, len(trials), 1)
        merit = [(-max(float(v[1:].max()), 0.0), float(v[0])) for v in y]
        at = max(range(len(merit)), key=merit.__getitem__)
        if len(x) > self._seen > 0:
            success = at == len(x) - 1
            self._good, self._bad = (self._good + 1, 0) if success else (0, self._bad + 1)
            if self._good == 3:
                self._length, self._good = min(2 * self._length, 1.6), 0
            elif self._bad == max(4, space.dimension):
                self._length, self._bad = self._length / 2, 0
        self._seen = len(x)
        with torch.random.fork_rng(), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            torch.manual_seed(self._seed * 1000 + len(trials))
            model, mean, sd = _fitted(x, y)
            low, high = (x[at] - self._length / 2).clamp(0, 1), (x[at] + self._length / 2).clamp(0, 1)
            points = low + (high - low) * torch.as_tensor(sobol_points(space.dimension, self._seed + len(trials), 0, 512))
            # Only some coordinates of the best point are moved, where there are many (Regis and Shoemaker, 2013).
            moved = torch.rand(points.shape) <= min(20.0 / space.dimension, 1.0)
            points = torch.where(moved, points, x[at])
            kept = ModelListGP(*model.models[1:])
            shift = [float(-mean[k] / sd[k]) for k in range(1, y.shape[1])]
            draw = ConstrainedMaxPosteriorSampling(model.models[0], _Shifted(kept, shift), replacement=False)
            with torch.no_grad():
                u = draw(points, num_samples=1)
        return space.from_unit(u.numpy())


class _Shifted(torch.nn.Module):
    """Models of limits, so that what is at most 0 keeps them."""

    def __init__(self, model: ModelListGP, shift: Sequence[float]) -> None:
        super().__init__()
        self._model, self._shift = model, torch.tensor(shift).double()
        self.num_outputs = len(shift)

    def posterior(self, X: torch.Tensor, **more: Any) -> Any:
        found, shift = self._model.posterior(X, **more), self._shift

        class Moved:
            def rsample(self, *args: Any, **kwargs: Any) -> torch.Tensor:
                return found.rsample(*args, **kwargs) - shift

        return Moved()


class SafeGaussianProcess:
    """After SafeOpt (Berkenkamp, Krause and Schoellig, 2023): of the points whose upper bounds keep every limit the most uncertain one.

    Gaussian processes of the objective and each limit, mean +- 2 sd; considered are points that may be the best ones, and those whose
    limits are the least known (potential expanders). Begins at the declared start; a fresh Sobol set of 1000 points a trial.
    """

    def __init__(self, start: Sequence[float], seed: int) -> None:
        self._start, self._seed = np.array(start), seed

    def ask(self, space: ct.ParameterSpace, trials: Sequence[Any], n: int = 1) -> NDArray[np.float64]:
        x, y = _told(space, trials)
        if len(trials) < 2 or len(x) < 2:
            # The second one is beside the start: one point gives a Gaussian process no scale.
            beside = space.from_unit(np.clip(space.to_unit(self._start) + 0.05 * (0.5 - space.to_unit(self._start)), 0, 1))
            return np.array([self._start if not trials else beside])
        with torch.random.fork_rng():
            torch.manual_seed(self._seed * 1000 + len(trials))
            model, mean, sd = _fitted(x, y)
            near = x[torch.randint(len(x), (500,))] + 0.1 * torch.randn(500, space.dimension).double()
            cube = torch.as_tensor(sobol_points(space.dimension, self._seed + len(trials), 0, 500))
            points = torch.cat([near.clamp(0, 1), cube, x])
            with torch.no_grad():
                found = model.posterior(points)
                middle, wide = found.mean * sd + mean, 2 * found.variance.clamp_min(0).sqrt() * sd
        safe = ((middle + wide)[:, 1:] <= 0).all(1)
        if not safe.any():
            best = max(trials, key=lambda t: (t.score is not None and t.score.feasible, t.score.objective if t.score else -np.inf))
            return np.array([best.theta])
        low = (middle - wide)[safe, 0].max()
        maximiser = safe & ((middle + wide)[:, 0] >= low)
        width = (wide / sd)[:, 0] * maximiser + (wide / sd)[:, 1:].max(1).values * safe
        at = int(torch.where(safe, width, torch.full_like(width, -np.inf)).argmax())
        return space.from_unit(points[[at]].numpy())


def _told_instead(config: Any, seed: int = 0) -> float:
    """SMAC3 wants a function, and calls none where it is asked and told."""
    raise NotImplementedError


class Smac:
    """SMAC3's HyperparameterOptimizationFacade (random forest, EI) by ask and tell, theta_0 its first guess; needs ``pip install smac``."""

    def __init__(self, space: ct.ParameterSpace, seed: int) -> None:
        from ConfigSpace import ConfigurationSpace, Float
        from smac import HyperparameterOptimizationFacade as Facade
        from smac import Scenario

        cube = ConfigurationSpace(seed=seed)
        self._names = [f"u{k}" for k in range(space.dimension)]
        cube.add([Float(n, (0.0, 1.0), default=float(v)) for n, v in zip(self._names, space.to_unit(space.default), strict=True)])
        self._folder = tempfile.TemporaryDirectory()
        scenario = Scenario(cube, deterministic=True, n_trials=1000, seed=seed, output_directory=self._folder.name)
        design = Facade.get_initial_design(scenario, n_configs=INITIAL - 1, additional_configs=[cube.get_default_configuration()])
        self._smac = Facade(scenario, _told_instead, initial_design=design, overwrite=True, logging_level=40)
        self._open: Any = None

    def ask(self, space: ct.ParameterSpace, trials: Sequence[Any], n: int = 1) -> NDArray[np.float64]:
        from smac.runhistory.dataclasses import TrialValue

        if self._open is not None:
            score = trials[-1].score
            self._smac.tell(self._open, TrialValue(cost=-score.performance if score else 1e3))
        self._open = self._smac.ask()
        return space.from_unit(np.array([[self._open.config[name] for name in self._names]]))
