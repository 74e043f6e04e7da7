"""Milliseconds of one 10 s interval of each electrochemical plant. Run: python benchmarks/plants.py [--json].

``loop_ms_per_step`` is a whole closed loop at 1C: controller, Kalman filter, PyBaMM's solver, reading voltage, temperature and
anode potential, sensors. ``ms_per_step`` is what of it was spent inside PyBaMM's solver, in the same loop.
"""

import argparse
import json
import statistics
import time
from dataclasses import replace
from pathlib import Path

from chargetune.battery.cell import load_cell
from chargetune.battery.charging import ChargingProblem
from chargetune.battery.electrochemical import Electrochemical, _built
from chargetune.battery.estimation import Kalman

STEPS, ROUNDS = 120, 3
CELL = Path(__file__).parents[1] / "examples" / "okane2022.toml"


def closed_loop(settings):
    """(ms inside PyBaMM's solver, ms of the loop) per interval."""
    problem = ChargingProblem(
        load_cell(CELL), mismatch_seed=None, plant_model=settings, soc_start=0.3, steps=STEPS, current_max_A=5.0,
        voltage_max_V=4.2, kalman=Kalman(), temperature_max_K=330.0,
    )  # fmt: skip
    problem.episode()
    solver, inside = _built(settings, 0.3).solver, []
    own = solver.step

    def timed(*args, **options):
        begin = time.perf_counter()
        solution = own(*args, **options)
        inside.append(time.perf_counter() - begin)
        return solution

    solver.step = timed
    begin = time.perf_counter()
    problem.episode()
    whole = time.perf_counter() - begin
    solver.step = own
    return 1e3 * sum(inside) / STEPS, 1e3 * whole / STEPS


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="print JSON")
    as_json = parser.parse_args().json
    rows = []
    for settings in [Electrochemical(model=m) for m in ("SPM", "SPMe", "DFN")] + [replace(Electrochemical(), mesh="default")]:
        alone, loop = zip(*(closed_loop(settings) for _ in range(ROUNDS)), strict=True)
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
