"""The search over a range of use beside a derivative-free one, on the same draws. Run: python benchmarks/range_search.py [--json].

Both choose theta for the mean objective on ``--plants`` draws of R1 (benchmarks/range.py), or of the crane of examples/range_crane.py, with
every limit kept to half of its tolerance. slp is the search of `RangeTuner` without corners, cma CMA-ES (package cma, population and first
step its defaults for the unit cube) on the objective with a penalty of a tenth of it for each tolerance of the worst violation, from the
better of the cautious corners and the untuned theta, with ``--times`` as many points as slp took. Each theta is judged on 300 fresh draws;
loops counts simulated closed loops, ratio is the mean objective to that of slp.
"""

import argparse
import json
import sys
import time
import warnings

import numpy as np
from range import EXAMPLES, r1

from chargetune.battery.charging.charging_range import ChargingRange
from chargetune.learning import RangeSettings, RangeTuner
from chargetune.learning.range_of_use.range_verdict import RangeEvaluation, run_plants

AIM = 0.5


class Counted:
    """A range loop that counts its closed loops."""

    def __init__(self, loop):
        self._loop, self.loops = loop, 0

    def __getattr__(self, name):
        return getattr(self._loop, name)

    def simulate(self, thetas, plants):
        self.loops += len(plants)
        return self._loop.simulate(thetas, plants)


def penalised(loop, theta, plants):
    """The mean loss with a penalty for the worst violation."""
    results = run_plants(loop, theta, plants)
    if any(one.score is None for one in results):
        return np.inf
    loss = -float(np.mean([one.score.objective for one in results]))
    worst = max(v / one.score.tolerance[name] for one in results for name, v in one.score.excess.items())
    return loss + 0.1 * abs(loss) * max(0.0, worst - AIM)


def cma_es(loop, space, plants, seed, points):
    """The best of so many points."""
    import cma

    starts = [space.to_unit(space.default), np.zeros(space.dimension), np.ones(space.dimension)]
    values = [penalised(loop, space.from_unit(u), plants) for u in starts]
    best, start = min(values), starts[int(np.argmin(values))]
    found = start
    options = {"bounds": [0.0, 1.0], "seed": seed + 1, "verbose": -9, "maxfevals": max(points - len(starts), 1)}
    search = cma.CMAEvolutionStrategy(np.clip(start, 0.02, 0.98), 0.2, options)
    while not search.stop():
        asked = search.ask()
        told = [penalised(loop, space.from_unit(np.clip(u, 0.0, 1.0)), plants) for u in asked]
        if min(told) < best:
            best, found = min(told), np.clip(asked[int(np.argmin(told))], 0.0, 1.0)
        search.tell(asked, told)
    return space.from_unit(found)


def problems(options):
    """Name, loop and space."""
    problem = r1(options)
    yield "R1", ChargingRange(problem), problem.space
    sys.path.insert(0, str(EXAMPLES))
    import range_crane

    yield "crane", range_crane.LOOP, range_crane.SPACE


def rows(options):
    """One for each problem, seed and search."""
    for name, loop, space in problems(options):
        for seed in options.seeds:
            judges, of_slp = loop.draw(300, 7_000_001 + seed), None
            spent = 0
            for method, times in (("slp", 1), *(("cma", times) for times in options.times)):
                counted, begin = Counted(loop), time.perf_counter()
                if method == "slp":
                    settings = RangeSettings(plants=options.plants, corners=0, pool=16)
                    theta = RangeTuner(RangeEvaluation(counted, 1), seed, settings).ask(space, [])[0]
                    spent = counted.loops
                else:
                    theta = cma_es(counted, space, counted.draw(options.plants, seed), seed, times * spent // options.plants)
                seconds = time.perf_counter() - begin
                scores = [one.score for one in run_plants(loop, theta, judges)]
                mean = float(np.mean([score.objective for score in scores]))
                of_slp = of_slp or mean
                yield {
                    "problem": name, "entries": space.dimension, "seed": seed, "method": method, "times": times, "loops": counted.loops,
                    "seconds": seconds, "violations": sum(not score.feasible for score in scores),
                    "worst_tolerances": max(max(v / s.tolerance[n] for n, v in s.excess.items()) for s in scores),
                    "objective": mean, "ratio": mean / of_slp,
                }  # fmt: skip


def main():
    """Print a row as it is done, or all as JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--plants", type=int, default=36)
    parser.add_argument("--times", type=int, nargs="+", default=[1, 4], help="points of cma, in those of slp")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--step-s", type=float, default=10.0)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    options.without = []
    warnings.simplefilter("ignore")
    every = []
    for row in rows(options):
        every.append(row)
        if not options.json:
            print(json.dumps(row), flush=True)
    if options.json:
        print(json.dumps({"rows": every}))


if __name__ == "__main__":
    main()
