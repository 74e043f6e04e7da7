"""Processes that die with SIGKILL, at any moment: nothing told is lost, and the study ends as if nothing had happened."""

import multiprocessing
import os
import select
import signal
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from sqlalchemy import Engine, event
from study_toy import Toy, essence, open_study, pid_after, told_by_another_process

from chargetune.study.executors import process_executor
from chargetune.study.store.integrity import check_store
from chargetune.study.store.lease import take_lease
from chargetune.study.store.store import Store
from chargetune.study.study import StudyError

# A fork starts in a millisecond, so that the kills fall into the work and not into the imports.
FORK = multiprocessing.get_context("fork")
TRIALS = 96


def run_study(path, batch, workers, told):
    with Store(path) as store, open_study(store, batch=batch) as study:

        def acknowledge(trial, *_):
            os.write(told, trial.number.to_bytes(2, "big"))

        if workers is None:
            study.run(Toy(0.01), TRIALS, progress=acknowledge)
        else:
            with ThreadPoolExecutor(workers) as pool:
                study.run(Toy(0.01), TRIALS, executor=pool, progress=acknowledge)


@pytest.mark.parametrize(("batch", "workers"), [(1, None), (4, 2)])
def test_twenty_kills_at_random_moments(tmp_path, batch, workers):
    with Store(tmp_path / "whole.db") as store, open_study(store, batch=batch) as study:
        study.run(Toy(), TRIALS)
        wanted, best = essence(study.trials()), study.best().theta

    path = tmp_path / "killed.db"
    rng = np.random.default_rng(5)
    read, write = os.pipe()
    acknowledged, kills, hits = set(), 0, 0
    for k, pause in enumerate(rng.uniform(0, 0.03, 20)):
        process = FORK.Process(target=run_study, args=(path, batch, workers, write))
        process.start()
        if k % 2:  # the others may hit the creation of the file, the opening, the first ask
            select.select([read], [], [], 30)
        time.sleep(pause)
        process.kill()
        process.join()
        kills += process.exitcode == -signal.SIGKILL
        data = os.read(read, 10_000) if select.select([read], [], [], 0)[0] else b""
        acknowledged |= {int.from_bytes(data[i : i + 2], "big") for i in range(0, len(data), 2)}
        if path.exists():
            with Store(path, read_only=True) as store:
                stored = [t for s in store.studies() for t in store.trials(s.id)]
                assert acknowledged <= {t.number for t in stored if t.status != "running"}
                assert all((t.status == "done") == (t.trace_sha256 is not None) for t in stored)
                waiting = sum(t.status == "running" for t in stored)
                assert waiting <= batch
                hits += waiting > 0
    assert kills >= 19  # the last process may have come to its end
    assert len(acknowledged) >= 10
    assert hits >= 5  # the kills hit a study at work
    run_study(path, batch, workers, write)
    os.close(read)
    os.close(write)
    with Store(path) as store, open_study(store, batch=batch) as study:
        assert essence(study.trials()) == wanted
        assert study.best().theta == best
        assert [study.trace(t.number) is not None for t in study.trials()] == [e[6] is not None for e in wanted]


def die_before(path, statement, hardware):
    @event.listens_for(Engine, "before_cursor_execute")
    def listen(_connection, _cursor, sql, *_):
        if sql.startswith(statement):
            os.kill(os.getpid(), signal.SIGKILL)

    with Store(path) as store, open_study(store, hardware=hardware) as study:
        study.run(Toy(), 3)


# Where a process dies -> studies, running trials, and whether the trial may have begun.
MOMENTS = {
    "\nCREATE TABLE": (None, 0, 0),
    "INSERT INTO trial": (1, 0, 0),
    "UPDATE trial SET attempt": (1, 1, 0),  # between ask and start
    "INSERT INTO trace": (1, 1, 1),
    "UPDATE trial SET number": (1, 1, 1),  # the result, after its trace
}


@pytest.mark.parametrize("hardware", [False, True])
@pytest.mark.parametrize("statement", MOMENTS)
def test_kill_inside_a_transaction(tmp_path, statement, hardware):
    studies, running, begun = MOMENTS[statement]
    path = tmp_path / "s.db"
    process = FORK.Process(target=die_before, args=(path, statement, hardware))
    process.start()
    process.join()
    assert process.exitcode == -signal.SIGKILL
    assert path.exists() == (studies is not None)
    with Store(path) as store, open_study(store, hardware=hardware) as study:
        assert [(t.status, t.attempt) for t in study.trials()] == [("running", begun)] * running
        with store._engine.connect() as connection:
            assert connection.exec_driver_sql("SELECT count(*) FROM trace").scalar() == 0
        if hardware and begun:
            with pytest.raises(StudyError, match=r"trials \[0\] were begun"):
                study.run(Toy(), 3)
            study.fail(0, "the operator: was not charged")
        study.run(Toy(), 3)
        assert [t.number for t in study.trials()] == [0, 1, 2]
        assert [t.attempt for t in study.trials()] == [1 if hardware else 1 + begun, 1, 1]


def test_a_log_that_ends_anywhere_holds_trace_and_result_or_neither(tmp_path):
    """As after a loss of power: of the last transaction any part may have reached the disk."""
    path, wal = tmp_path / "s.db", tmp_path / "s.db-wal"
    with Store(path) as store, open_study(store) as study:
        (trial,) = study.hand_out(study.ask())
        before = wal.stat().st_size
        score, episode, ending = Toy()(trial.theta, trial.seed)
        study.tell(0, score, episode, ending=ending)
        after = wal.stat().st_size
        main, log = path.read_bytes(), wal.read_bytes()
    assert after > before + 4096
    found = []
    for k, length in enumerate([*np.linspace(before, after, 40).astype(int).tolist(), after - 1, after]):
        cut = tmp_path / f"{k}.db"
        cut.write_bytes(main)
        cut.with_name(cut.name + "-wal").write_bytes(log[:length])
        with Store(cut) as store:
            (stored,) = store.trials(1)
            trace = store.trace(1, 0)
            assert (stored.status == "done") == (trace is not None)
            assert check_store(cut).findings == ()
            found.append(str(stored.status))
    assert found[0] == found[-2] == "running"
    assert found[-1] == "done"


def try_lease(path, connection):
    lease = take_lease(path, 1)
    connection.send(lease is not None)


def free_for_others(path):
    return told_by_another_process(try_lease, path)


def test_lease_counts_within_a_process_and_is_not_inherited(tmp_path):
    path = tmp_path / "s.db"
    one, two, other = take_lease(path, 1), take_lease(path, 1), take_lease(path, 2)
    assert not free_for_others(path)
    one.release()
    assert not free_for_others(path)
    two.release()
    assert free_for_others(path)
    two.release()
    again = take_lease(path, 1)
    other.release()
    assert not free_for_others(path)  # closing one study must not free the other
    again.release()
    assert free_for_others(path)


def start_workers(path, connection):
    with Store(path) as store, open_study(store, batch=2) as study:
        pool = process_executor(2)
        connection.send(both_at_work(pool))
        study.run(Toy(0.05), TRIALS, executor=pool)


def both_at_work(pool):
    pids = set()
    # The first to have started may take both.
    while len(pids) < 2:
        pids |= set(pool.map(pid_after, [0.1, 0.1]))
    return pids


def alive(pid):
    try:
        os.kill(pid, 0)
        # Where nobody collects the dead, a number of a process alone says nothing.
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z" if Path("/proc/self/stat").exists() else True
    except (ProcessLookupError, FileNotFoundError):
        return False


def test_workers_do_not_outlive_a_killed_study(store, tmp_path):
    here, there = FORK.Pipe()
    process = FORK.Process(target=start_workers, args=(store.location, there))
    process.start()
    workers = here.recv()
    assert len(workers) == 2
    assert all(alive(w) for w in workers)
    process.kill()
    process.join()
    deadline = time.monotonic() + 30
    while any(alive(w) for w in workers) and time.monotonic() < deadline:
        time.sleep(0.02)
    assert not any(alive(w) for w in workers)
    with open_study(store, batch=2) as study:
        study.run(Toy(), TRIALS)
        found = essence(study.trials())
    with Store(tmp_path / "whole.db") as other, open_study(other, batch=2) as study:
        study.run(Toy(), TRIALS)
        assert essence(study.trials()) == found


def until_ctrl_c(path, connection):
    os.setsid()
    with Store(path) as store, open_study(store, batch=2) as study, process_executor(2) as pool:
        both_at_work(pool)
        try:
            study.run(Toy(0.05), TRIALS, executor=pool, progress=lambda trial, *_: connection.send(trial.number))
        except KeyboardInterrupt:
            sys.exit(130)


def test_ctrl_c_of_the_whole_process_group_stops_between_trials(store):
    here, there = FORK.Pipe()
    process = FORK.Process(target=until_ctrl_c, args=(store.location, there))
    process.start()
    assert here.recv() in {0, 1}
    os.killpg(process.pid, signal.SIGINT)
    process.join(60)
    assert process.exitcode == 130
    trials = store.trials(1)
    assert "failed" not in {t.status for t in trials if t.theta[0] <= 0.85}
    assert len(trials) < TRIALS
    assert sum(t.status == "running" for t in trials) <= 2
    open_study(store, batch=2).close()
