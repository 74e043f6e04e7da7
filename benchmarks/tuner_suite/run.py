"""One run: a tuner on a plant, its trials judged."""

from __future__ import annotations

import time
import warnings
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from tuner_suite.methods import Method
from tuner_suite.oracle import attainable, within
from tuner_suite.plant import SuitePlant

import chargetune as ct
from chargetune.study.result import measured_result

__all__ = ["run"]


def run(plant: SuitePlant, method: Method, seed: int, trials: int, cache: Path) -> dict[str, Any]:
    """What `tuner_suite.table` counts, an entry a trial: judged without noise, at the tolerances that the tuner is told.

    kept, loss: whether the trial kept every limit, and (best - objective) / |best| of it, None where it has no score; recommended, solved:
    the index of the trial that is recommended, and whether it kept them and is within 5 % of the best; ask_s: seconds for the proposal;
    stopped: why a tuner proposed no more.
    """
    best = attainable(plant, seed, cache)["objective"]
    tuner, told, worth = method.make(plant, seed), [], []
    out: dict[str, Any] = {"kept": [], "loss": [], "recommended": [], "solved": [], "ask_s": [], "stopped": ""}
    for number in range(trials):
        begin = time.perf_counter()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                theta = np.asarray(tuner.ask(plant.space, told, 1))[0]
            except ct.NoSafeThetaError as refused:
                out["stopped"] = str(refused)
                break
        out["ask_s"].append(round(time.perf_counter() - begin, 3))
        score, episode, ending = plant.evaluate(theta, 1000 * seed + number)
        status = "done" if score else "failed"
        told.append(
            SimpleNamespace(number=number, theta=tuple(theta), status=status, score=score, ending=ending, episode=lambda e=episode: e)
        )
        true = plant.judge(theta)
        out["kept"].append(bool(true is not None and true.feasible))
        worth.append(-np.inf if true is None else true.objective)
        out["loss"].append(None if true is None else round((best - true.objective) / abs(best), 4))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            at = _recommended(method, tuner, plant, told)
        out["recommended"].append(at)
        out["solved"].append(out["kept"][at] and within(worth[at], best))
    return out


def _recommended(method: Method, tuner: Any, plant: SuitePlant, told: list[Any]) -> int:
    if method.newest:
        return len(told) - 1
    if hasattr(tuner, "best"):
        best = tuner.best(plant.space, told)
    else:
        trial = measured_result(told).trial
        best = None if trial is None else trial.number
    return len(told) - 1 if best is None else int(best)
