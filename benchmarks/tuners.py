"""Which tuner of an MPC needs how many trials, and what it breaks on the way, on plants that the controller believes to be others.

    python benchmarks/tuners.py [--plants a,b] [--methods a,b] [--seeds 0:10] [--trials 10] [--workers 2] [--json | --page]

Each run goes to --out as a line when it ends; a second start goes on from there. Seeds come first, so that what has been run at any time is
all methods on all plants. --json prints what the table says; --page writes the leaderboard (docs/tuners.md) and its figure from --out,
without a run. docs/tuners.md says what is counted and how to add a plant or a tuner.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import lru_cache, partial
from itertools import product
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "benchmarks"), str(ROOT / "examples")]

import torch  # noqa: E402 - the paths of this script come first
from tuner_suite import machines, processes, reactors  # noqa: E402
from tuner_suite.methods import METHODS, twins  # noqa: E402
from tuner_suite.page import print_table, write_page  # noqa: E402
from tuner_suite.run import run  # noqa: E402
from tuner_suite.table import rows  # noqa: E402

PLANTS = {
    "sorourifar-cstr": reactors.sorourifar_cstr,
    "pcgym-cstr": reactors.pcgym_cstr,
    "batch-reactor": reactors.batch_reactor,
    "crystalliser": reactors.crystalliser,
    "four-tanks": processes.four_tanks,
    "extraction": processes.extraction,
    "tclab": processes.tclab,
    "building": processes.building,
    "cart-pole": machines.cart_pole,
    "charge": machines.charge,
}
made = lru_cache(maxsize=1)(lambda name, seed: PLANTS[name](seed))


def one(args: argparse.Namespace, job: tuple[int, str, str]) -> dict:
    """The line of one run."""
    seed, name, method = job
    trials, cache = trials_of(args, method), args.cache
    # What these fit is small: a second thread mostly waits.
    torch.set_num_threads(1)
    plant = made(name, seed)
    return {"plant": name, "method": method, "seed": seed, "trials": trials, **run(plant, METHODS[method], seed, trials, cache)}


def missing(args: argparse.Namespace, known: Sequence[dict]) -> list[tuple[int, str, str]]:
    """What is asked and not yet run: (seed, plant, method)."""
    there = {(r["seed"], r["plant"], r["method"]) for r in known if r["trials"] >= trials_of(args, r["method"])}
    jobs = [job for job in product(args.seeds, args.plants, args.methods) if job not in there]
    return [(seed, name, method) for seed, name, method in jobs if applies(name, method)]


def trials_of(args: argparse.Namespace, method: str) -> int:
    """How many trials a run of this method has."""
    return args.twin_trials or args.trials if METHODS[method].needs == "twin" else args.trials


def applies(name: str, method: str) -> bool:
    """Whether a method has what it needs: a twin or windows of the plant, its package."""
    if method == "smac" and importlib.util.find_spec("smac") is None:
        return False
    needs = METHODS[method].needs
    return not needs or getattr(made(name, 0), needs) is not None


def read(out: Path) -> list[dict]:
    return [json.loads(line) for line in out.read_text().splitlines()] if out.exists() else []


def main(arguments: Sequence[str] | None = None) -> None:
    args = asked(arguments)
    if args.full:
        METHODS.update(twins())
    if args.page:
        write_page(read(args.out), list(PLANTS), list(METHODS), ROOT / "docs", args.command)
        return
    if "smac" in args.methods and importlib.util.find_spec("smac") is None:
        print("smac is left out: pip install smac", file=sys.stderr)
    jobs = missing(args, read(args.out))
    args.out.parent.mkdir(parents=True, exist_ok=True)
    work = partial(one, args)
    begin = time.monotonic()
    with ProcessPoolExecutor(args.workers) as pool:
        for line in map(work, jobs) if args.workers == 1 else pool.map(work, jobs):
            with args.out.open("a") as file:
                file.write(json.dumps(line) + "\n")
            passed = f"{time.monotonic() - begin:6.0f} s"
            print(f"{passed}  seed {line['seed']}  {line['plant']:16s} {line['method']}", file=sys.stderr, flush=True)
    mine = [r for r in read(args.out) if r["seed"] in args.seeds and r["plant"] in args.plants and r["method"] in args.methods]
    found = rows(mine)
    if args.json:
        print(json.dumps({"rows": found}))
    else:
        print_table(found)


def asked(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--plants", default=",".join(PLANTS))
    parser.add_argument("--methods", default=",".join(METHODS))
    parser.add_argument("--seeds", default="0:10", help="A:B, B not included")
    parser.add_argument("--trials", type=int, default=10)
    parser.add_argument("--twin-trials", type=int, default=6, help="of the twins, whose proposals take seconds; 0: as many as --trials")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("out/tuners/runs.jsonl"))
    parser.add_argument("--cache", type=Path, default=Path("out/tuners/oracle"), help="folder of the best theta of each plant")
    parser.add_argument(
        "--full", action="store_true", help="twins with the settings of the package: twice the plants and rounds, thrice the time"
    )
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--page", action="store_true")
    parser.add_argument("--command", default="python benchmarks/tuners.py", help="what the page says it was made with")
    args = parser.parse_args(arguments)
    for name, known in (("plants", PLANTS), ("methods", METHODS)):
        values = getattr(args, name).split(",")
        unknown = sorted(set(values) - set(known))
        if unknown:
            parser.error(f"{name}: unknown {', '.join(unknown)}, allowed are {', '.join(known)}")
        setattr(args, name, values)
    first, _, last = args.seeds.partition(":")
    if not (first.isdigit() and (last or first).isdigit()) or args.trials < 1 or args.workers < 1:
        parser.error(f"seeds = {args.seeds!r}, trials = {args.trials}, workers = {args.workers}; allowed are A:B and numbers >= 1")
    args.seeds = range(int(first), int(last) if last else int(first) + 1)
    return args


if __name__ == "__main__":
    main()
