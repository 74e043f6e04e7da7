"""How fast an ensemble is: closed loops of several thetas on sampled plants, on all cores beside one after the other.

    python benchmarks/ensembles.py [--json]

Loops of problem P0 (360 steps, horizon 5) on circuits whose R0 is drawn; both ways take turns in one run, figures are medians.
"""

import argparse
import json
import statistics
import time
from dataclasses import replace
from itertools import product

import numpy as np

from chargetune.battery.cell.cell import default_cell
from chargetune.battery.charging.controller import controller_of
from chargetune.battery.charging.evaluate import plant_of
from chargetune.battery.charging.problem import ChargingProblem
from chargetune.battery.charging.settings import ControllerSettings
from chargetune.battery.charging.tunables import Backoff, Tunables
from chargetune.episode.compiled import compiled_episode
from chargetune.runtime.threads import usable_cores

THETAS, PLANTS = 5, 200


def main():
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="print JSON for a program")
    parser.add_argument("--rounds", type=int, default=5)
    arguments = parser.parse_args()
    problem = ChargingProblem(default_cell(), controller=ControllerSettings(mismatch_seed=0), theta=Tunables(backoff=Backoff(7)))
    loop = compiled_episode(controller_of(problem), plant_of(problem), problem.episode.steps)
    random = np.random.default_rng(0)
    nominal = np.array(problem.cell.R0_ohm)
    model = loop.plant.model
    plants = [replace(loop.plant, model=model.with_parameters(R0_ohm=tuple(nominal * f))) for f in random.uniform(0.6, 1.5, PLANTS)]
    thetas = random.uniform(0.0, 0.1, (THETAS, 7))
    cases = list(product(thetas, plants))
    loop.run_each([theta for theta, _ in cases[:20]], [plant for _, plant in cases[:20]])
    together, alone, same = [], [], True
    for _ in range(arguments.rounds):
        begin = time.perf_counter()
        whole = loop.run_each([theta for theta, _ in cases], [plant for _, plant in cases])
        between = time.perf_counter()
        single = [replace(loop, plant=plant).run(theta) for theta, plant in cases]
        together.append(between - begin)
        alone.append(time.perf_counter() - between)
        same &= all(np.array_equal(a.input, b.input) for a, b in zip(whole, single, strict=True))
    ratios = [b / a for a, b in zip(together, alone, strict=True)]
    cores = usable_cores()
    result = {
        "loops": len(cases), "cores": cores, "ensemble_s": statistics.median(together), "one_after_the_other_s": statistics.median(alone),
        "ratio": statistics.median(ratios), "ratio_range": [min(ratios), max(ratios)], "same": same,
    }  # fmt: skip
    if arguments.json:
        print(json.dumps(result))
        return
    print(f"{len(cases)} closed loops on {cores} cores: {result['ensemble_s']:.2f} s")
    print(f"one after the other: {result['one_after_the_other_s']:.2f} s")
    print(f"ratio {result['ratio']:.2f} ({min(ratios):.2f} to {max(ratios):.2f}); the same trajectories: {same}")


if __name__ == "__main__":
    main()
