"""CMA-ES and TPE from their own packages as tuners: they see the scalar performance G of each trial, as published."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cma
import numpy as np
import optuna
from numpy.typing import NDArray

from chargetune.model.parameter_space import ParameterSpace

__all__ = ["CmaEs", "Tpe"]


class CmaEs:
    """cma.CMAEvolutionStrategy in the unit cube from theta_0, step 0.2; failed trials count as the worst."""

    def __init__(self, space: ParameterSpace, seed: int) -> None:
        self._space, self._waiting = space, []  # type: ignore[var-annotated]
        options = {"bounds": [0.0, 1.0], "seed": seed + 1, "verbose": -9}
        self._strategy = cma.CMAEvolutionStrategy(list(space.to_unit(space.default)), 0.2, options)

    def ask(self, space: ParameterSpace, trials: Sequence[Any], n: int = 1) -> NDArray[np.float64]:
        if not self._waiting:
            size = self._strategy.popsize
            if len(trials) >= size:
                generation = trials[-size:]
                values = [-t.score.performance if t.score else 1e3 for t in generation]
                self._strategy.tell([space.to_unit(np.array(t.theta)) for t in generation], values)
            self._waiting = list(self._strategy.ask())
        return np.array([space.from_unit(np.clip(self._waiting.pop(0), 0.0, 1.0))])


class Tpe:
    """optuna's TPESampler in the unit cube, theta_0 first."""

    def __init__(self, space: ParameterSpace, seed: int) -> None:
        optuna.logging.set_verbosity(optuna.logging.ERROR)
        self._names = [f"u{i}" for i in range(space.dimension)]
        self._study = optuna.create_study(direction="maximize", sampler=optuna.samplers.TPESampler(seed=seed))
        self._study.enqueue_trial(dict(zip(self._names, space.to_unit(space.default).tolist(), strict=True)))
        self._open: Any = None

    def ask(self, space: ParameterSpace, trials: Sequence[Any], n: int = 1) -> NDArray[np.float64]:
        if self._open is not None:
            score = trials[-1].score
            self._study.tell(self._open, score.performance if score else -1e3)
        self._open = self._study.ask()
        return np.array([space.from_unit(np.array([self._open.suggest_float(name, 0.0, 1.0) for name in self._names]))])
