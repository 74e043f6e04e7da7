"""
Feedback or learning
====================

The controller's resistances are wrong by up to a half. There are two remedies: an observer that reads the voltage, which acts at
every sample and needs no trial, and learning, which needs a few whole charges and knows more afterwards. So take feedback for what
is measured, and learn what is left.
"""

import tempfile
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt

import chargetune as ct

# %%
# The published controller does not read the voltage. `mismatch_seed` draws what it wrongly believes.
config = ct.case_study("model", mismatch_seed=1, tuner="twin")
problem = config.problem()
feedback = replace(problem, estimator=ct.EstimatorSettings(kind="offset_free"))

# %%
# Learning with the twin: it fits a model of the plant to every sample, three charges suffice.
path = Path(tempfile.mkdtemp()) / "study.sqlite"
with ct.Store(path) as store, ct.open_study(store, config) as study:
    learnt = study.run(ct.evaluation_of("twin", problem), 3)

# %%
# Untuned the limit of 4.2 V is exceeded; both remedies keep it.
charges = {
    "untuned": ct.run_charge(problem),
    "feedback, no trial": ct.run_charge(feedback),
    "learnt in 3 charges": ct.run_charge(problem, learnt.theta),
}
figure, axes = plt.subplots(figsize=(7, 4))
for name, episode in charges.items():
    axes.plot(episode.time_s / 60, episode.signal("voltage_V")[1], label=name)
axes.axhline(4.2, color="black", linestyle=":", label="limit")
axes.set(xlabel="time (min)", ylabel="voltage (V)", ylim=(3.9, 4.3))
axes.legend()

for name, (one, theta) in {"untuned": (problem, None), "feedback": (feedback, None), "learnt": (problem, learnt.theta)}.items():
    score, _, _ = ct.evaluate(one, theta, seed=0)
    print(f"{name:9s} over the limit by {score.metrics['overshoot_mV']:5.1f} mV, 80 % after {score.metrics['t80_min']:.1f} min")
