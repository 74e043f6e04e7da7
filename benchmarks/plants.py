"""Milliseconds of one 10 s interval of each electrochemical plant. Run: python benchmarks/plants.py [--json].

``ms_per_step`` is the plant's own time: PyBaMM's solver and the reading of voltage, temperature and anode potential;
``solver_ms_per_step`` is the solver's part of it. ``loop_ms_per_step`` is the whole closed loop at 1C in the same run:
controller and Kalman filter (compiled), plant, sensors, recording.
"""

import argparse
import json
import statistics
import time
from dataclasses import replace
from pathlib import Path

from chargetune.battery.cell.cell import load_cell
from chargetune.battery.charging.evaluate import run_charge
from chargetune.battery.charging.kalman import Kalman
from chargetune.battery.charging.limits import LimitSettings
from chargetune.battery.charging.problem import ChargingProblem
from chargetune.battery.charging.settings import EpisodeSettings, EstimatorSettings
from chargetune.battery.plants.electrochemical import Electrochemical, ElectrochemicalPlant, _built

STEPS, ROUNDS = 120, 3
CELL = Path(__file__).parents[1] / "examples" / "okane2022.toml"


def closed_loop(settings):
    """(ms inside PyBaMM's solver, ms of the plant, ms of the loop) per interval."""
    problem = ChargingProblem(
        load_cell(CELL),
        settings,
        estimator=EstimatorSettings(kalman=Kalman()),
        limits=LimitSettings(current_max_A=5.0, voltage_max_V=4.2, temperature_max_K=330.0),
        episode=EpisodeSettings(steps=STEPS, soc_start=0.3),
    )
    run_charge(problem)
    solver, inside, stepping = _built(settings, 0.3).solver, [], []
    originals = solver.step, ElectrochemicalPlant.ahead

    def timed(call, times):
        def run(*args, **options):
            begin = time.perf_counter()
            out = call(*args, **options)
            times.append(time.perf_counter() - begin)
            return out

        return run

    solver.step, ElectrochemicalPlant.ahead = timed(originals[0], inside), timed(originals[1], stepping)
    begin = time.perf_counter()
    run_charge(problem)
    whole = time.perf_counter() - begin
    solver.step, ElectrochemicalPlant.ahead = originals
    return tuple(1e3 * seconds / STEPS for seconds in (sum(inside), sum(stepping), whole))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="print JSON")
    as_json = parser.parse_args().json
    rows = []
    for settings in [Electrochemical(model=m) for m in ("SPM", "SPMe", "DFN")] + [replace(Electrochemical(), mesh="default")]:
        solver, plant, loop = zip(*(closed_loop(settings) for _ in range(ROUNDS)), strict=True)
        name = settings.model + (" default mesh" if settings.mesh == "default" else "")
        figures = {"solver_ms_per_step": solver, "ms_per_step": plant, "loop_ms_per_step": loop}
        rows.append({"name": name, **{key: statistics.median(values) for key, values in figures.items()}})
    if as_json:
        print(json.dumps({"plants": rows}))
        return
    for row in rows:
        share = 100 * (row["loop_ms_per_step"] / row["ms_per_step"] - 1)
        print(f"{row['name']:18s} {row['ms_per_step']:6.2f} ms, in the loop {row['loop_ms_per_step']:6.2f} ms ({share:+.0f} %)")


if __name__ == "__main__":
    main()
