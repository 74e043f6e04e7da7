"""
The case study in one page
==========================

Hirt et al. (ADCHEM 2024) tune a charging controller by Bayesian optimisation: nine factors on the resistance R1 in its model. A
tuner that sees one score a charge needs many charges; one that reads the whole trace needs few.
"""

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import chargetune as ct

# %%
# The same plant, the same wrong model, three tuners: points that fill the space, iterative learning, and the twin.
TRIALS = {"sobol": 20, "iterative_learning": 5, "twin": 4}
folder = Path(tempfile.mkdtemp())
found = {}
for tuner, trials in TRIALS.items():
    config = ct.case_study("model", mismatch_seed=1, tuner=tuner)
    with ct.Store(folder / f"{tuner}.sqlite") as store, ct.open_study(store, config) as study:
        study.run(ct.evaluation_of(tuner, config.problem()), trials)
        found[tuner] = study.trials()

# %%
# Each charge by its excess over 4.2 V, and by the time to 80 %.
figure, (over, time) = plt.subplots(1, 2, figsize=(9, 4), layout="constrained")
for tuner, trials in found.items():
    charges = np.arange(1, len(trials) + 1)
    over.plot(charges, [t.score.metrics["overshoot_mV"] for t in trials], "o-", label=tuner)
    kept = [t.score.metrics["t80_min"] if t.score.feasible else np.inf for t in trials]
    time.plot(charges, np.minimum.accumulate(kept), "o-", label=tuner)
over.axhline(0, color="black", linestyle=":")
over.set(xlabel="charge", xticks=range(0, 21, 5), ylabel="excess over the limit (mV)")
time.set(xlabel="charge", ylabel="best time to 80 % within the limit (min)", xticks=range(1, 6))
over.legend()

for tuner, trials in found.items():
    kept = [t for t in trials if t.score.feasible]
    best = f"{min(t.score.metrics['t80_min'] for t in kept):.1f} min" if kept else "none kept the limit"
    print(f"{tuner:18s} {len(trials):2d} charges, {len(trials) - len(kept):2d} over the limit, best {best}")
