"""The study of a learnt stage cost: sixteen weights of a radial-basis network, by Bayesian optimisation and by the safe twin.

Source of what is repeated: Hirt et al., "Safe Learning-Based Optimization of Model Predictive Control: Application to Battery
Fast-Charging", arXiv 2410.04982 (2024), of which the abstract is used. Cell, mismatch, horizon and limits are those of the first case
study; the network's centres, widths and bounds are assumed (`RadialBasis`), and so is the tuner.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from chargetune.battery.case_study.claims import OVERSHOOT_MV
from chargetune.battery.case_study.configurations import CASE_STUDIES
from chargetune.battery.charging.evaluate import evaluate
from chargetune.battery.charging.problem import ChargingProblem
from chargetune.battery.charging.radial_basis import RadialBasis
from chargetune.battery.charging.settings import ControllerSettings, SafetySettings
from chargetune.battery.charging.tunables import Tunables
from chargetune.battery.studies.study_file import Config, StudyTable

__all__ = ["CLAIMS", "SAFE_TRIALS", "by_way", "cautious", "decide_claims", "oracle", "safe_study"]

# The twin has what it gets after three or four charges.
SAFE_TRIALS = 5
# Weights of the cautious cost over the voltage, as shares of their upper bound: on mismatch seeds 0 to 19 it stays 25 mV below the limit.
CAUTIOUS = (0.0, 0.5, 1.0, 1.0)


def cautious(cost: RadialBasis) -> list[float]:
    """Weights with which the voltage stays far from its limit whatever the resistance, for four centres over the voltage."""
    return [share * cost.upper for _ in range(cost.soc_nodes) for share in CAUTIOUS]


def safe_study(mismatch_seed: int) -> Config:
    """The same weights, learnt by the twin, which tries only what it predicts to be safe, from the cautious cost on."""
    theta = CASE_STUDIES["rbf"]
    start = {"rbf_weight": cautious(theta.rbf)} if theta.rbf else {}
    return Config(
        study=StudyTable(name=f"rbf seed {mismatch_seed} safe twin", tuner="twin", seed=mismatch_seed),
        controller=ControllerSettings(mismatch_seed=mismatch_seed),
        theta=theta,
        safety=SafetySettings(start=start),
    )


def oracle(problem: ChargingProblem) -> Mapping[str, float | None]:
    """Figures of the untuned controller whose model is the cell; empty where its charge did not come to its end."""
    score, _, _ = evaluate(replace(problem, controller=replace(problem.controller, mismatch_seed=None), theta=Tunables()), None, 0)
    return {} if score is None else score.metrics


@dataclass(frozen=True)
class RowClaim:
    """A statement of the abstract, and its test on the row of one seed."""

    id: int
    text: str
    holds: Callable[[Mapping[str, Any]], bool]


def _keeps(row: Mapping[str, Any], of: str) -> bool:
    return bool(row[of]) and row[of]["overshoot_mV"] is not None and row[of]["overshoot_mV"] <= OVERSHOOT_MV


def _never_over(row: Mapping[str, Any], violating: str) -> bool:
    return bool(row[violating] == 0)


def _faster(row: Mapping[str, Any], of: str) -> bool:
    """It reaches 80 %, and the cautious cost does not or later."""
    mine, before = (row[of] or {}).get("t80_min"), row["cautious"].get("t80_min")
    return mine is not None and (before is None or mine < before)


def _claims(first: int, who: str, of: str, violating: str) -> tuple[RowClaim, ...]:
    return (
        RowClaim(first, f"{who}: the learnt cost keeps the limit (at most 1 mV)", partial(_keeps, of=of)),
        RowClaim(first + 1, f"{who}: no trial on the way is over the limit", partial(_never_over, violating=violating)),
        RowClaim(first + 2, f"{who}: it charges faster than the cautious cost (t80)", partial(_faster, of=of)),
    )


CLAIMS = (
    *_claims(1, "Bayesian optimisation", "tuned", "violating_trials"),
    *_claims(4, "safe twin", "safe_twin", "safe_twin_violating"),
)


def decide_claims(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """For each claim in how many seeds it holds."""
    return [{"id": claim.id, "text": claim.text, "holds": sum(bool(claim.holds(row)) for row in rows), "of": len(rows)} for claim in CLAIMS]


def by_way(rows: Sequence[Mapping[str, Any]], tuner: str) -> list[dict[str, Any]]:
    """Each way of charging over all seeds: how many keep the limit within 1 mV, the worst of them, medians of the times, trials over it.

    A seed that does not get to an SOC takes longer than any other; a median of such ones is None.
    """
    ways = (
        ("untuned", "untuned", None, None),
        ("offset-free", "offset_free", None, None),
        ("cautious cost", "cautious", None, None),
        (f"weights, {tuner}", "tuned", "trials", "violating_trials"),
        ("weights, safe twin", "safe_twin", "safe_twin_trials", "safe_twin_violating"),
        ("oracle", "oracle", None, None),
    )
    out = []
    for name, of, trials, violating in ways:
        over = [value for row in rows if row[of] and (value := row[of]["overshoot_mV"]) is not None]
        times: dict[str, float | None] = {}
        for mark in ("t80_min", "t95_min"):
            values = [np.inf if (row[of] or {}).get(mark) is None else row[of][mark] for row in rows]
            middle = float(np.median(values))
            times[f"{mark}_median"] = middle if np.isfinite(middle) else None
        out.append(
            {
                "name": name,
                "safe": sum(value <= OVERSHOOT_MV for value in over),
                "of": len(rows),
                "worst_mV": max(over, default=None),
                **times,
                "trials": None if trials is None else sum(row[trials] for row in rows),
                "violating_trials": None if violating is None else sum(row[violating] for row in rows),
            }
        )
    return out
