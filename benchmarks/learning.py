"""How many trials each tuner needs, and what it breaks on the way: true values of plants that the learner sees through noise.

    python benchmarks/learning.py --plant ecm --study r0 --methods safe,twin,ilc,default --seeds 0:20 --trials 4 --json

A row is one method after one number of trials. Solved: the true, noise-free excess of the theta that the learner recommends
is at most 1 mV, any other limit kept within its tolerance, and its t95 within 1.05 of the attainable one. Recommended is the
best that is believed to keep the limits by twin and composite (their `best`), the newest theta by safe and ilc, the best
that kept the limits as measured by the others. Safe is told this tolerance, the others half of it.
Attainable: the least t95 with at most 0.5 mV over the limit (1 mV where no theta has less) that searches on the true plant from
several starts find, computed here and kept in --cache; on a DFN plant t80 stands for t95 in every key. Where no
theta keeps the limit, nothing is solved. A safe learner that knows no safe theta stops. ask_s is wall time, for which --workers 1
leaves both cores to the learner.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
import warnings
from collections.abc import Callable, Collection
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from learning_peers import CmaEs, Tpe
from learning_plants import DFN, PLANTS, STUDIES, UnknownCell, exact, make_problem
from rich.console import Console
from rich.progress import track
from rich.table import Column, Table

from chargetune import learning
from chargetune.battery.charging.evaluate import evaluate, run_charge
from chargetune.battery.charging.soc_windows import ChargingWindows
from chargetune.battery.charging.twin_loop import ChargingTwin
from chargetune.battery.charging.verdict import charge_samples, score_episode
from chargetune.learning.closed_loop.search import Search
from chargetune.learning.initial_design import sobol_points
from chargetune.learning.twin.settings import TwinSettings
from chargetune.study.result import measured_result

WITHIN, EXCESS_MV, FAR_MV = 1.05, 1.0, 5.0
# Share of the objective that an iteration towards the attainable optimum has to win.
GAIN = 1e-5
NEWEST, BELIEVED = ("safe", "ilc"), ("twin", "composite")
# Who promises to keep a limit is told the tolerance that it is judged by, the others half of it.
PROMISING, SHARE_TOLD = ("safe",), 0.5


def _safe(problem: Any, seed: int) -> Any:
    # The corner that is declared safe: largest resistances, largest backoff.
    start = tuple(float(v) for v in problem.space.upper)
    return learning.TwinTuner(_twin(problem), seed=seed, safety=learning.Safety(start=start))


def _twin(problem: Any) -> ChargingTwin:
    unknown = isinstance(problem.plant, UnknownCell)
    return ChargingTwin(problem, capacity_spread=0.03, soc_spread=0.012, ocv_spread_V=0.003) if unknown else ChargingTwin(problem)


METHODS = {
    "safe": _safe,
    "twin": lambda problem, seed: learning.TwinTuner(_twin(problem), seed=seed),
    "ilc": lambda problem, _: learning.IterativeLearning(_twin(problem)),
    "composite": lambda problem, seed: learning.Composite(ChargingWindows(problem), seed=seed),
    "default": lambda _, seed: learning.ConstrainedLogEI(seed=seed),
    "ei": lambda _, seed: learning.ExpectedImprovement(seed=seed),
    "sobol": lambda _, seed: learning.Sobol(seed=seed),
    "cmaes": lambda problem, seed: CmaEs(problem.space, seed),
    "tpe": lambda problem, seed: Tpe(problem.space, seed),
}


def attainable_t95(plant: str, study: str, seed: int) -> float:
    """min over the theta of this study on this plant, min, that keeps the limit within half of what a solution may be over it.

    At the whole of it a cell that rests 0.99 mV over the limit would have to be known to a hundredth of a millivolt. Where no theta keeps
    half of it, within the whole; inf where none does.
    """
    bounds = (5e-4 * EXCESS_MV, 1e-3 * EXCESS_MV)
    return next((t for bound in bounds if np.isfinite(t := _attainable_t95(plant, study, seed, bound))), float("inf"))


def _attainable_t95(plant: str, study: str, seed: int, bound_V: float) -> float:
    problem = exact(make_problem(plant, study, seed, 0.0))
    objective, limits = replace(problem.objective, soc_windows=24), replace(problem.limits, tolerance_V=bound_V)
    problem = replace(problem, objective=objective, limits=limits)
    best, mark = [float("inf")], _mark(plant)

    class Truth:
        def samples(self, episode: Any) -> Any:
            return charge_samples(problem, episode)

        def score(self, episode: Any) -> Any:
            score = score_episode(problem, episode)
            if score.feasible and score.metrics[mark]:
                best[0] = min(best[0], score.metrics[mark])
            return score

    search = Search(Truth(), lambda thetas: [run_charge(problem, theta) for theta in thetas], problem.space, share=1.0)
    space = problem.space
    first = [space.to_unit(space.default), np.full(space.dimension, 0.9)]
    if plant in DFN:
        # Their episodes take minutes together, and there are no cheap ones to choose starts by.
        for start in first:
            search.refine(start, 8, GAIN)
        return best[0]
    pool = [*first, *sobol_points(space.dimension, 0, 0, 64)]
    found = [search.refine(start, 60, GAIN) for start in (*first, *sorted(pool, key=search.merit)[:3])]
    search.refine(min(found, key=search.merit), 60, GAIN / 10)
    return best[0]


def _mark(plant: str) -> str:
    return "t80_min" if plant in DFN else "t95_min"


def run(plant: str, study: str, noise_V: float, trials: int, job: tuple[str, int], settings: TwinSettings | None = None) -> dict[str, Any]:
    """True excess and t95 of every trial of one method on one seed; of a twin with other ``settings`` where they are given."""
    method, seed = job
    problem = make_problem(plant, study, seed, noise_V)
    truth = exact(problem)
    if method not in PROMISING:
        limits = replace(problem.limits, tolerance_V=SHARE_TOLD * problem.limits.tolerance_V)
        problem = replace(problem, limits=limits)
    tuner = METHODS[method](problem, seed)
    tuner = tuner if settings is None else replace(tuner, settings=settings)
    told: list[Any] = []
    names = ("excess_mV", "excess_K", "excess_anode_mV", "kept", "t95", "ask_s", "recommended")
    out: dict[str, Any] = {"method": method, "seed": seed, **{name: [] for name in names}}
    for number in range(trials):
        begin = time.perf_counter()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)
            try:
                theta = tuner.ask(problem.space, told, 1)[0]
            except learning.NoSafeThetaError:
                # It stops here, with what it has.
                break
        out["ask_s"].append(time.perf_counter() - begin)
        score, episode, ending = evaluate(problem, theta, 1000 * seed + number)
        status = "done" if score else "failed"
        told.append(
            SimpleNamespace(number=number, theta=tuple(theta), status=status, score=score, ending=ending, episode=lambda e=episode: e)
        )
        verdict = score_episode(truth, run_charge(truth, theta))
        metrics = verdict.metrics
        out["excess_mV"].append(metrics["overshoot_mV"])
        out["excess_K"].append(metrics.get("temperature_max_excess_K"))
        out["excess_anode_mV"].append(metrics.get("anode_min_excess_mV"))
        out["kept"].append(verdict.feasible)
        out["t95"].append(metrics[_mark(plant)] or float("inf"))
        out["recommended"].append(_recommended(method, tuner, problem, told))
    return out


def _recommended(method: str, tuner: Any, problem: Any, told: list[Any]) -> int:
    if method in NEWEST:
        return len(told) - 1
    if method in BELIEVED:
        best = tuner.best(problem.space, told)
    else:
        trial = measured_result(told).trial
        best = None if trial is None else trial.number
    return len(told) - 1 if best is None else int(best)


def rows(runs: list[dict[str, Any]], args: argparse.Namespace, attainable: dict[int, float]) -> list[dict[str, Any]]:
    found = []
    for method in args.methods:
        own = [r for r in runs if r["method"] == method]
        for count in range(1, args.trials + 1):
            at = [r["recommended"][:count][-1] for r in own]
            ratios = [r["t95"][k] / attainable[r["seed"]] for r, k in zip(own, at, strict=True)]
            kept = [r["kept"][k] for r, k in zip(own, at, strict=True)]
            excess = np.concatenate([r["excess_mV"][:count] for r in own])
            far = sum(max(r["excess_mV"][:count]) > FAR_MV for r in own)
            found.append(
                {
                    "method": method, "plant": args.plant, "study": args.study, "noise_mV": args.noise_mV, "trials": count,
                    "solved": int(sum(k and q <= WITHIN for k, q in zip(kept, ratios, strict=True))), "of": len(own),
                    "t95_ratio_median": _number(np.median(ratios)), "t95_ratio_worst": _number(np.max(ratios)),
                    "violating_trials": int(np.sum(excess > EXCESS_MV)), "all_trials": len(excess),
                    "worst_excess_mV": float(np.max(excess)), "seeds_beyond_5_mV": far,
                    "worst_excess_K": _worst(own, "excess_K", count), "worst_excess_anode_mV": _worst(own, "excess_anode_mV", count),
                    "ask_s_median": float(np.median([r["ask_s"][:count][-1] for r in own])),
                }
            )  # fmt: skip
    return found


def _worst(runs: list[dict[str, Any]], name: str, count: int) -> float | None:
    return max((v for r in runs for v in r[name][:count] if v is not None), default=None)


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def main() -> None:
    measure(arguments(), run)


def measure(args: argparse.Namespace, one: Callable[..., dict[str, Any]]) -> None:
    """Prints the rows of every method and seed; ``one`` runs one of them, as `run` does."""
    attainable = optima(args)
    jobs = list(product(args.methods, args.seeds))
    work = partial(one, args.plant, args.study, args.noise_mV / 1e3, args.trials)
    screen = Console(stderr=True)
    with ProcessPoolExecutor(args.workers) as pool:
        runs = list(track(pool.map(work, jobs), "learning", total=len(jobs), console=screen, disable=args.json and not screen.is_terminal))
    found = rows(runs, args, attainable)
    if args.json:
        print(json.dumps({"rows": found}))
        return
    table = Table(
        Column("method", no_wrap=True),
        "trials",
        "solved",
        "t95 ratio median",
        "worst",
        "violating",
        "worst excess mV",
        "K",
        "anode mV",
        "ask s",
    )
    for r in found:
        ratios = ["-" if r[k] is None else f"{r[k]:.3f}" for k in ("t95_ratio_median", "t95_ratio_worst")]
        violating = f"{r['violating_trials']}/{r['all_trials']}"
        table.add_row(
            r["method"],
            str(r["trials"]),
            f"{r['solved']}/{r['of']}",
            *ratios,
            violating,
            f"{r['worst_excess_mV']:.1f}",
            *("-" if r[k] is None else f"{r[k]:.1f}" for k in ("worst_excess_K", "worst_excess_anode_mV")),
            f"{r['ask_s_median']:.1f}",
        )
    Console().print(table)


def optima(args: argparse.Namespace) -> dict[int, float]:
    """Attainable t95 by seed, from the cache where it is known."""
    known: dict[str, float] = json.loads(args.cache.read_text()) if args.cache.exists() and not args.recompute else {}
    # On a DFN plant the seed decides the noise alone, and the optimum knows none.
    own = {s: 0 if args.plant in DFN else s for s in args.seeds}
    missing = [s for s in sorted(set(own.values())) if f"{args.plant} {args.study} {s}" not in known]
    screen = Console(stderr=True)
    with ProcessPoolExecutor(args.workers) as pool:
        work = pool.map(partial(attainable_t95, args.plant, args.study), missing)
        for seed, value in zip(missing, track(work, "attainable", total=len(missing), console=screen, disable=args.json), strict=True):
            known[f"{args.plant} {args.study} {seed}"] = value
    args.cache.parent.mkdir(parents=True, exist_ok=True)
    args.cache.write_text(json.dumps(known))
    return {s: known[f"{args.plant} {args.study} {own[s]}"] for s in args.seeds}


def arguments(description: str | None = __doc__, known: Collection[str] = tuple(METHODS), **defaults: str) -> argparse.Namespace:
    """The command line; ``defaults`` where another script has other ones."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--plant", choices=PLANTS, default="ecm")
    parser.add_argument("--study", choices=sorted(STUDIES), default="r0")
    parser.add_argument("--methods", default="safe,twin,ilc,default", help=f"of {','.join(known)}")
    parser.add_argument("--seeds", default="0:20", help="A:B, B not included")
    parser.add_argument("--trials", type=int, default=4)
    parser.add_argument("--noise-mV", dest="noise_mV", type=float, default=2.0)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--cache", type=Path, default=Path("out/learning/attainable.json"))
    parser.add_argument("--recompute", action="store_true", help="compute the attainable t95 anew")
    parser.add_argument("--json", action="store_true")
    parser.set_defaults(**defaults)
    args = parser.parse_args()
    args.methods = args.methods.split(",")
    unknown = sorted(set(args.methods) - set(known))
    if unknown:
        sys.exit(f"methods: unknown {unknown}, allowed are {', '.join(known)}")
    first, _, last = args.seeds.partition(":")
    args.seeds = range(int(first), int(last or int(first) + 1))
    return args


if __name__ == "__main__":
    main()
