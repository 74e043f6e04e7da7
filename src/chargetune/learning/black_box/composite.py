"""Composite Bayesian optimisation without a plant model: known functions of what an episode did in each of its windows."""

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
from chargetune.runtime.counted import counted

__all__ = ["Composite", "CompositeLoop", "WindowOutputs"]

# Side of the box around theta_0, in the unit cube, in which the initial points lie.
DESIGN = 0.6
# Standard deviations: added to the predicted excess by cautious proposals, subtracted from it by exploring ones, and added to it when the
# best trial is chosen. The last is the largest: of many trials that seem feasible, the best is the one whose noise was most favourable.
CAUTION, OPTIMISM, TRUSTED = 1.0, 1.0, 2.0
# Weight of the penalty: this excess beyond the tolerance in one window, in tolerances, costs as much as one per cent of the objective.
STIFFNESS = 0.5
# Starts and iterations of the search. The penalty makes a narrow valley along the limits: with fewer iterations the search ends on its
# slope, 5 % short of the optimum.
STARTS, ITERATIONS = 2, 120
# Noise variance given to an output that was not measured, which makes it irrelevant, so that all outputs can be fitted in one batch.
# Outputs are scaled to about one.
UNKNOWN = 1e4
JITTER = 1e-6
# A window restricts theta only if its excess came closer to the limit than this multiple of the range in which it varied.
REACH = 1.0
# Lower bound of a predicted rate, approached smoothly, as a share of the rate that passes one window in the longest episode: the
# objective divides by the rate.
SLOWEST = 0.7


@dataclass(frozen=True)
class WindowOutputs:
    """One episode, cut into w windows of a variable that only increases, such as the state of charge; nan for a window never visited.

    rate (w,): mean increase of that variable per second in each window; excess (limits, w): the worst signed excess over each limit
    there, in its unit; spread (limits, w): the standard deviation of that excess due to sensor noise.
    """

    rate: NDArray[np.float64]
    excess: NDArray[np.float64]
    spread: NDArray[np.float64]


class CompositeLoop(Protocol):
    """How an episode is cut into windows, and how objective and limits follow from them."""

    @property
    def widths(self) -> NDArray[np.float64]:
        """Width of each window, shape (w,)."""
        ...

    @property
    def costs(self) -> NDArray[np.float64]:
        """Cost of one second in each window, shape (w,): the objective is -sum(costs * widths / rate)."""
        ...

    @property
    def duration_s(self) -> float:
        """Longest duration of an episode."""
        ...

    @property
    def tolerances(self) -> NDArray[np.float64]:
        """Largest excess over each limit that still counts as kept, shape (limits,)."""
        ...

    def window_outputs(self, episode: Episode) -> WindowOutputs:
        """What a measured episode did in each window."""
        ...


@dataclass(frozen=True)
class Composite:
    """Bayesian optimisation of a composite function g(h(theta)): h is learnt, g is known.

    h(theta) = (rate and excess of each window) are independent Gaussian processes, Matern 5/2 with ARD and known noise. The objective
    g(h) = -sum(costs * widths / rate) and the limits excess <= tolerance are known functions of h. Only the windows have to be learnt;
    each depends on few entries of theta, and nearly linearly. The proposal is the theta of

        max g(mean rate + o sd) - penalty * sum max(0, mean excess + c sd - tolerance)^2

    alternately cautious (c = 1, o = 0) and optimistic (c = -1, o = 1). The optimistic one explores: it tries what would be better if the
    limits were kept. The first trials are theta_0 and ``n_initial`` Sobol points around it. Aborted and failed trials are learnt from as
    far as their traces go. For running trials and earlier thetas of a batch the predicted means count as measured (kriging believer,
    Ginsbourger 2010).
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
                data = data.kriging_believer(u)
            for k in range(n - len(first)):
                if not len(data.x):
                    proposed.append(sobol_points(space.dimension, self.seed, self.n_initial + len(trials) + k, 1)[0])
                    continue
                u = self._proposal(data, len(trials) + len(proposed), failed, seed + 7919 * k)
                proposed.append(u)
                if k + 1 < n - len(first):
                    data = data.kriging_believer(u)
        return space.from_unit(np.vstack([first, *proposed]))

    def best(self, space: ParameterSpace, trials: Sequence[TrialLike]) -> int | None:
        """Index of the trial that is best as the processes predict it, not as it was measured: noise flatters some. None without traces."""
        data = _Data.of(self.loop, space, trials)
        if not len(data.x):
            return None
        with reproducible(self.seed):
            return data.numbers[_Surrogate(data).incumbent]

    def _design(self, space: ParameterSpace) -> NDArray[np.float64]:
        centre = space.to_unit(space.default)
        corner = np.clip(centre - DESIGN / 2, 0.0, 1.0 - DESIGN)
        points = sobol_points(space.dimension, self.seed, 0, self.n_initial) if self.n_initial else np.empty((0, space.dimension))
        return np.vstack([centre, corner + DESIGN * points])

    def _proposal(self, data: _Data, count: int, failed: list[NDArray[np.float64]], seed: int) -> NDArray[np.float64]:
        surrogate = _Surrogate(data)
        cautious = (count - self.n_initial) % 2 == 1
        merit = _Merit(surrogate, CAUTION if cautious else -OPTIMISM, 0.0 if cautious else OPTIMISM)
        d = data.x.shape[1]
        points = torch.cat([candidates(d, seed, surrogate.x[surrogate.incumbent]), surrogate.x])
        away = AwayFromFailures(merit, torch.as_tensor(np.array(failed).reshape(-1, d)))
        # The newest two trials enclose the optimum: the cautious one kept the limits, the optimistic one was faster.
        return maximise(away, points, data.x, starts=STARTS, also=surrogate.x[-STARTS:], iterations=ITERATIONS).numpy()


@dataclass(frozen=True)
class _Data:
    """Thetas x (n, d) in the unit cube, outputs (n, m), nan where unknown, and their noise sd; ``numbers`` are indices of the trials."""

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
                known.append((index, space.to_unit(np.array(trial.theta)), loop.window_outputs(episode)))
        windows, limits = len(loop.widths), len(loop.tolerances)
        return cls(
            loop,
            np.array([u for _, u, _ in known]).reshape(-1, space.dimension),
            tuple(index for index, _, _ in known),
            np.array([p.rate for *_, p in known]).reshape(-1, windows),
            np.array([p.excess for *_, p in known]).reshape(-1, limits * windows),
            np.array([p.spread for *_, p in known]).reshape(-1, limits * windows),
        )

    def kriging_believer(self, u: NDArray[np.float64]) -> _Data:
        """The same data and one more trial at u, whose outputs are the predicted means (kriging believer)."""
        if not len(self.x):
            return self
        surrogate = _Surrogate(self)
        with torch.no_grad():
            rate, _ = surrogate.rates(torch.as_tensor(u)[None])
            excess, _ = surrogate.excesses(torch.as_tensor(u)[None])
        filled = np.full(self.excess.shape[1], np.nan)
        filled[surrogate.near] = excess[0].numpy()
        return _Data(
            self.loop,
            np.vstack([self.x, u]),
            (*self.numbers, -1),
            np.vstack([self.rate, rate[0].numpy()]),
            np.vstack([self.excess, filled]),
            np.vstack([self.spread, np.nan_to_num(np.nanmean(self.spread, axis=0))]),
        )


class _Surrogate:
    """Gaussian processes of the rate of each window, and of the excess of each window that can restrict theta, fitted to the trials."""

    def __init__(self, data: _Data) -> None:
        loop = data.loop
        self.x = torch.as_tensor(data.x)
        self.near = _near(data.excess)
        each = np.repeat(loop.tolerances, len(loop.widths))[self.near]
        spread = data.spread[:, self.near]
        self.tolerances = torch.as_tensor(each)
        # Unit of the penalty: at least the noise, because an excess within the noise does not justify a much slower theta.
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
        """g of rates (..., w); smooth and finite also where a predicted rate is 0 or negative."""
        rate = self._least * (torch.nn.functional.softplus(rate / self._least) + 1e-2)
        return -(self._costs * self._widths / rate).sum(-1)

    def merit(self, x: torch.Tensor, caution: float, optimism: float) -> torch.Tensor:
        """g(rate + optimism sd) in per cent, minus the penalty on (excess + caution sd) beyond the tolerance; x (b, d) -> (b,)."""
        mean, sd = self.rates(x)
        excess, deviation = self.excesses(x)
        over = (excess + caution * deviation - self.tolerances).clamp_min(0.0) / self.units
        value: torch.Tensor = 100.0 / self.scale * self.objective(mean + optimism * sd) - (over / STIFFNESS).square().sum(-1)
        return value


class _Processes:
    """m independent Gaussian processes on the same inputs; a call with points (b, d) gives mean and sd, each (b, m)."""

    def __init__(self, x: NDArray[np.float64], y: NDArray[np.float64], spread: NDArray[np.float64]) -> None:
        self._count = y.shape[1]
        if not self._count:
            return
        known = np.isfinite(y)
        count = np.maximum(known.sum(0), 1)
        mean = np.where(known, y, 0.0).sum(0) / count
        sd = np.sqrt((np.where(known, y - mean, 0.0) ** 2).sum(0) / count)
        # Lower bound of the scale, the median of all windows: a window that has not changed yet can still change as the others do.
        least = float(np.median(sd[sd > 0])) if np.any(sd > 0) else 1.0
        scale = np.maximum(sd, least)
        self._mean, self._scale = torch.as_tensor(mean), torch.as_tensor(scale)
        scaled = torch.as_tensor(np.where(known, (y - mean) / scale, 0.0))
        variance = torch.as_tensor(np.where(known, (np.nan_to_num(spread) / scale) ** 2 + JITTER, UNKNOWN))
        self.model = _fitted(torch.as_tensor(x), scaled, variance)

    def __call__(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        if not self._count:
            return x.new_empty(len(x), 0), x.new_empty(len(x), 0)
        # GPyTorch warns of predictions at the training points, which are wanted here.
        with gpytorch.settings.debug(state=False):
            found: Any = self.model(x.expand(self._count, *x.shape) if self._count > 1 else x)
        mean, variance = found.mean.reshape(self._count, -1).T, found.variance.reshape(self._count, -1).T
        return mean * self._scale + self._mean, variance.clamp_min(1e-12).sqrt() * self._scale


def _fitted(x: torch.Tensor, y: torch.Tensor, variance: torch.Tensor) -> SingleTaskGP:
    batch = torch.Size([y.shape[1]]) if y.shape[1] > 1 else torch.Size()

    def fresh() -> SingleTaskGP:
        kernel = get_covar_module_with_dim_scaled_prior(ard_num_dims=x.shape[1], batch_shape=batch, use_rbf_kernel=False)
        with warnings.catch_warnings():
            # BoTorch warns of outputs that are not standardised. They are scaled above, where unknown values are left out of mean and sd.
            warnings.simplefilter("ignore")
            return SingleTaskGP(x, y, train_Yvar=variance, covar_module=kernel, outcome_transform=None)

    model = fitted(fresh, f"the model of {counted(len(x), 'trial')}", attempts=1, iterations=FIT_ITERATIONS)
    model.eval()
    return model


def _near(excess: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which windows can restrict theta: those whose excess came closer to the limit than `REACH` times the range of its values."""
    known = np.isfinite(excess)
    worst = np.where(known, excess, -np.inf).max(axis=0, initial=-np.inf)
    least = np.where(known, excess, np.inf).min(axis=0, initial=np.inf)
    seen = known.any(axis=0)
    return np.asarray(seen & (worst > -REACH * np.where(seen, worst - least, 0.0)))


class _Merit(AcquisitionFunction):
    """`_Surrogate.merit` with the interface of a BoTorch acquisition function."""

    def __init__(self, surrogate: _Surrogate, caution: float, optimism: float) -> None:
        super().__init__(model=surrogate.rates.model)
        self._surrogate, self._caution, self._optimism = surrogate, caution, optimism

    @t_batch_mode_transform(expected_q=1, assert_output_shape=False)  # type: ignore[arg-type] # it types self as the base class
    def forward(self, X: torch.Tensor) -> torch.Tensor:
        """X (b, 1, d) -> (b,)."""
        return self._surrogate.merit(X[:, 0], self._caution, self._optimism)
