"""Milliseconds of one 10 s interval of each electrochemical plant. Run: python benchmarks/plants.py [--json].

``ms_per_step`` is PyBaMM's own solver alone, ``loop_ms_per_step`` the closed loop on that plant: controller, Kalman filter,
solver, reading voltage, temperature and anode potential, sensors. Both charge at 1C from 30 % SOC, in turns in one run.
"""

import argparse
import json
import statistics
import time
from dataclasses import replace
from pathlib import Path

from chargetune.battery.cell import load_cell
from chargetune.battery.charging import ChargingProblem
from chargetune.battery.electrochemical import CURRENT, Electrochemical, _built
from chargetune.battery.estimation import Kalman

STEPS, ROUNDS = 120, 3
CELL = Path(__file__).parents[1] / "examples" / "okane2022.toml"


def solver_alone(settings):
    built, solution = _built(settings, 0.3), None
    begin = time.perf_counter()
    for _ in range(STEPS):
        solution = built.solver.step(solution, built.model, 10.0, inputs={CURRENT: -5.0}, save=False)
    return 1e3 * (time.perf_counter() - begin) / STEPS


def closed_loop(settings):
    problem = ChargingProblem(
        load_cell(CELL), mismatch_seed=None, plant_model=settings, soc_start=0.3, steps=STEPS, current_max_A=5.0, current_min_A=4.99,
        voltage_max_V=4.2, kalman=Kalman(), temperature_max_K=330.0,
    )  # fmt: skip
    problem.episode()
    begin = time.perf_counter()
    problem.episode()
    return 1e3 * (time.perf_counter() - begin) / STEPS


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="print JSON")
    as_json = parser.parse_args().json
    rows = []
    for settings in [Electrochemical(model=m) for m in ("SPM", "SPMe", "DFN")] + [replace(Electrochemical(), mesh="default")]:
        alone, loop = zip(*((solver_alone(settings), closed_loop(settings)) for _ in range(ROUNDS)), strict=True)
        name = settings.model + (" default mesh" if settings.mesh == "default" else "")
        rows.append({"name": name, "ms_per_step": statistics.median(alone), "loop_ms_per_step": statistics.median(loop)})
    if as_json:
        print(json.dumps({"plants": rows}))
        return
    for row in rows:
        share = 100 * (row["loop_ms_per_step"] / row["ms_per_step"] - 1)
        print(f"{row['name']:18s} {row['ms_per_step']:6.2f} ms, in the loop {row['loop_ms_per_step']:6.2f} ms ({share:+.0f} %)")


if __name__ == "__main__":
    main()
