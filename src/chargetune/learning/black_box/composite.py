"""Bayesian optimisation of known functions of many outputs: what an episode did in each of its windows, no model of the plant."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import gpytorch
import numpy as np
import torch
from botorch.acquisition.acquisition import AcquisitionFunction
from botorch.models import SingleTaskGP
from botorch.models.utils.gpytorch_modules import get_covar_module_with_dim_scaled_prior
from botorch.utils.transforms import t_batch_mode_transform
from numpy.typing import NDArray

from chargetune.episode.episode import Episode
from chargetune.learning.black_box.failure_penalty import AwayFromFailures
from chargetune.learning.black_box.gaussian_process import FIT_ITERATIONS, fitted
from chargetune.learning.black_box.optimize_acquisition import candidates, maximise, reproducible
from chargetune.learning.initial_design import sobol_points
from chargetune.learning.tuner import TrialLike, check_count
from chargetune.model.parameter_space import ParameterSpace

__all__ = ["Composite", "CompositeLoop", "Passage"]

# Side of the box about theta_0, in the unit cube, that the first points are spread over.
DESIGN = 0.6
# Standard deviations added to an excess by the cautious proposals, taken off it by those that explore, and added before a trial is
# called the best: of many that seem to keep the limits the one that seems best is the one that noise flatters most.
CAUTION, OPTIMISM, TRUSTED = 1.0, 1.0, 2.0
# A per cent of the objective weighs as much as this excess beyond the tolerance, in tolerances, in one window.
STIFFNESS = 0.5
# The penalty makes a narrow valley along the limits: fewer iterations end on its slope, 5 % short of the best.
STARTS, ITERATIONS = 2, 120
# An output that was not measured is told with this variance, so that all are fitted in one go. Outputs are scaled to about one.
UNKNOWN = 1e4
JITTER = 1e-6
# A window whose excess was never closer to its limit than its own range is left out.
REACH = 1.0
# Rates below this share of what passes a window in a whole episode are smoothly replaced by it.
SLOWEST = 0.7


@dataclass(frozen=True)
class Passage:
    """One episode in w windows of a progress that it passes through once, such as the state of charge; nan where it never was.

    rate (w,): progress per second in each window; excess (limits, w): the worst signed excess of each limit there, in its unit;
    spread (limits, w): the standard deviation of that number by sensor noise.
    """

    rate: NDArray[np.float64]
    excess: NDArray[np.float64]
    spread: NDArray[np.float64]


class CompositeLoop(Protocol):
    """How an episode is cut into windows, and what is wanted of them."""

    @property
    def widths(self) -> NDArray[np.float64]:
        """Progress that each window is wide, shape (w,)."""
        ...

    @property
    def costs(self) -> NDArray[np.float64]:
        """What a second in each window costs, shape (w,): the objective is -sum(costs * widths / rate)."""
        ...

    @property
    def duration_s(self) -> float:
        """Longest duration of an episode."""
        ...

    @property
    def tolerances(self) -> NDArray[np.float64]:
        """The excess of each limit that is still called kept, shape (limits,)."""
        ...

    def passage(self, episode: Episode) -> Passage: ...


@dataclass(frozen=True)
class Composite:
    """The theta that is best for the windows' outputs as Gaussian processes of theta predict them.

    h(theta) = (rate and excess of each window) are independent processes, Matern 5/2 with ARD, their noise known. Objective
    g(h) = -sum(costs * widths / rate) and limits h <= tolerance are known functions of them, so that a window, which depends on
    few entries of theta and nearly linearly, is all that has to be learnt. Proposed is

        max g(mean rate + o sd) - penalty * sum max(0, mean excess + c sd - tolerance)^2

    by turns cautious (c = 1, o = 0) and optimistic (c = -1, o = 1): what would be better if it were so is tried. After
    theta_0 and ``n_initial`` Sobol points about it. Cut-short and failed trials teach by their traces. Running trials and the
    earlier thetas of a batch are taken as if they had shown their means.
    Source: Astudillo and Frazier, ICML 2019 (composite functions); Xu et al., PMLR 211 (2023) 1 (optimism about limits).
    """

    loop: CompositeLoop
    seed: int = 0
    n_initial: int = 8

    def __post_init__(self) -> None:
        if isinstance(self.n_initial, bool) or not isinstance(self.n_initial, int) or self.n_initial < 0:
            raise ValueError(f"composite: n_initial = {self.n_initial!r}, allowed is an integer >= 0")

    def ask(self, space: ParameterSpace, trials: Sequence[TrialLike], n: int = 1) -> NDArray[np.float64]:
        """The next ``n`` thetas, shape (n, d)."""
        check_count(n)
        first = self._design(space)[len(trials) : len(trials) + n]
        if len(first) == n:
            return space.from_unit(first)
        data = _Data.of(self.loop, space, trials)
        pending = [space.to_unit(np.array(t.theta)) for t in trials if t.score is None and t.status == "running"]
        pending += list(first)
        failed = [space.to_unit(np.array(t.theta)) for t in trials if t.score is None and t.status != "running"]
        proposed: list[NDArray[np.float64]] = []
        seed = self.seed * 100_003 + len(trials)
        with reproducible(seed):
            for u in pending:
                data = data.believing(u)
            for k in range(n - len(first)):
                if not len(data.x):
                    proposed.append(sobol_points(space.dimension, self.seed, self.n_initial + len(trials) + k, 1)[0])
                    continue
                u = self._proposal(data, len(trials) + len(proposed), failed, seed + 7919 * k)
                proposed.append(u)
                if k + 1 < n - len(first):
                    data = data.believing(u)
        return space.from_unit(np.vstack([first, *proposed]))

    def best(self, space: ParameterSpace, trials: Sequence[TrialLike]) -> int | None:
        """Index of the trial that is believed best: no single measurement decides whether it kept the limits. None without traces."""
        data = _Data.of(self.loop, space, trials)
        if not len(data.x):
            return None
        with reproducible(self.seed):
            return data.numbers[_Belief(data).incumbent]

    def _design(self, space: ParameterSpace) -> NDArray[np.float64]:
        centre = space.to_unit(space.default)
        corner = np.clip(centre - DESIGN / 2, 0.0, 1.0 - DESIGN)
        points = sobol_points(space.dimension, self.seed, 0, self.n_initial) if self.n_initial else np.empty((0, space.dimension))
        return np.vstack([centre, corner + DESIGN * points])

    def _proposal(self, data: _Data, count: int, failed: list[NDArray[np.float64]], seed: int) -> NDArray[np.float64]:
        ensemble = _Belief(data)
        cautious = (count - self.n_initial) % 2 == 1
        merit = _Merit(ensemble, CAUTION if cautious else -OPTIMISM, 0.0 if cautious else OPTIMISM)
        d = data.x.shape[1]
        points = torch.cat([candidates(d, seed, ensemble.x[ensemble.incumbent]), ensemble.x])
        away = AwayFromFailures(merit, torch.as_tensor(np.array(failed).reshape(-1, d)))
        # The newest trials are the two sides of what is sought: one kept the limits, the other was quicker.
        return maximise(away, points, data.x, starts=STARTS, also=ensemble.x[-STARTS:], iterations=ITERATIONS).numpy()


@dataclass(frozen=True)
class _Data:
    """x (n, d) in the unit cube; outputs (n, m), nan where unknown, and their noise; ``numbers`` are indices of the trials."""

    loop: CompositeLoop
    x: NDArray[np.float64]
    numbers: tuple[int, ...]
    rate: NDArray[np.float64]
    excess: NDArray[np.float64]
    spread: NDArray[np.float64]

    @classmethod
    def of(cls, loop: CompositeLoop, space: ParameterSpace, trials: Sequence[TrialLike]) -> _Data:
        known = []
        for index, trial in enumerate(trials):
            reader = getattr(trial, "episode", None)
            episode = None if reader is None else reader()
            if episode is not None and len(episode) > 1:
                known.append((index, space.to_unit(np.array(trial.theta)), loop.passage(episode)))
        windows, limits = len(loop.widths), len(loop.tolerances)
        return cls(
            loop,
            np.array([u for _, u, _ in known]).reshape(-1, space.dimension),
            tuple(index for index, _, _ in known),
            np.array([p.rate for *_, p in known]).reshape(-1, windows),
            np.array([p.excess for *_, p in known]).reshape(-1, limits * windows),
            np.array([p.spread for *_, p in known]).reshape(-1, limits * windows),
        )

    def believing(self, u: NDArray[np.float64]) -> _Data:
        """With what is expected at u told as if it were measured."""
        if not len(self.x):
            return self
        ensemble = _Belief(self)
        with torch.no_grad():
            rate, _ = ensemble.rates(torch.as_tensor(u)[None])
            excess, _ = ensemble.excesses(torch.as_tensor(u)[None])
        filled = np.full(self.excess.shape[1], np.nan)
        filled[ensemble.near] = excess[0].numpy()
        return _Data(
            self.loop,
            np.vstack([self.x, u]),
            (*self.numbers, -1),
            np.vstack([self.rate, rate[0].numpy()]),
            np.vstack([self.excess, filled]),
            np.vstack([self.spread, np.nan_to_num(np.nanmean(self.spread, axis=0))]),
        )


class _Belief:
    """The processes of the rates and of the excess of each window that matters, fitted to the trials so far."""

    def __init__(self, data: _Data) -> None:
        loop = data.loop
        self.x = torch.as_tensor(data.x)
        self.near = _near(data.excess)
        each = np.repeat(loop.tolerances, len(loop.widths))[self.near]
        spread = data.spread[:, self.near]
        self.tolerances = torch.as_tensor(each)
        # What noise can make of an excess is not worth a large step back.
        noise = np.array([np.median(column[np.isfinite(column)]) for column in spread.T])
        self.units = torch.as_tensor(np.maximum(np.hypot(each, noise), 1e-12))
        self._widths, self._costs = torch.as_tensor(loop.widths), torch.as_tensor(loop.costs)
        self._least = SLOWEST * self._widths / loop.duration_s
        self.rates = _Processes(data.x, data.rate, np.zeros_like(data.rate))
        self.excesses = _Processes(data.x, data.excess[:, self.near], spread)
        with torch.no_grad():
            objective = self.objective(self.rates(self.x)[0])
            self.scale = float(objective.abs().median()) or 1.0
            self.incumbent = int(self.merit(self.x, TRUSTED, 0.0).argmax())

    def objective(self, rate: torch.Tensor) -> torch.Tensor:
        """g of rates (..., w); smooth and finite where a rate is none."""
        rate = self._least * (torch.nn.functional.softplus(rate / self._least) + 1e-2)
        return -(self._costs * self._widths / rate).sum(-1)

    def merit(self, x: torch.Tensor, caution: float, optimism: float) -> torch.Tensor:
        """g(rate + optimism sd) in per cent, less the squared excess of mean + caution sd beyond the tolerance; x (b, d) -> (b,)."""
        mean, sd = self.rates(x)
        excess, deviation = self.excesses(x)
        over = (excess + caution * deviation - self.tolerances).clamp_min(0.0) / self.units
        value: torch.Tensor = 100.0 / self.scale * self.objective(mean + optimism * sd) - (over / STIFFNESS).square().sum(-1)
        return value


class _Processes:
    """m independent processes on the same points, mean and sd (b, m) at points (b, d)."""

    def __init__(self, x: NDArray[np.float64], y: NDArray[np.float64], spread: NDArray[np.float64]) -> None:
        self._count = y.shape[1]
        if not self._count:
            return
        known = np.isfinite(y)
        count = np.maximum(known.sum(0), 1)
        mean = np.where(known, y, 0.0).sum(0) / count
        sd = np.sqrt((np.where(known, y - mean, 0.0) ** 2).sum(0) / count)
        # Windows of one kind move by about as much: one that did not move yet is not bound to stay.
        least = float(np.median(sd[sd > 0])) if np.any(sd > 0) else 1.0
        scale = np.maximum(sd, least)
        self._mean, self._scale = torch.as_tensor(mean), torch.as_tensor(scale)
        scaled = torch.as_tensor(np.where(known, (y - mean) / scale, 0.0))
        variance = torch.as_tensor(np.where(known, (np.nan_to_num(spread) / scale) ** 2 + JITTER, UNKNOWN))
        self.model = _fitted(torch.as_tensor(x), scaled, variance)

    def __call__(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        if not self._count:
            return x.new_empty(len(x), 0), x.new_empty(len(x), 0)
        # The processes are asked at points they were fitted to as well.
        with gpytorch.settings.debug(state=False):
            found: Any = self.model(x.expand(self._count, *x.shape) if self._count > 1 else x)
        mean, variance = found.mean.reshape(self._count, -1).T, found.variance.reshape(self._count, -1).T
        return mean * self._scale + self._mean, variance.clamp_min(1e-12).sqrt() * self._scale


def _fitted(x: torch.Tensor, y: torch.Tensor, variance: torch.Tensor) -> SingleTaskGP:
    batch = torch.Size([y.shape[1]]) if y.shape[1] > 1 else torch.Size()

    def fresh() -> SingleTaskGP:
        kernel = get_covar_module_with_dim_scaled_prior(ard_num_dims=x.shape[1], batch_shape=batch, use_rbf_kernel=False)
        with warnings.catch_warnings():
            # Scaled by hand, because unknown values have no part in mean and sd.
            warnings.simplefilter("ignore")
            return SingleTaskGP(x, y, train_Yvar=variance, covar_module=kernel, outcome_transform=None)

    model = fitted(fresh, f"the model of {len(x)} trials", attempts=1, iterations=FIT_ITERATIONS)
    model.eval()
    return model


def _near(excess: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which windows may restrict theta: those whose excess came closer to the limit than it varied."""
    known = np.isfinite(excess)
    worst = np.where(known, excess, -np.inf).max(axis=0, initial=-np.inf)
    least = np.where(known, excess, np.inf).min(axis=0, initial=np.inf)
    seen = known.any(axis=0)
    return np.asarray(seen & (worst > -REACH * np.where(seen, worst - least, 0.0)))


class _Merit(AcquisitionFunction):
    """`_Belief.merit` as BoTorch asks for it."""

    def __init__(self, ensemble: _Belief, caution: float, optimism: float) -> None:
        super().__init__(model=ensemble.rates.model)
        self._belief, self._caution, self._optimism = ensemble, caution, optimism

    @t_batch_mode_transform(expected_q=1, assert_output_shape=False)  # type: ignore[arg-type] # it types self as the base class
    def forward(self, X: torch.Tensor) -> torch.Tensor:
        """X (b, 1, d) -> (b,)."""
        return self._belief.merit(X[:, 0], self._caution, self._optimism)
