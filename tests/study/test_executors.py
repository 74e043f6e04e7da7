import os
import signal
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import pytest
from study_toy import Deadly, OnlyHere, Toy, begin_and_wait, environment, essence, open_study

from chargetune.study import executors
from chargetune.study.executors import bounded_workers, process_executor
from chargetune.study.store.store import Store
from chargetune.study.study import StudyError, WorkerError


def test_processes_give_the_trials_of_this_process(store, tmp_path):
    with open_study(store, batch=4) as study, process_executor(2) as pool:
        study.run(Toy(), 16, executor=pool)
        found = essence(study.trials())
    with Store(tmp_path / "whole.db") as other, open_study(other, batch=4) as study:
        study.run(Toy(), 16)
        assert essence(study.trials()) == found


def test_a_plant_that_ends_its_process_costs_its_own_trial_only(store, tmp_path):
    with open_study(store, batch=4) as study, process_executor(2) as pool:
        study.run(Deadly(5), 12, executor=pool)
        trials = study.trials()
    with Store(tmp_path / "whole.db") as other, open_study(other, batch=4) as study:
        study.run(Toy(), 8)
        expected = essence(study.trials())
    assert essence(trials)[:5] + essence(trials)[6:8] == expected[:5] + expected[6:]
    assert [t.number for t in trials if t.losses] == [5]
    assert trials[5].losses == 3
    assert trials[5].ending.startswith("lost: each of 3 attempts ended with the process that evaluated it (BrokenProcessPool: ")
    assert trials[5].score is None


def test_a_worker_lost_once_costs_nothing(store, tmp_path):
    with open_study(store, batch=3) as study, process_executor(2) as pool:
        study.run(Deadly(4, tmp_path / "once"), 9, executor=pool)
        found = essence(study.trials())
        assert [t.losses for t in study.trials()] == [0, 0, 0, 0, 1, 0, 0, 0, 0]
    with Store(tmp_path / "whole.db") as other, open_study(other, batch=3) as study:
        study.run(Toy(), 9)
        assert essence(study.trials()) == found


def test_a_pool_that_breaks_as_a_whole_is_given_up_and_resumes_lose_one_trial(store, tmp_path):
    """Of Python's own pool nobody can say which call broke it: a resume evaluates the suspects one by one."""
    with open_study(store, batch=4) as study:
        for _ in range(3):
            with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool, pytest.raises(WorkerError, match="same call resumes"):
                study.run(Deadly(2), 8, executor=pool)
        with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
            study.run(Deadly(2), 8, executor=pool)
        trials = study.trials()
    assert [t.number for t in trials if (t.ending or "").startswith("lost:")] == [2]
    assert all(t.losses <= 1 for t in trials if t.number != 2)
    with Store(tmp_path / "whole.db") as other, open_study(other, batch=4) as study:
        study.run(Toy(), 4)
        assert [e for e in essence(study.trials()) if e[0] != 2] == [e for e in essence(trials)[:4] if e[0] != 2]


def run_deadly(path):
    with Store(path) as store, open_study(store) as study:
        study.run(Deadly(2), 6)


def test_a_plant_that_ends_the_process_of_the_study_costs_one_trial(store):
    endings = []
    for _ in range(4):
        process = get_context("fork").Process(target=run_deadly, args=(store.location,))
        process.start()
        process.join()
        endings.append(process.exitcode)
    trials = store.trials(1)
    assert endings == [7, 7, 7, 0]
    assert trials[2].ending == "lost: each of 3 attempts ended with the process that evaluated it"
    assert [t.number for t in trials if t.losses or t.ending.startswith("lost")] == [2]
    assert len(trials) == 6


def test_what_may_not_be_repeated_stops_the_study_until_somebody_tells_it(store):
    with open_study(store) as study, process_executor(1) as pool:
        with pytest.raises(WorkerError):
            study.run(Deadly(1), 4, executor=pool, attempts=1)
        assert [t.status for t in study.trials()] == ["done", "running"]
        with pytest.raises(StudyError, match=r"the trials \[1\] were begun and are not told.*tell them or let them fail"):
            study.run(Toy(), 4, attempts=1)
        study.fail(1, "the operator looked: it never started")
        study.run(Toy(), 4, attempts=1)
        assert len(study.trials()) == 4


def test_an_evaluation_that_no_worker_can_read_is_no_trials_fault(store):
    with open_study(store) as study, process_executor(1) as pool:
        with pytest.raises(WorkerError, match="a worker gave no result"):
            study.run(OnlyHere(), 4, executor=pool)
        (trial,) = study.running()
        assert trial.losses == 0
        study.run(Toy(), 4, executor=pool)
        assert [t.status for t in study.trials()] == ["done"] * 4


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
        # The first to have started may have taken them all.
        while len({process for *_, process in found}) < 2:
            found += pool.map(environment, range(2))
    assert {threads for threads, *_ in found} == {"1"}
    assert {on_ctrl_c for _, on_ctrl_c, _ in found} == {signal.SIG_IGN}
    assert len({process for *_, process in found}) == 2
    assert os.environ["OMP_NUM_THREADS"] == "2"
    assert "OPENBLAS_NUM_THREADS" not in os.environ


@pytest.mark.parametrize("workers", [0, -1, True, 1.0])
def test_bad_workers(workers):
    with pytest.raises(ValueError, match=f"workers = {workers}, allowed is an integer >= 1"):
        process_executor(workers)


def test_an_interrupt_waits_for_no_evaluation_and_cancels_what_is_queued(tmp_path):
    calls = []

    def interrupted():
        with process_executor(2) as pool:
            calls.extend(pool.submit(begin_and_wait, tmp_path, number) for number in range(6))
            while len(list(tmp_path.iterdir())) < 2:
                time.sleep(0.02)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert [call.cancelled() for call in calls[2:]] == [True] * 4
    # What ran left its evaluation in order, and is no more.
    assert sorted(p.name for p in tmp_path.iterdir()) == ["0", "0 left", "1", "1 left"]
    until = time.monotonic() + 60
    for number in (0, 1):
        while gone(int((tmp_path / str(number)).read_text())) is False:
            assert time.monotonic() < until
            time.sleep(0.02)


def gone(process):
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return True
    return False


@pytest.mark.parametrize(
    ("wanted", "work", "count", "said"),
    [
        (1, None, 1, ""),
        (4, None, 4, ""),
        (4, 9, 4, ""),
        (4, 3, 3, "workers = 4 lowered to 3: 3 trials to run"),
        (4, 1, 1, "workers = 4 lowered to 1: 1 trial to run"),
        (1000, None, 4, "workers = 1000 lowered to 4: this machine has 4 cores"),
        (1000, 3, 3, "workers = 1000 lowered to 3: 3 trials to run"),
        (2, 0, 1, "workers = 2 lowered to 1: 0 trials to run"),
    ],
)
def test_workers_are_not_more_than_cores_and_trials(monkeypatch, wanted, work, count, said):
    monkeypatch.setattr(executors, "_cores", lambda: 4)
    assert bounded_workers(wanted, work) == (count, said)


def test_a_study_and_an_executor_of_its_own_say_that_workers_are_lowered(store, monkeypatch):
    monkeypatch.setattr(executors, "_cores", lambda: 1)
    with pytest.warns(RuntimeWarning, match="workers = 24 lowered to 1: this machine has 1 core"), process_executor(24):
        pass
    with open_study(store) as study, pytest.warns(RuntimeWarning, match="workers = 24 lowered to 1"):
        study.run(Toy(), 2, workers=24)
