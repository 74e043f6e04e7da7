"""The paper's studies over many mismatch seeds: run them, resume them, and say which claims hold."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, as_completed
from pathlib import Path
from typing import Any

import numpy as np

from chargetune.battery.case_study.claims import SeedRun, decide
from chargetune.battery.case_study.configurations import CASE_STUDIES, case_study
from chargetune.battery.case_study.radial_basis import SAFE_TRIALS, by_way, decide_claims, oracle, safe_study
from chargetune.battery.charging.evaluate import Evaluation, evaluate
from chargetune.battery.charging.problem import ChargingProblem, with_feedback
from chargetune.battery.studies.open_study import open_study
from chargetune.battery.studies.study_file import Config, TunerName, problem_of_document
from chargetune.episode.episode import Episode
from chargetune.runtime.interrupts import raise_lost_interrupt
from chargetune.study.result import read_result
from chargetune.study.store.store import Store
from chargetune.study.trial import Trial

__all__ = ["ATTAINABLE_T95_MIN", "reproduce", "seed_row", "seed_run", "summarise"]

# t95 in minutes that 4000 evaluations of CMA-ES reach on seeds 0-7 with U1 propagated by the controller's own model,
# overshoot at most 0.3 mV (backoff of seed 0: 2.3 mV). For "both" none is known.
ATTAINABLE_T95_MIN: dict[str, tuple[float, ...]] = {
    "backoff": (46.2, 41.4, 38.9, 47.8, 44.5, 40.7, 44.6, 46.0),
    "model": (36.4, 36.8, 36.7, 36.7, 39.0, 36.5, 36.9, 36.8),
}


FIGURES = ("overshoot_mV", "t80_min", "t95_min", "t99_min", "switch_min")


def reproduce(
    case: str,
    seeds: Sequence[int],
    *,
    trials: int,
    tuner: TunerName,
    path: Path,
    executor: Executor,
    progress: Callable[[int, dict[str, Any]], None] | None = None,
) -> list[dict[str, Any]]:
    """Run (or resume) one case study for every seed into the store ``path``; rows by seed, in the order of ``seeds``."""
    with Store(path):  # made before the workers open it
        pass
    futures = {executor.submit(_run_seed, case, seed, trials, tuner, path): seed for seed in seeds}
    rows: dict[int, dict[str, Any]] = {}
    try:
        for future in as_completed(futures):
            raise_lost_interrupt()
            seed = futures[future]
            rows[seed] = future.result()
            if progress is not None:
                progress(seed, rows[seed])
    finally:
        for future in futures:
            future.cancel()
    return [rows[seed] for seed in seeds]


def _run_seed(case: str, seed: int, trials: int, tuner: TunerName, path: Path) -> dict[str, Any]:
    config = case_study(case, seed, tuner)
    _run(path, config, trials)
    if case == "rbf":
        _run(path, safe_study(seed), min(trials, SAFE_TRIALS))
    with Store(path, read_only=True) as store:
        row = seed_row(case, seed, seed_run(store, config.study.name, trials))
        return row | _safe_twin(store, seed) if case == "rbf" else row


def _run(path: Path, config: Config, trials: int) -> None:
    with Store(path, busy_timeout_s=60.0) as store, open_study(store, config) as study:
        study.run(Evaluation(config.problem()), trials)


def _safe_twin(store: Store, seed: int) -> dict[str, Any]:
    """The part of a row that stands beside a learnt stage cost: the cautious cost, the safe twin's, the controller that knows the cell."""
    run = seed_run(store, safe_study(seed).study.name)
    known = oracle(run.problem)
    return {
        "cautious": {name: run.metric(name, tuned=False) for name in FIGURES},
        "safe_twin": None if run.tuned is None else {name: run.metric(name, tuned=True) for name in FIGURES},
        "safe_twin_trials": len(run.trials),
        "safe_twin_violating": run.violating,
        "oracle": {name: known.get(name) for name in FIGURES},
    }


def seed_run(store: Store, name: str, trials: int | None = None) -> SeedRun:
    """What the claims need of one stored study, from its first ``trials`` trials."""
    record = store.study(name)
    listed = tuple(store.trials(record.id)[:trials])
    tuned = read_result(store, record, listed).trial

    def episode(trial: Trial) -> Episode:
        trace = store.trace(record.id, trial.number)
        if trace is None:
            raise ValueError(f"{store.label}: trial {trial.number} of study {name!r} has no trace")
        return Episode.from_arrays(*trace)

    if not listed or listed[0].score is None:
        raise ValueError(f"{store.label}: study {name!r} has no finished untuned run (trial 0)")
    return SeedRun(
        problem=problem_of_document(record.identity["config"]),
        trials=listed,
        untuned=listed[0],
        untuned_episode=episode(listed[0]),
        tuned=tuned,
        tuned_episode=None if tuned is None else episode(tuned),
    )


def seed_row(case: str, seed: int, run: SeedRun) -> dict[str, Any]:
    """The row of one seed as it stands in claims.json."""

    def figures(*, tuned: bool) -> dict[str, float | None]:
        return {name: run.metric(name, tuned=tuned) for name in FIGURES}

    known = ATTAINABLE_T95_MIN.get(case, ())
    feedback = _with_feedback(run.problem)
    overshoots = [t.score.metrics["overshoot_mV"] for t in run.trials if t.score is not None]
    return {
        "seed": seed,
        "untuned": figures(tuned=False),
        "offset_free": {name: feedback.get(name) for name in FIGURES},
        "tuned": None if run.tuned is None else figures(tuned=True),
        "tuned_trial": None if run.tuned is None else run.tuned.number,
        "tuned_feasible": run.tuned is not None and run.tuned.feasible,
        "trials": len(run.trials),
        "failed_trials": sum(t.score is None for t in run.trials),
        "violating_trials": run.violating,
        "worst_excess_mV": max((o for o in overshoots if o is not None), default=None),
        "attainable_t95_min": known[seed] if seed < len(known) else None,
        "theta": None if run.tuned is None else list(run.tuned.theta),
    }


def _with_feedback(problem: ChargingProblem) -> Mapping[str, float | None]:
    """Figures of the untuned controller that reads the voltage: what needs no learning. Empty where it did not come to its end."""
    score, _, _ = evaluate(with_feedback(problem), None, 0)
    return {} if score is None else score.metrics


def _studies(folder: Path, tuner: TunerName, seeds: Sequence[int]) -> Iterator[dict[str, SeedRun]]:
    stores = {case: Store(path, read_only=True) for case in CASE_STUDIES if (path := folder / f"{case}-{tuner}.sqlite").exists()}
    try:
        names = {case: {record.name for record in store.studies() if record.trial_count} for case, store in stores.items()}
        for seed in seeds:
            yield {
                case: seed_run(store, name)
                for case, store in stores.items()
                if (name := case_study(case, seed, tuner).study.name) in names[case]
            }
    finally:
        for store in stores.values():
            store.close()


def summarise(folder: Path, case: str, tuner: TunerName, rows: list[dict[str, Any]], trials: int) -> dict[str, Any]:
    """The content of claims.json: claims over all studies of this tuner in the folder, rows of the one that was run."""
    seeds = [row["seed"] for row in rows]
    claims = decide_claims(rows) if case == "rbf" else decide(list(_studies(folder, tuner, seeds)))
    tuned = [row["tuned"] for row in rows]
    t95 = [t["t95_min"] if t and t["t95_min"] is not None else np.inf for t in tuned]
    ratios = [t / row["attainable_t95_min"] for t, row in zip(t95, rows, strict=True) if row["attainable_t95_min"]]
    safe = sum(1 for t in tuned if t and t["overshoot_mV"] <= 1.0)
    return {
        "case": case,
        "tuner": tuner,
        "trials": trials,
        "seeds": seeds,
        "claims": claims,
        "summary": {
            "safe": safe,
            "of": len(rows),
            "t95_min_median": _finite(np.median(t95)),
            "t95_min_quartiles": [_finite(q) for q in np.quantile(t95, [0.25, 0.75], method="nearest")],
            "t95_to_attainable_median": _finite(np.median(ratios)) if ratios else None,
            "violating_trials": sum(row["violating_trials"] for row in rows),
            "all_trials": sum(row["trials"] for row in rows),
            **({"ways": by_way(rows, tuner)} if case == "rbf" else {}),
        },
        "per_seed": rows,
    }


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
