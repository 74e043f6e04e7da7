"""The best theta on a plant that is known: what trials are measured against."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import cma
import numpy as np
from numpy.typing import NDArray
from tuner_suite.plant import SuitePlant

from chargetune.learning.initial_design import sobol_points

__all__ = ["attainable", "within"]

# Share of each tolerance that the oracle may use: at the whole of it a learner had to know the plant to a part of the tolerance.
SHARE = 0.5
# A solution is worth at least what the oracle's is, less this share of it.
WITHIN = 0.05
# Points, and steps and generations an entry of theta of each search.
POINTS, STEPS = 64, ((0.2, 15), (0.05, 12))
# Cost of one tolerance beyond a limit, in the objective at the start: more than any gain, so that the search ends where limits are kept.
PENALTY = 10.0


def attainable(plant: SuitePlant, seed: int, cache: Path) -> dict[str, Any]:
    """{"objective", "theta", "default", "safe"} of this plant, from the cache where it is known.

    Best of Sobol points, of the declared start, and of CMA-ES (Hansen, 2016) from the best of them, twice, on the loop without noise.
    "default" and "safe" are the objectives of theta_0 and of the declared start, None where these break a limit.
    """
    file = cache / f"{plant.name} {seed}.json"
    if file.exists():
        return json.loads(file.read_text())
    space, best = plant.space, [(-np.inf, plant.safe_theta)]

    def loss(u: NDArray[np.float64]) -> float:
        theta = space.from_unit(np.clip(u, 0.0, 1.0))
        score = plant.judge(theta)
        if score is None:
            return 1e6
        over = max(0.0, score.worst + 1.0 - SHARE)
        if not over and score.objective > best[0][0]:
            best[0] = score.objective, tuple(theta)
        return PENALTY * scale * over - score.objective

    first = plant.judge(np.array(plant.safe_theta))
    scale = abs(first.objective) if first else 1.0
    starts = [space.to_unit(np.array(plant.safe_theta)), space.to_unit(space.default), *sobol_points(space.dimension, 0, 0, POINTS)]
    at = min(starts, key=loss)
    for step, generations in STEPS:
        ends = {"maxiter": generations * space.dimension, "tolfun": 1e-5 * scale, "tolflatfitness": 8}
        es = cma.CMAEvolutionStrategy(list(at), step, ends | {"bounds": [0.0, 1.0], "seed": seed + 1, "verbose": -9})
        es.optimize(loss)
        found = space.to_unit(np.array(best[0][1]))
        at = found if np.isfinite(best[0][0]) else np.clip(es.result.xbest, 0.0, 1.0)
    kept = {n: plant.judge(np.array(t)) for n, t in (("default", space.default), ("safe", plant.safe_theta))}
    found = {"objective": best[0][0], "theta": list(best[0][1])} | {
        n: s.objective if s is not None and s.feasible else None for n, s in kept.items()
    }
    cache.mkdir(parents=True, exist_ok=True)
    part = file.with_suffix(f".{os.getpid()}")
    part.write_text(json.dumps(found))
    part.replace(file)
    return found


def within(objective: float, best: float) -> bool:
    """Whether an objective is within 5 % of the best."""
    return objective >= best - WITHIN * abs(best)
