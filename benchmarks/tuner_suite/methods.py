"""The tuners that are compared, by name: (plant, seed) -> something with ``ask(space, trials, 1)``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from learning_peers import CmaEs, Tpe
from numpy.typing import NDArray
from tuner_suite.peers import ConstrainedEI, SafeGaussianProcess, Scbo, Smac
from tuner_suite.plant import SuitePlant

import chargetune as ct

__all__ = ["LIGHT", "METHODS", "Method", "twins"]


@dataclass(frozen=True)
class Method:
    """How a tuner is made, and which trial it recommends after each.

    needs
        "twin" or "windows": what a plant has to have. Elsewhere the method is left out.
    newest
        It recommends the newest trial; else its ``best`` where it has one, else the best trial that kept the limits as measured.
    """

    make: Callable[[SuitePlant, int], Any]
    what: str
    needs: str = ""
    newest: bool = False


@dataclass(frozen=True)
class Uniform:
    """Uniform in the unit cube."""

    seed: int

    def ask(self, space: ct.ParameterSpace, trials: Sequence[Any], n: int = 1) -> NDArray[np.float64]:
        return space.from_unit(np.random.default_rng([self.seed, len(trials)]).uniform(size=(n, space.dimension)))


# About a third of the seconds: half the plants of each ensemble, half the rounds of the search.
LIGHT = ct.TwinSettings(plants=32, judges=64, rounds=3)


def twins(settings: ct.TwinSettings | None = None) -> dict[str, Method]:
    """The tuners with a twin; with other ``settings`` than the package's where they are given."""
    used = settings or ct.TwinSettings()
    return {
        "safe": Method(
            lambda p, seed: ct.TwinTuner(p.twin, seed=seed, safety=ct.Safety(start=p.safe_theta), settings=used),
            "chargetune's twin in safe mode, from the declared start", "twin", newest=True,
        ),
        "twin": Method(lambda p, seed: ct.TwinTuner(p.twin, seed=seed, settings=used), "chargetune's twin", "twin"),
    }  # fmt: skip


METHODS: dict[str, Method] = twins(LIGHT) | {
    "composite": Method(lambda p, seed: ct.Composite(p.windows, seed=seed), "chargetune's composite", "windows"),
    "default": Method(lambda _, seed: ct.ConstrainedLogEI(seed=seed), "chargetune's black box"),
    "ei": Method(lambda _, seed: ct.ExpectedImprovement(seed=seed), "expected improvement on the scalar performance"),
    "cei": Method(lambda _, seed: ConstrainedEI(seed), "BoTorch, log constrained expected improvement"),
    "scbo": Method(lambda _, seed: Scbo(seed), "SCBO (Eriksson and Poloczek, 2021) by BoTorch"),
    "smac": Method(lambda p, seed: Smac(p.space, seed), "SMAC3 2.4, random forest, on the scalar performance"),
    "tpe": Method(lambda p, seed: Tpe(p.space, seed), "Optuna's TPE on the scalar performance"),
    "cmaes": Method(lambda p, seed: CmaEs(p.space, seed), "CMA-ES on the scalar performance"),
    "safeopt": Method(lambda p, seed: SafeGaussianProcess(p.safe_theta, seed),
        "safe set of Gaussian processes after SafeOpt, from the declared start"),
    "random": Method(lambda _, seed: Uniform(seed), "uniform draws"),
}  # fmt: skip
