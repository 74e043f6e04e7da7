"""A Dask cluster on this machine as the executor of a study: real schedulers, real workers, real deaths."""

import os
import signal

import dask
import pytest
from distributed import Client, LocalCluster
from study_toy import Deadly, Toy, Waits, essence, open_study

from chargetune.study.store.store import Store


@pytest.fixture(scope="module")
def client():
    # One death of a worker is told at once, instead of after Dask's own three repetitions.
    settings = {"distributed.scheduler.allowed-failures": 0, "distributed.worker.daemon": True}
    with (
        dask.config.set(settings),
        LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster,
        Client(cluster) as connected,
    ):
        yield connected


def uninterrupted(tmp_path, trials, **changes):
    with Store(tmp_path / "whole.db") as store, open_study(store, **changes) as study:
        study.run(Toy(), trials)
        return essence(study.trials())


def test_a_worker_killed_in_the_middle_costs_nothing(store, tmp_path, client):
    killed = []

    def kill_one(trial, *_):
        if trial.number == 5:
            killed.append(min(client.run(os.getpid).values()))
            os.kill(killed[0], signal.SIGKILL)

    with open_study(store, batch=4) as study, client.get_executor() as executor:
        study.run(Toy(0.1), 16, executor=executor, progress=kill_one)
        found = essence(study.trials())
    assert len(killed) == 1
    assert found == uninterrupted(tmp_path, 16, batch=4)


def test_workers_of_a_cluster_never_wait(store, tmp_path, client):
    """Trial 0 ends when trial 4 has begun: with workers that wait for each other it would never."""
    with open_study(store) as study, client.get_executor() as executor:
        study.run(Waits(0, 4, tmp_path / "begun"), 8, executor=executor, workers=2)
        trials = study.trials()
    assert trials[0].status == "done"
    assert [t.provenance["pending"] for t in trials[:5]] == [[], [0], [0], [0], [0]]
    assert all(len(t.provenance["pending"]) <= 1 for t in trials)


def test_a_plant_that_ends_the_worker_costs_one_trial(store, tmp_path, client):
    with open_study(store, batch=2) as study, client.get_executor() as executor:
        study.run(Deadly(1), 4, executor=executor)
        trials = study.trials()
    assert trials[1].ending.startswith("lost: each of 3 attempts ended with the process that evaluated it (KilledWorker: ")
    assert [t.number for t in trials if t.losses] == [1]
    assert essence(trials)[:1] == uninterrupted(tmp_path, 2, batch=2)[:1]
    assert len(trials) == 4
