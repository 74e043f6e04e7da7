"""A stored trial, evaluated a second time from its theta and seed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chargetune.study.evaluation import Evaluate, evaluate_trial
from chargetune.study.serialization import score_to_json
from chargetune.study.store.trace import decode
from chargetune.study.trial import Trial, TrialStatus
from chargetune.verify import Difference

__all__ = ["recompute"]

# Share of a signal's largest value by which another build of the same loop may differ: solves end at a residual of 1e-8, and the loop
# carries what is left of one on to the next.
ROUNDING = 1e-6
# How a solve went, not what came of it.
OF_THE_SOLVER = ("status", "kkt", "iterations")

Trace = tuple[Mapping[str, NDArray[Any]], Mapping[str, Any]]


def recompute(evaluate: Evaluate, trial: Trial, trace: Trace | None) -> list[Difference]:
    """What differs between a told trial and an evaluation of its theta with its seed, none when it is what was stored.

    ``trace``: the stored one (`Store.trace`). Compared are the ending, every number of the score, and every array of the trace but those
    on how its solves went; of a trial over a range of use so the figures of each plant (`RangeTrace`). What the stored trial does not
    have, since its store is older, is not missed. Numbers that differ by less than 1e-6 of the largest of their kind are the same.

    Raises ValueError for a trial that is not told, and what `evaluate_trial` raises.
    """
    if trial.status not in (TrialStatus.DONE, TrialStatus.FAILED):
        raise ValueError(f"trial {trial.number}: status = {trial.status}, allowed are done and failed")
    now = evaluate_trial(evaluate, trial.theta, trial.seed)
    out = [] if now.ending == trial.ending else [Difference("ending", trial.ending, now.ending)]
    score, again = ({} if one is None else dict(_numbers("", score_to_json(one))) for one in (trial.score, now.score))
    out += [Difference(name, value, again.get(name)) for name, value in score.items() if not _alike(value, again.get(name))]
    stored, found = ({} if one is None else one[0] for one in (trace, None if now.trace is None else decode(now.trace)))
    for name, values in stored.items():
        if name.rpartition(".")[2] in OF_THE_SOLVER:
            continue
        if name not in found or found[name].shape != values.shape:
            now_is = f"shape {found[name].shape}" if name in found else "missing"
            out.append(Difference(name, f"shape {values.shape}", now_is))
        elif not _same(values, found[name]):
            out.append(Difference(name, "as stored", f"up to {np.nanmax(np.abs(values - found[name])):.3g} off"))
    return out


def _numbers(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    """Each number of nested JSON by its dotted name."""
    if isinstance(value, Mapping):
        for key, one in value.items():
            yield from _numbers(f"{name}.{key}" if name else str(key), one)
    elif isinstance(value, (list, tuple)):
        for place, one in enumerate(value):
            yield from _numbers(f"{name}[{place}]", one)
    else:
        yield name, value


def _alike(stored: float | None, found: float | None) -> bool:
    return stored == found if stored is None or found is None else _same(np.array([stored]), np.array([found]))


def _same(stored: NDArray[Any], found: NDArray[Any]) -> bool:
    # What a signal is measured against: 1 where all of it is small, so that a current of zero amperes has no relative error.
    largest = max(1.0, float(np.max(np.abs(stored[np.isfinite(stored)]), initial=0.0)))
    return bool(np.allclose(found, stored, rtol=0.0, atol=ROUNDING * largest, equal_nan=True))
