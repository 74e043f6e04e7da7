"""
A range from measured cells
===========================

Six cells of one make were pulsed. How much does the next one differ? `cells = "folder"` in the table `[range]` draws it, with R, C and
capacity correlated as among the measured cells. The six files are made here; yours come from `chargetune identify`.
"""

import tempfile
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import chargetune as ct

# %%
# Cells that differ by a few per cent as a whole, and a little at each state of charge.
folder, known, rng, measured = Path(tempfile.mkdtemp()), ct.default_cell(), np.random.default_rng(3), []
(folder / "cells").mkdir()
for number in range(6):
    whole, nodes = 1 + 0.05 * rng.standard_normal(), 1 + 0.01 * np.cumsum(rng.standard_normal(len(known.soc)))
    R0, R1 = (tuple(whole * nodes * getattr(known, name)) for name in ("R0_ohm", "R1_ohm"))
    measured.append(replace(known, name=f"cell {number}", R0_ohm=R0, R1_ohm=R1, capacity_Ah=known.capacity_Ah * (1.04 - 0.04 * whole)))
    (folder / "cells" / f"{number}.toml").write_text(ct.cell_toml(measured[-1]))

# %%
# The study file names the folder. The controller knows none of the six: its resistances are wrong by up to half.
STUDY = """
study = { name = "make", tuner = "range" }
controller = { mismatch_seed = 1, current_ramp_A_s = 0.1 }
estimator = { kind = "adaptive", adaptive = { soc = "measured", backoff_sd = 0.1 } }
episode = { steps = 240 }
range = { cells = "cells", soc_start = [0.05, 0.5], draws = 100 }
theta = { backoff = { nodes = 2, lower_V = 0.0, upper_V = 0.1 } }
"""
(folder / "study.toml").write_text(STUDY)
config = ct.load_config(folder / "study.toml")
evaluation = ct.evaluation_of("range", problem := config.problem(folder))
with ct.Store(folder / "study.sqlite") as store, ct.open_study(store, config, folder) as study:
    thetas = {"untuned": problem.space.default, "tuned": study.run(evaluation, 2).theta}

# %%
# What was measured, a hundred cells of the make, and the voltage of each with and without the tuned margin.
figure, (table, excess) = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
for name, theta in thetas.items():
    results = evaluation.results(np.array(theta), seed=2026)
    tables = [1e3 * np.ravel(dict(one.plant.plant.model.parameters)["R0_ohm"]) for one in results]
    over = 1e3 * np.array([one.score.excess["voltage_max_V"] for one in results])
    label = f"{name}: {sum(not one.score.feasible for one in results)} of 100 over the limit"
    excess.plot(np.mean(tables, axis=1), over, "o", label=label)
    print(f"{name}: theta {np.round(1e3 * np.array(theta), 1)} mV, worst excess {over.max():+.1f} mV")
for values, color in ((tables, "0.8"), ([1e3 * np.array(one.R0_ohm) for one in measured], "C0")):
    table.plot(100 * np.array(known.soc), np.transpose(values), color=color)
table.set(xlabel="SOC (%)", ylabel="R0 (mΩ)", title="six measured cells (blue), a hundred drawn ones")
excess.set(xlabel="mean R0 of the drawn cell (mΩ)", ylabel="largest voltage beyond 4.2 V (mV)")
figure.legend(loc="outside upper right")
