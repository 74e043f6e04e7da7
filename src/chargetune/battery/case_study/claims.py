"""The twelve claims of the case study, each decided for one seed from the runs of both studies.

Source of the claims: Hirt et al., ADCHEM 2024. Study 1 tunes the voltage backoff, study 2 the model's R1.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from chargetune.battery.cell.equivalent_circuit import table_nodes
from chargetune.battery.charging.problem import ChargingProblem
from chargetune.episode.episode import Episode
from chargetune.model.splines import natural_spline_matrix
from chargetune.study.trial import Trial

__all__ = ["CLAIMS", "Claim", "SeedRun", "decide", "natural_spline_values"]

OVERSHOOT_MV = 1.0
# "Slightly" in the paper's comparison of charging times, as a share of the untuned time.
SLIGHTLY = 0.10
# How far the learned R1 may be from the plant's, as a share, and still be called the same.
SAME_RESISTANCE = 0.05
MID_SOC = 0.5


@dataclass(frozen=True)
class SeedRun:
    """One seed of one case study: its problem, the untuned trial and the tuned one (None: no trial has a score), their episodes."""

    problem: ChargingProblem
    trials: tuple[Trial, ...]
    untuned: Trial
    untuned_episode: Episode
    tuned: Trial | None
    tuned_episode: Episode | None

    def metric(self, name: str, *, tuned: bool) -> float | None:
        trial = self.tuned if tuned else self.untuned
        return None if trial is None or trial.score is None else trial.score.metrics.get(name)

    def minutes(self, name: str, *, tuned: bool) -> float:
        """A charging time; infinite when the charge did not get there."""
        value = self.metric(name, tuned=tuned)
        return np.inf if value is None else value

    @property
    def violating(self) -> int:
        """Trials that went more than 1 mV over the limit."""
        return sum(1 for t in self.trials if t.score is not None and _overshoot(t) > OVERSHOOT_MV)


Runs = Mapping[str, SeedRun]


@dataclass(frozen=True)
class Claim:
    """A statement, the studies it needs, and its test on one seed; None when the tuned controller it speaks of is missing."""

    id: int
    text: str
    needs: tuple[str, ...]
    holds: Callable[[Runs], bool]


def decide(runs: list[Runs]) -> list[dict[str, Any]]:
    """For each claim in how many seeds it holds, of those for which the studies it needs were run."""
    out = []
    for claim in CLAIMS:
        able = [r for r in runs if all(name in r for name in claim.needs)]
        out.append({"id": claim.id, "text": claim.text, "holds": sum(bool(claim.holds(r)) for r in able), "of": len(able)})
    return out


def natural_spline_values(nodes: Any, values: Any, z: Any) -> np.ndarray[Any, np.dtype[np.float64]]:
    """The natural cubic spline of `chargetune.model.splines` at numbers z."""
    grid, at = np.asarray(nodes, dtype=float), np.asarray(z, dtype=float)
    c = natural_spline_matrix(grid) @ np.asarray(values, dtype=float)
    cubes = np.maximum(0.0, at[:, None] - grid) ** 3
    return np.asarray(c[0] + c[1] * (at - grid[0]) + cubes @ c[2:])


def _overshoot(trial: Trial) -> float:
    value = None if trial.score is None else trial.score.metrics.get("overshoot_mV")
    return np.inf if value is None else value


def _safe(run: SeedRun) -> bool:
    return run.tuned is not None and _overshoot(run.tuned) <= OVERSHOOT_MV


def _backoff_falls(runs: Runs) -> bool:
    run = runs["backoff"]
    if run.tuned is None or run.problem.theta.backoff is None:
        return False
    z = np.linspace(MID_SOC, 1.0, 51)
    values = np.array(run.tuned.theta)[run.problem.space.slices["backoff_V"]]
    b = natural_spline_values(run.problem.theta.backoff.grid, values, z)
    return bool(np.polyfit(z, b, 1)[0] < 0)


def _learned_ratio(run: SeedRun) -> np.ndarray[Any, np.dtype[np.float64]] | None:
    if run.tuned is None:
        return None
    return np.array(run.tuned.theta)[run.problem.space.slices["R1_ratio"]]


def _differs_from_true(runs: Runs) -> bool:
    run = runs["model"]
    ratio = _learned_ratio(run)
    if ratio is None:
        return False
    learned = ratio * np.array(run.problem.controller_cell.R1_ohm)
    return bool(np.max(np.abs(learned / np.array(run.problem.cell.R1_ohm) - 1)) > SAME_RESISTANCE)


def _exceeds_where_violating(runs: Runs) -> bool:
    run = runs["model"]
    ratio = _learned_ratio(run)
    if ratio is None:
        return False
    start, end = run.untuned_episode.signal("voltage_V")
    _, soc = run.untuned_episode.signal("soc")
    limit = run.problem.voltage_max_V
    where = soc[np.maximum(start, end) > limit + OVERSHOOT_MV / 1000]
    if not where.size:
        return False
    cell = run.problem.cell
    nodes = table_nodes(cell.soc)
    ends = [ratio[0]] * int(cell.soc[0] > 0.0), [ratio[-1]] * int(cell.soc[-1] < 1.0)
    r1 = np.array(run.problem.controller_cell.R1_ohm)
    full = np.concatenate([[r1[0]] * len(ends[0]), r1, [r1[-1]] * len(ends[1])])
    learned = full * np.concatenate([ends[0], ratio, ends[1]])
    return bool(np.mean(natural_spline_values(nodes, learned, where)) > np.mean(natural_spline_values(nodes, full, where)))


def _faster(slow: SeedRun, fast: SeedRun, mark: str) -> bool:
    return fast.minutes(mark, tuned=True) < slow.minutes(mark, tuned=True)


def _slower_than_untuned(runs: Runs) -> bool:
    run = runs["backoff"]
    return run.tuned is not None and run.minutes("t80_min", tuned=True) > run.minutes("t80_min", tuned=False)


def _little_different(runs: Runs) -> bool:
    run = runs["model"]
    untuned = run.minutes("t95_min", tuned=False)
    return bool(np.isfinite(untuned)) and abs(run.minutes("t95_min", tuned=True) - untuned) <= SLIGHTLY * untuned


def _later_switch(runs: Runs) -> bool:
    run = runs["model"]
    return run.tuned is not None and run.minutes("switch_min", tuned=True) > run.minutes("switch_min", tuned=False)


def _same_start(runs: Runs) -> bool:
    return bool(np.array_equal(runs["backoff"].untuned_episode.input, runs["model"].untuned_episode.input))


ONE, TWO, BOTH = ("backoff",), ("model",), ("backoff", "model")
CLAIMS = (
    Claim(
        1,
        "the untuned run violates the voltage limit (more than 1 mV)",
        (),
        lambda r: _overshoot(next(iter(r.values())).untuned) > OVERSHOOT_MV,
    ),
    Claim(2, "the tuned run of study 1 (backoff) does not (at most 1 mV)", ONE, lambda r: _safe(r["backoff"])),
    Claim(3, "the learned backoff falls with SOC from mid SOC to 1 (least-squares slope)", ONE, _backoff_falls),
    Claim(4, "SOC rises more slowly in the tuned run of study 1 than untuned (t80)", ONE, _slower_than_untuned),
    Claim(5, "both studies begin with the same run", BOTH, _same_start),
    Claim(6, "the tuned run of study 2 (model) does not violate (at most 1 mV)", TWO, lambda r: _safe(r["model"])),
    Claim(7, "study 2 is faster than study 1 (t95)", BOTH, lambda r: _faster(r["backoff"], r["model"], "t95_min")),
    Claim(8, "the charging time of study 2 differs little from the unsafe untuned run (t95, at most 10 %)", TWO, _little_different),
    Claim(9, "the switch from constant current is later in study 2 than untuned", TWO, _later_switch),
    Claim(10, "more trials violate in study 2 than in study 1", BOTH, lambda r: r["model"].violating > r["backoff"].violating),
    Claim(11, "the learned R1 differs from the true one (more than 5 % at a node)", TWO, _differs_from_true),
    Claim(12, "the learned R1 exceeds the untuned R1 where the untuned run violates (mean over that SOC)", TWO, _exceeds_where_violating),
)
