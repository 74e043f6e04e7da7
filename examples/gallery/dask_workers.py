"""
Workers with Dask
=================

Trials that take hours want more than one machine. The study, its tuner and its store stay in this process; the trials go to the workers of
a Dask cluster. Here these are two threads, so that this page is made quickly; `LocalCluster(n_workers=8)` has processes, and
`Client("tcp://scheduler:8786")` is a cluster of your own. It needs the extra `dask`.
"""

import tempfile
import time
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import matplotlib.pyplot as plt
from distributed import Client, LocalCluster

import chargetune as ct

TRIALS = 12


# %%
# What a worker does is data, which can be sent. The pause stands for a plant that takes its time, one trial longer than the other.
@dataclass(frozen=True)
class LongCharge:
    """A charge that seems to last."""

    problem: ct.ChargingProblem

    def __call__(self, theta, seed):
        time.sleep(0.2 + 0.6 * (seed % 101) / 100)
        return ct.evaluate(self.problem, theta, seed)


# %%
# With `workers=2` there are always two trials under way: as soon as one is told, the next theta is proposed. A worker that dies costs
# nothing but time: its trial begins again elsewhere.
config = ct.case_study("model", mismatch_seed=1, tuner="sobol")
ct.evaluate(config.problem(), None, 0)  # compiles the charge
cluster = LocalCluster(n_workers=2, threads_per_worker=1, processes=False, dashboard_address=":0")
store = ct.Store(Path(tempfile.mkdtemp()) / "study.sqlite")
with cluster, Client(cluster) as client, client.get_executor() as executor, store, ct.open_study(store, config) as study:
    study.run(LongCharge(config.problem()), TRIALS, executor=executor, workers=2)
    trials = study.trials()

# %%
# When each trial was under way: the store has both times.
figure, axes = plt.subplots(figsize=(7, 4), layout="constrained")
begun = datetime.fromisoformat(trials[0].asked_at)
for trial in trials:
    asked, told = ((datetime.fromisoformat(at) - begun).total_seconds() for at in (trial.asked_at, trial.told_at))
    axes.barh(trial.number, told - asked, left=asked, color="C0")
    print(f"trial {trial.number}: {told - asked:.1f} s, under way when it was proposed: {trial.provenance['pending'] or 'none'}")
axes.set(xlabel="time (s)", ylabel="trial", yticks=range(TRIALS), ylim=(TRIALS - 0.4, -0.6))
