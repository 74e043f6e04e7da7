"""How much sooner two worker processes finish 200 simulated trials than one. Run: python benchmarks/workers.py [--json].

A trial is an hour of charging on PyBaMM's single particle model with electrolyte. One and two workers take turns, 50 trials each
time, so that both see the same machine; each has evaluated a trial before its clock starts. The clock holds all that
`Study.run(workers=...)` does: proposals, evaluation, transport, and the store with its transactions. ``tuner`` is Sobol's sequence;
the default tuner proposes in the process of the study for some tenths of a second, which ``--tuner default`` adds.
"""

import argparse
import json
import os
import statistics
import tempfile
import time
from pathlib import Path

from chargetune.battery.cell.cell import load_cell
from chargetune.battery.charging.evaluate import Evaluation
from chargetune.battery.charging.kalman import Kalman
from chargetune.battery.charging.limits import LimitSettings
from chargetune.battery.charging.problem import ChargingProblem
from chargetune.battery.charging.settings import EstimatorSettings
from chargetune.battery.charging.tunables import Backoff, Tunables
from chargetune.battery.plants.electrochemical import Electrochemical
from chargetune.learning import ConstrainedLogEI, Sobol
from chargetune.study.executors import process_executor
from chargetune.study.store.store import Store
from chargetune.study.study import Study

CELL = Path(__file__).parents[1] / "examples" / "okane2022.toml"
TUNERS = {"sobol": Sobol(0), "default": ConstrainedLogEI(0)}


def problem():
    return ChargingProblem(
        load_cell(CELL),
        Electrochemical(model="SPMe"),
        estimator=EstimatorSettings(kalman=Kalman()),
        limits=LimitSettings(current_max_A=10.0, voltage_max_V=4.2),
        theta=Tunables(backoff=Backoff(5)),
    )


def seconds(studies, evaluate, trials, executors):
    """Wall-clock seconds to bring the study of each number of workers to so many trials."""
    out = {}
    for workers, study in studies.items():
        begin = time.perf_counter()
        study.run(evaluate, trials, executor=executors[workers], workers=workers)
        out[workers] = time.perf_counter() - begin
    return out


def main():
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="print JSON for a program")
    parser.add_argument("--trials", type=int, default=200, help="trials for one worker, and for two")
    parser.add_argument("--turns", type=int, default=4, help="how often they take turns")
    parser.add_argument("--tuner", choices=TUNERS, default="sobol")
    arguments = parser.parse_args()
    evaluate, load = Evaluation(problem()), os.getloadavg()[0]
    with (
        tempfile.TemporaryDirectory() as folder,
        process_executor(1) as one,
        process_executor(2) as two,
        Store(Path(folder) / "workers.db") as store,
    ):
        executors = {1: one, 2: two}
        studies = {
            workers: Study.create_or_resume(
                store, f"{workers} workers", config={}, space=evaluate.space, tuner=TUNERS[arguments.tuner], batch=1
            )
            for workers in executors
        }
        # Each worker builds its plant before the clock starts.
        seconds(studies, evaluate, 4, executors)
        ends = [4 + (k + 1) * arguments.trials // arguments.turns for k in range(arguments.turns)]
        turns = [seconds(studies, evaluate, end, executors) for end in ends]
        if any(len(study.trials()) != ends[-1] or study.running() for study in studies.values()):
            raise RuntimeError("not every trial was told")
        for study in studies.values():
            study.close()
    total = {workers: sum(turn[workers] for turn in turns) for workers in executors}
    ratios = [turn[1] / turn[2] for turn in turns]
    result = {
        "trials": arguments.trials,
        "tuner": arguments.tuner,
        "one_worker_s": total[1],
        "two_workers_s": total[2],
        "speed_up": total[1] / total[2],
        "speed_up_of_turns": ratios,
        "cores": os.cpu_count(),
        "load_before": load,
    }
    if arguments.json:
        print(json.dumps(result))
        return
    print(f"{arguments.trials} trials: one worker {total[1]:.1f} s, two workers {total[2]:.1f} s, {result['speed_up']:.2f} times as fast")
    print(f"median of {arguments.turns} turns: {statistics.median(ratios):.2f}; {os.cpu_count()} cores, load before {load:.2f}")


if __name__ == "__main__":
    main()
