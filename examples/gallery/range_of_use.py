"""
A range of use
==============

Theta is used on many cells, of any age, from any state of charge. Tuned for one of them it breaks the limit on others. So each trial is
one theta on many fresh cells that are drawn from the table `[range]`, and the worst of them counts. No real charge is made.

The study is small, that this page is made in seconds; `examples/range_charge.toml` is one at full size, run by `chargetune tune`.
"""

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import chargetune as ct

# %%
# A study file. The controller reads the voltage and estimates how much the resistances are wrong; theta is a margin to the voltage limit
# at two states of charge.
STUDY = """
study = { name = "range", tuner = "range" }
controller = { mismatch_seed = 1, current_ramp_A_s = 0.1 }
estimator = { kind = "adaptive", adaptive = { soc = "measured", backoff_sd = 0.1 } }
episode = { steps = 240 }
objective = { charge_time_to_soc = 0.8 }
range = { soc_start = [0.05, 0.5], resistance = 0.2, fade = 0.2, growth = 0.5, draws = 100 }
theta = { backoff = { nodes = 2, lower_V = 0.0, upper_V = 0.1 } }
"""
folder = Path(tempfile.mkdtemp())
(folder / "study.toml").write_text(STUDY)
config = ct.load_config(folder / "study.toml")
evaluation = ct.evaluation_of("range", config.problem())
with ct.Store(folder / "study.sqlite") as store, ct.open_study(store, config) as study:
    best = study.run(evaluation, 2)

# %%
# Both thetas on 100 cells more, which chose nothing.
figure, axes = plt.subplots(figsize=(7, 4), layout="constrained")
for name, theta in {"untuned": config.problem().space.default, "tuned": best.theta}.items():
    results = evaluation.results(np.array(theta), seed=2026)
    excess = 1e3 * np.array([one.score.excess["voltage_max_V"] for one in results])
    age = [one.plant.values["age"][0] for one in results]
    minutes = np.mean([one.score.metrics["t80_min"] for one in results])
    broken = sum(not one.score.feasible for one in results)
    axes.plot(100 * np.array(age), excess, "o", label=f"{name}: {broken} of 100 over the limit, 80 % after {minutes:.1f} min")
    print(f"{name}: theta {np.round(1e3 * np.array(theta), 1)} mV, worst excess {excess.max():+.1f} mV")
axes.axhline(0, color="black", linestyle=":")
axes.set(xlabel="age of the cell (% of full)", ylabel="largest voltage beyond 4.2 V (mV)")
figure.legend(loc="outside upper center")
