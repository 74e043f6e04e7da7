"""What the runs say: a row for each plant and method."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

__all__ = ["WANTED", "rows", "solved_at"]

# Trials within which a plant should be solved.
WANTED = 6


def rows(runs: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Of every plant and method that was run.

    seeds; solved: of them within `WANTED` trials; trials: the median number of trials to the first solution, None where half of them or
    more have none; over, over_max, over_sum: of the first `WANTED` trials those that broke a limit, median, largest and all; of: trials
    of a run; ask_s: median seconds of a proposal; stopped: seeds on which the tuner refused to go on.
    """
    groups: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for one in runs:
        groups.setdefault((one["plant"], one["method"]), []).append(one)
    return [_row(plant, method, own) for (plant, method), own in groups.items()]


def solved_at(run: dict[str, Any]) -> float:
    """The number of the first trial after which the recommended theta solves the plant; inf where none does."""
    return next((k + 1 for k, solved in enumerate(run["solved"]) if solved), float("inf"))


def _row(plant: str, method: str, own: list[dict[str, Any]]) -> dict[str, Any]:
    at, over = np.array([solved_at(r) for r in own]), [r["kept"][:WANTED].count(False) for r in own]
    # The larger of two middle ones, as of a number of trials there is no half; inf is no number of JSON.
    middle = float(np.sort(at)[len(at) // 2])
    return {
        "plant": plant,
        "method": method,
        "seeds": len(own),
        "solved": int(np.sum(at <= WANTED)),
        "trials": int(middle) if np.isfinite(middle) else None,
        "over": float(np.median(over)),
        "over_max": int(max(over)),
        "over_sum": int(sum(over)),
        "of": max(r["trials"] for r in own),
        "ask_s": round(float(np.median([s for r in own for s in r["ask_s"]])), 2) if any(r["ask_s"] for r in own) else None,
        "stopped": sum(bool(r["stopped"]) for r in own),
    }
