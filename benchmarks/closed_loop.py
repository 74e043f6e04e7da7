"""How fast a closed loop is on problem P0, beside do-mpc and plain CasADi with IPOPT. Run: python benchmarks/closed_loop.py [--json].

P0 is the case study's hour of charging (360 steps, horizon 5, U1 measured) with the perfect model and five wrong ones.
Everything is measured in one run, in rounds that alternate between the tools; figures are medians. An episode counts with
all of its Python (`run_charge`). Set-up counts building and compiling, not the start of Python.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from peers import do_mpc_loop, ipopt_loop

from chargetune.battery.cell.cell import default_cell
from chargetune.battery.charging.controller import controller_of
from chargetune.battery.charging.evaluate import plant_of, run_charge
from chargetune.battery.charging.problem import ChargingProblem
from chargetune.battery.charging.settings import ControllerSettings, EpisodeSettings, EstimatorSettings
from chargetune.battery.charging.tunables import Backoff, Tunables
from chargetune.episode.compiled import compiled_episode

SEEDS = (None, 0, 1, 2, 3, 4)
HORIZONS = (5, 10, 20, 40)
FRESH = """
import time
from chargetune.battery.cell.cell import default_cell
from chargetune.battery.charging.evaluate import run_charge
from chargetune.battery.charging.problem import ChargingProblem
from chargetune.battery.charging.settings import ControllerSettings, EstimatorSettings
begin = time.perf_counter()
run_charge(ChargingProblem(default_cell(), controller=ControllerSettings(mismatch_seed=0), estimator=EstimatorSettings(kind="exact")))
print(time.perf_counter() - begin)
"""


def problem(seed, kind="exact", horizon=5, **tables):
    """P0 for one wrong model."""
    return ChargingProblem(
        default_cell(), controller=ControllerSettings(horizon=horizon, mismatch_seed=seed), estimator=EstimatorSettings(kind=kind), **tables
    )


def seconds(run, repeats):
    """Median duration of a call that has been made once before."""
    run()
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        run()
        times.append(time.perf_counter() - begin)
    return statistics.median(times)


def set_up():
    """(cold, cached) seconds until the first episode is there, each in a fresh process."""
    cold, cached = [], []
    for _ in range(3):
        with tempfile.TemporaryDirectory() as folder:
            environment = {**os.environ, "CHARGETUNE_CACHE": folder}
            for times in (cold, cached):
                done = subprocess.run([sys.executable, "-c", FRESH], env=environment, capture_output=True, text=True, check=True)
                times.append(float(done.stdout))
    return statistics.median(cold), statistics.median(cached)


def failures():
    """Control steps that missed the program's own optimality test, over 20 wrong models and both ways to know U1."""
    return sum(run_charge(problem(seed, treatment)).failures for seed in range(20) for treatment in ("exact", "open_loop"))


def run_chunk(own, thetas):
    """SOC at the end for each theta; runs in a worker."""
    return [float(run_charge(own, theta).signal("soc")[1][-1]) for theta in thetas]


def batch():
    """Seconds for 1000 episodes of different theta on two new worker processes."""
    own = problem(0, theta=Tunables(backoff=Backoff(7)))
    thetas = np.random.default_rng(0).uniform(0.0, 0.1, (1000, 7))
    run_charge(own)
    begin = time.perf_counter()
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        done = [soc for part in pool.map(run_chunk, [own] * 8, np.array_split(thetas, 8)) for soc in part]
    if len(done) != len(thetas):
        raise RuntimeError(f"{len(done)} episodes came back, expected {len(thetas)}")
    return time.perf_counter() - begin


def reference_currents():
    """Currents of the reference trajectories, where the folder with them stands beside the checkout."""
    path = Path(__file__).resolve().parents[2] / "shared" / "reference" / "p0.json"
    return {c["name"]: np.array(c["current"]) for c in json.loads(path.read_text())["cases"]} if path.exists() else {}


def main():
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="print JSON for a program")
    parser.add_argument("--rounds", type=int, default=3, help="rounds of the comparison with the peers")
    arguments = parser.parse_args()
    problems = [problem(seed) for seed in SEEDS]
    virtual = [compiled_episode(controller_of(p), plant_of(p), p.episode.steps, compiled=False) for p in problems]

    times = {"compiled": [], "vm": [], "do_mpc": [], "casadi_ipopt": []}
    ratios = {"do_mpc": [], "do_mpc_vm": [], "casadi_ipopt": []}
    deviation = {"chargetune": 0.0, "do_mpc": 0.0, "casadi_ipopt": 0.0}
    reference = reference_currents()
    for k in range(arguments.rounds):
        own, machine = problems[k % len(problems)], virtual[k % len(problems)]
        name = "oracle" if SEEDS[k % len(SEEDS)] is None else f"seed{SEEDS[k % len(SEEDS)]}"
        compiled = [seconds(partial(run_charge, own), 50)]
        vm = [seconds(machine.run, 10)]
        peers = {}
        for peer, loop in (("do_mpc", do_mpc_loop), ("casadi_ipopt", ipopt_loop)):
            currents, peers[peer] = loop(own, own.episode.steps)
            times[peer].append(peers[peer])
            if name in reference:
                deviation[peer] = max(deviation[peer], float(np.max(np.abs(currents - reference[name]))))
        # Before and after the peers, since the machine's speed drifts.
        compiled.append(seconds(partial(run_charge, own), 50))
        vm.append(seconds(machine.run, 10))
        times["compiled"] += compiled
        times["vm"] += vm
        ratios["do_mpc"].append(peers["do_mpc"] / statistics.mean(compiled))
        ratios["do_mpc_vm"].append(peers["do_mpc"] / statistics.mean(vm))
        ratios["casadi_ipopt"].append(peers["casadi_ipopt"] / statistics.mean(compiled))
    for seed, own in zip(SEEDS, problems, strict=True):
        name = "oracle" if seed is None else f"seed{seed}"
        if name in reference:
            deviation["chargetune"] = max(deviation["chargetune"], float(np.max(np.abs(run_charge(own).input[:, 0] - reference[name]))))

    horizons = {str(n): 1e3 * statistics.median(seconds(partial(run_charge, problem(s, horizon=n)), 20) for s in SEEDS) for n in HORIZONS}
    cold, cached = set_up()
    result = {
        "episode_ms": {"compiled": horizons, "vm": {"5": 1e3 * statistics.median(times["vm"])}},
        "setup_s": {"cold": cold, "cached": cached},
        "peer_s": {peer: statistics.median(times[peer]) for peer in ("do_mpc", "casadi_ipopt")},
        "ratio": {name: statistics.median(values) for name, values in ratios.items()},
        "failures": failures(),
        "batch_1000_s": batch(),
    }
    if arguments.json:
        print(json.dumps(result))
        return
    steps = {n: 1e3 * seconds(partial(run_charge, problem(SEEDS[1], episode=EpisodeSettings(steps=n))), 30) for n in (90, 180, 360, 720)}
    print("ms an episode, compiled: " + ", ".join(f"N = {n}: {ms:.2f}" for n, ms in horizons.items()))
    print(
        f"  N = 20 / N = 5: {horizons['20'] / horizons['5']:.2f}; over the steps: " + ", ".join(f"{n}: {ms:.2f}" for n, ms in steps.items())
    )
    print(f"ms an episode, virtual machine: {result['episode_ms']['vm']['5']:.1f}")
    for peer, value in result["peer_s"].items():
        spread = ratios[peer]
        print(f"{peer}: {value:.2f} s, ratio {result['ratio'][peer]:.0f} ({min(spread):.0f} to {max(spread):.0f})")
    print(f"do_mpc / virtual machine: {result['ratio']['do_mpc_vm']:.0f}")
    print(f"set-up: cold {cold:.2f} s, cached {cached:.2f} s; 1000 episodes on two cores: {result['batch_1000_s']:.2f} s")
    print(f"steps not solved to tolerance: {result['failures']}")
    if reference:
        print("largest deviation from the reference: " + ", ".join(f"{name} {1e3 * value:.2f} mA" for name, value in deviation.items()))


if __name__ == "__main__":
    main()
