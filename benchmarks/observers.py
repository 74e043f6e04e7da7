"""What feedback does before anything is learnt: the case study with each kind of estimator. Run: python benchmarks/observers.py [--json].

Wrong models of seeds 0 to 19, untuned, on the noise-free voltage of the plant. "oracle" is the controller that knows the cell
(`exact`, no mismatch). ``backoff_sd`` 0 is no backoff, 3 the default of `offset_free` and `adaptive`. episode_ms counts an episode of
3600 s with all of its Python; the ratio to the case study's own episode (open_loop, Ts 10 s, horizon 5) is of the same run.
The defaults of the observers were chosen on seeds 100 to 119, which this does not use.
"""

import argparse
import json
import statistics
import time

import numpy as np

from chargetune.battery.cell.cell import default_cell
from chargetune.battery.charging.evaluate import run_charge
from chargetune.battery.charging.metrics import charging_metrics
from chargetune.battery.charging.observers import Adaptive, OffsetFree
from chargetune.battery.charging.problem import ChargingProblem
from chargetune.battery.charging.settings import ControllerSettings, EpisodeSettings, EstimatorSettings, SensorSettings

HOUR_S = 3600.0
ESTIMATORS = {
    "open_loop": [("open_loop", EstimatorSettings(kind="open_loop"))],
    "kalman": [("kalman", EstimatorSettings(kind="kalman"))],
    "offset_free": [
        (f"offset_free, backoff_sd {k:g}", EstimatorSettings(kind="offset_free", offset_free=OffsetFree(backoff_sd=k))) for k in (0.0, 3.0)
    ],
    "adaptive": [(f"adaptive, backoff_sd {k:g}", EstimatorSettings(kind="adaptive", adaptive=Adaptive(backoff_sd=k))) for k in (0.0, 3.0)],
}


def span(text):
    """The range of a text such as 0:20."""
    first, stop = (int(part) for part in text.split(":"))
    if not 0 <= first < stop:
        raise ValueError(text)
    return range(first, stop)


def problem(estimator, seed, step_s, noise_V):
    """The case study of one wrong model."""
    return ChargingProblem(
        default_cell(),
        controller=ControllerSettings(sampling_time_s=step_s, mismatch_seed=seed),
        estimator=estimator,
        sensors=SensorSettings(voltage_noise_sd_V=noise_V),
        episode=EpisodeSettings(steps=round(HOUR_S / step_s)),
    )


def minutes(metrics, mark):
    """A charging time; infinite where the charge did not get there."""
    value = metrics[mark]
    return np.inf if value is None else value


def row(label, estimator, step_s, noise_V, seeds):
    """One row of the table, over all seeds."""
    oracle = charging_metrics(run_charge(problem(EstimatorSettings(kind="exact"), None, step_s, 0.0)), 4.2, 0.05)
    over, shares, times, unsolved = [], {"t80_min": [], "t95_min": []}, [], 0
    for seed in seeds:
        own = problem(estimator, seed, step_s, noise_V)
        run_charge(own, seed=seed)
        begin = time.perf_counter()
        episode = run_charge(own, seed=seed)
        times.append(1e3 * (time.perf_counter() - begin))
        metrics = charging_metrics(episode.noise_free(), 4.2, 0.05)
        over.append(metrics["overshoot_mV"])
        unsolved += episode.failures
        for mark, values in shares.items():
            values.append(minutes(metrics, mark) / oracle[mark])
    return {
        "estimator": label,
        "Ts_s": step_s,
        "noise_mV": 1e3 * noise_V,
        "over_1_mV": int(np.sum(np.array(over) > 1.0)),
        "of": len(over),
        "median_mV": round(statistics.median(over), 2),
        "worst_mV": round(max(over), 2),
        "t80_ratio_oracle_median": round(statistics.median(shares["t80_min"]), 4),
        "t95_ratio_oracle_median": round(statistics.median(shares["t95_min"]), 4),
        "unsolved_steps": unsolved,
        "episode_ms": round(statistics.median(times), 2),
    }


def main():
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="print JSON for a program")
    parser.add_argument(
        "--seeds", type=span, default=range(20), metavar="FIRST:STOP", help="seeds of the wrong models, 0:20 where not given"
    )
    parser.add_argument("--kinds", nargs="*", default=list(ESTIMATORS), choices=list(ESTIMATORS))
    parser.add_argument("--steps-s", nargs="*", type=float, default=[1.0, 10.0])
    parser.add_argument("--noise-V", nargs="*", type=float, default=[0.0, 0.002])
    arguments = parser.parse_args()
    rows = [
        row(label, estimator, step_s, noise_V, arguments.seeds)
        for step_s in arguments.steps_s
        for noise_V in arguments.noise_V
        for kind in arguments.kinds
        for label, estimator in ESTIMATORS[kind]
    ]
    # The speeds side by side, in turns, so that the machine's drift is in all of them alike.
    ratios = {label: [] for kind in arguments.kinds for label, _ in ESTIMATORS[kind]}
    for _ in range(30):
        times = {}
        for kind in arguments.kinds:
            for label, estimator in ESTIMATORS[kind]:
                own = problem(estimator, 0, 10.0, 0.0)
                run_charge(own)
                begin = time.perf_counter()
                run_charge(own)
                times[label] = time.perf_counter() - begin
        for label, value in times.items():
            ratios[label].append(value / times.get("open_loop", value))
    result = {"rows": rows, "episode_ratio_open_loop": {label: round(statistics.median(values), 3) for label, values in ratios.items()}}
    if arguments.json:
        print(json.dumps(result, indent=1))
        return
    for one in rows:
        print("  ".join(f"{key} {value}" for key, value in one.items()))
    print(result["episode_ratio_open_loop"])


if __name__ == "__main__":
    main()
