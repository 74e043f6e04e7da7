import os
import signal
import time

import pytest
from study_toy import Toy, crash, essence, open_study

from chargetune.study.executors import process_executor
from chargetune.study.store import Store
from chargetune.study.study import WorkerError


def environment(_):
    time.sleep(0.2)
    return os.environ["OMP_NUM_THREADS"], signal.getsignal(signal.SIGINT), os.getpid()


def test_processes_give_the_trials_of_this_process(store, tmp_path):
    with open_study(store, batch=4) as study, process_executor(2) as pool:
        study.run(Toy(), 16, executor=pool)
        found = essence(study.trials())
    with Store(tmp_path / "whole.db") as other, open_study(other, batch=4) as study:
        study.run(Toy(), 16)
        assert essence(study.trials()) == found


def test_a_lost_worker_is_told_and_its_trials_can_be_run_again(store, tmp_path):
    with open_study(store, batch=2) as study:
        with process_executor(1) as pool, pytest.raises(WorkerError, match="the same call resumes"):
            study.run(crash, 4, executor=pool)
        assert [t.status for t in study.trials()] == ["running"] * 2
        study.run(Toy(), 4)
        assert not study.running()


def test_what_does_not_pickle_is_refused_before_the_first_trial(store):
    with open_study(store) as study, process_executor(1) as pool:
        with pytest.raises(ValueError, match="does not go to another process"):
            study.run(lambda *_: None, 4, executor=pool)
        assert study.trials() == []


def test_workers_have_one_thread_ignore_ctrl_c_and_this_process_keeps_its_own_setting(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    with process_executor(2) as pool:
        found = list(pool.map(environment, range(4)))
    assert {threads for threads, *_ in found} == {"1"}
    assert {on_ctrl_c for _, on_ctrl_c, _ in found} == {signal.SIG_IGN}
    assert len({process for *_, process in found}) == 2
    assert os.environ["OMP_NUM_THREADS"] == "2"
    assert "OPENBLAS_NUM_THREADS" not in os.environ


@pytest.mark.parametrize("workers", [0, -1, True, 1.0])
def test_bad_workers(workers):
    with pytest.raises(ValueError, match=f"workers = {workers}, allowed is an integer >= 1"):
        process_executor(workers)
