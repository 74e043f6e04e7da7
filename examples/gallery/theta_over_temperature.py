"""
Theta over temperature
======================

How much margin a controller needs depends on the weather: a cold cell has twice the resistance of a warm one, is at its voltage limit
from the beginning, and there the controller's error counts. One margin for all seasons is that of the worst day. A schedule is a theta
for each of several ambient temperatures, read before a charge begins and interpolated in between.
"""

import tempfile
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import chargetune as ct
from chargetune.battery.cell.cell import default_cell
from chargetune.battery.cell.thermal import Thermal
from chargetune.battery.identification.pulse_fit import cell_toml
from chargetune.battery.studies.open_study import evaluation_of

# %%
# The cell of the case study with a temperature, an invented one: its resistances fall by 30 kJ/mol. The controller does not read the
# voltage and is wrong about the resistances.
thermal = Thermal(heat_capacity_J_K=40.0, cooling_W_K=0.05, activation_J_mol=30e3)
folder = Path(tempfile.mkdtemp())
(folder / "cell.toml").write_text(cell_toml(replace(default_cell(), thermal=thermal)))
STUDY = """
study = {{ tuner = "range" }}
cell = {{ file = "cell.toml" }}
controller = {{ mismatch_seed = 1 }}
limits = {{ current_max_A = 4.0 }}
episode = {{ steps = 240 }}
objective = {{ charge_time_to_soc = 0.8 }}
range = {{ soc_start = [0.1, 0.4], ambient_K = {ambient}, draws = {draws} }}
theta = {{ backoff = {{ nodes = 2, lower_V = 0.0, upper_V = 0.25 }}{schedule} }}
"""


def charges(theta, ambient, draws, schedule="", seed=0):
    """A score for each of these charges in an ambient within two temperatures, and that ambient."""
    (folder / "study.toml").write_text(STUDY.format(ambient=ambient, draws=draws, schedule=schedule))
    results = evaluation_of("range", ct.load_config(folder / "study.toml").problem(folder)).results(np.array(theta), seed)
    return [one.score for one in results], np.array([one.plant.plant.start["temperature_K"] for one in results])


# %%
# The smallest constant margin in each of six ambients, by bisection on 16 starts.
nodes = [float(k) for k in np.linspace(283.15, 308.15, 6)]
margins = []
for ambient in nodes:
    low, high = 0.0, 0.25
    while high - low > 1e-3:
        middle = (low + high) / 2
        kept = all(score.feasible for score in charges([middle, middle], [ambient, ambient], 16)[0])
        low, high = (low, middle) if kept else (middle, high)
    margins.append(high)
print(np.round(margins,3))
figure, (over, time) = plt.subplots(1, 2, figsize=(9, 4), layout="constrained")
ways = {"one margin": (np.full(2, max(margins)), ""), "a margin over the temperature": (np.repeat(margins, 2), f", schedule = {{ ambient_K = {nodes} }}")}
for name, (theta, schedule) in ways.items():
    scores, ambient = charges(theta, [nodes[0], nodes[-1]], 100, schedule, seed=1)
    minutes = [score.metrics["t80_min"] for score in scores]
    over.plot(ambient - 273.15, [1e3 * score.excess["voltage_max_V"] for score in scores], "o", label=name)
    time.plot(ambient - 273.15, minutes, "o", label=name)
    print(f"{name}: {sum(not score.feasible for score in scores)} of 100 over the limit, 80 % after {np.mean(minutes):.1f} min")
over.axhline(0, color="black", linestyle=":")
over.set(xlabel="ambient (°C)", ylabel="largest voltage beyond 4.2 V (mV)")
time.set(xlabel="ambient (°C)", ylabel="time to 80 % (min)")
time.legend()
