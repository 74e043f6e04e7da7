"""
Theta over temperature
======================

A cold cell has twice the resistance of a warm one and is at its voltage limit from the beginning: there the controller's error counts. One
margin for all seasons is that of the coldest day. A schedule is a theta for each of several ambients, interpolated before a charge begins.
"""

import tempfile
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import chargetune as ct
from chargetune.battery.cell.thermal import Thermal

# %%
# The cell of the case study with a temperature, an invented one. The controller does not read the voltage and is wrong about resistances.
cell = replace(ct.default_cell(), thermal=Thermal(heat_capacity_J_K=40.0, cooling_W_K=0.05, activation_J_mol=30e3))
file = Path(tempfile.mkdtemp()) / "study.toml"
STUDY = """
controller.mismatch_seed = 1
limits.current_max_A = 4.0
episode.steps = 300
theta.backoff = { nodes = 2, lower_V = 0.0, upper_V = 0.25 }
"""


def charges(theta, ambient, draws, schedule="", seed=0):
    """A score for each of these charges in an ambient within two temperatures, K, and that ambient, degC."""
    file.write_text(STUDY + f"range = {{ soc_start = [0.1, 0.4], ambient_K = {ambient}, draws = {draws} }}\n{schedule}")
    found = ct.evaluation_of("range", ct.load_config(file).problem(cell=cell)).results(np.array(theta), seed)
    return [one.score for one in found], [one.plant.plant.start["temperature_K"] - 273.15 for one in found]


# %%
# The smallest margin in each of five ambients, by bisection on 12 starts, and 5 mV for what lies in between.
nodes, margins = [283.15, 288.15, 293.15, 298.15, 308.15], []
for ambient in nodes:
    lowest = 0.0
    for step in (0.064, 0.032, 0.016, 0.008, 0.004, 0.002):
        kept = all(score.feasible for score in charges([lowest + step] * 2, [ambient] * 2, 12)[0])
        lowest += 0 if kept else step
    margins.append(lowest + step + 0.005)

# Both ways on 100 fresh charges in any ambient from 10 to 35 °C.
figure, (over, time) = plt.subplots(1, 2, figsize=(9, 4), layout="constrained")
ways = {"one margin": ([max(margins)] * 2, ""), "over temperature": (np.repeat(margins, 2), f"theta.schedule.ambient_K = {nodes}")}
for name, (theta, schedule) in ways.items():
    scores, ambient = charges(theta, [nodes[0], nodes[-1]], 100, schedule, seed=1)
    minutes, over_limit = [s.metrics["t80_min"] for s in scores], sum(not s.feasible for s in scores)
    over.plot(ambient, [1e3 * score.excess["voltage_max_V"] for score in scores], "o")
    time.plot(ambient, minutes, "o", label=f"{name}: {over_limit} of 100 over the limit, mean {np.mean(minutes):.1f} min")
over.axhline(0, color="black", linestyle=":")
over.set(xlabel="ambient (°C)", ylabel="largest voltage beyond 4.2 V (mV)")
time.set(xlabel="ambient (°C)", ylabel="time to 80 % (min)")
figure.legend(loc="outside upper center", ncols=2)
