"""Seconds a tuner takes to propose one theta. Run: python benchmarks/tuner_overhead.py [--json].

Trials of a made-up constrained function; one thread. The JSON is the default tuner with one limit; the table adds the
default tuner with a limit told in five windows, as in charging, and the paper's expected improvement.
"""

import argparse
import json
import statistics
import time
from types import SimpleNamespace

import numpy as np

from chargetune.episode.score import Score
from chargetune.learning import ConstrainedLogEI, ExpectedImprovement
from chargetune.model.parameter_space import Parameter, ParameterSpace

COUNTS = (20, 60, 120)
DIMENSIONS = (7, 16)
REPEATS = 5


def trials(dimension, count, windows, seed):
    """A history that gathers around the optimum, as a tuner's does."""
    draw = np.random.default_rng(seed)
    spread = np.where(np.arange(count) < 9, 0.5, 0.1)[:, None]
    points = np.clip(0.4 + spread * draw.standard_normal((count, dimension)), 0.0, 1.0)
    out = []
    for number, theta in enumerate(points):
        parts = [float(np.max(0.35 - part)) for part in np.array_split(theta, windows)]
        score = Score(
            objective=-float(np.mean(theta**2)),
            performance=-float(np.mean(theta**2)) - max(0.0, *parts),
            excess={"limit": 0.1 * max(parts)},
            tolerance={"limit": 1e-3},
            profile={"limit": tuple(0.1 * p for p in parts)} if windows > 1 else {},
        )
        out.append(SimpleNamespace(number=number, theta=tuple(theta), status="done", score=score))
    return out


def ask_seconds(tuner, dimension, count, windows):
    """Median over different histories; the first call, which loads code, is not counted."""
    space = ParameterSpace((Parameter("x", 0.0, 1.0, 0.5, size=dimension),))
    tuner.ask(space, trials(dimension, count, windows, 99))
    times = []
    for seed in range(REPEATS):
        history = trials(dimension, count, windows, seed)
        begin = time.perf_counter()
        tuner.ask(space, history)
        times.append(time.perf_counter() - begin)
    return statistics.median(times)


def main():
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="print JSON for a program")
    arguments = parser.parse_args()

    def table(tuner, windows):
        return {f"d{d}": {str(n): ask_seconds(tuner, d, n, windows) for n in COUNTS} for d in DIMENSIONS}

    default = table(ConstrainedLogEI(seed=0), 1)
    if arguments.json:
        print(json.dumps({"ask_s": default}))
        return
    print("seconds an ask at trials      " + "  ".join(f"{n:>5}" for n in COUNTS))
    tables = {
        "default, one limit": default,
        "default, five windows": table(ConstrainedLogEI(seed=0), 5),
        "ei": table(ExpectedImprovement(seed=0), 1),
    }
    for name, values in tables.items():
        for dimension, row in values.items():
            print(f"{name:22} {dimension:>5}  " + "  ".join(f"{row[str(n)]:5.2f}" for n in COUNTS))


if __name__ == "__main__":
    main()
