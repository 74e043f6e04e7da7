"""Processes that die with SIGKILL, at any moment: nothing told is lost, and the study ends as if nothing had happened."""

import multiprocessing
import os
import signal
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from sqlalchemy import Engine, event
from study_toy import Toy, essence, open_study

from chargetune.study.executors import process_executor
from chargetune.study.lease import take_lease
from chargetune.study.store import Store
from chargetune.study.study import StudyError

# A fork starts in a millisecond, so that the kills fall into the work and not into the imports.
FORK = multiprocessing.get_context("fork")
TRIALS = 48


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
    os.set_blocking(read, False)
    acknowledged, kills = set(), 0
    for pause in rng.uniform(0, 0.06, 20):
        process = FORK.Process(target=run_study, args=(path, batch, workers, write))
        process.start()
        time.sleep(pause)
        process.kill()
        process.join()
        kills += process.exitcode == -signal.SIGKILL
        try:
            data = os.read(read, 10_000)
        except BlockingIOError:
            data = b""
        acknowledged |= {int.from_bytes(data[i : i + 2], "big") for i in range(0, len(data), 2)}
        if path.exists():
            with Store(path, read_only=True) as store:
                stored = [t for s in store.studies() for t in store.trials(s.id)]
                assert acknowledged <= {t.number for t in stored if t.status != "running"}
                assert all((t.status == "done") == (t.trace_sha256 is not None) for t in stored)
                assert sum(t.status == "running" for t in stored) <= batch
    assert kills == 20
    assert 0 < len(stored) < TRIALS  # the kills hit a study at work
    run_study(path, batch, workers, write)
    os.close(read)
    os.close(write)
    with Store(path) as store, open_study(store, batch=batch) as study:
        assert essence(study.trials()) == wanted
        assert study.best().theta == best
        assert [study.trace(t.number) is not None for t in study.trials()] == [e[6] is not None for e in wanted]


def die_before(path, statement):
    @event.listens_for(Engine, "before_cursor_execute")
    def listen(_connection, _cursor, sql, *_):
        if sql.startswith(statement):
            os.kill(os.getpid(), signal.SIGKILL)

    with Store(path) as store, open_study(store) as study:
        study.run(Toy(), 3)


@pytest.mark.parametrize(
    ("statement", "studies", "running", "traces"),
    [("CREATE TABLE", None, 0, 0), ("INSERT INTO trial", 1, 0, 0), ("INSERT INTO trace", 1, 1, 0), ("UPDATE trial", 1, 1, 0)],
)
def test_kill_inside_a_transaction(tmp_path, statement, studies, running, traces):
    path = tmp_path / "s.db"
    process = FORK.Process(target=die_before, args=(path, statement.replace("CREATE TABLE", "\nCREATE TABLE")))
    process.start()
    process.join()
    assert process.exitcode == -signal.SIGKILL
    assert path.exists() == (studies is not None)
    with Store(path) as store, open_study(store) as study:
        assert [t.status for t in study.trials()] == ["running"] * running
        with store._engine.connect() as connection:
            assert connection.exec_driver_sql("SELECT count(*) FROM trace").scalar() == traces
        study.run(Toy(), 3)
        assert [t.number for t in study.trials()] == [0, 1, 2]


def hold(path, connection):
    with Store(path) as store, open_study(store):
        connection.send(os.getpid())
        connection.recv()


def test_a_second_process_is_refused_until_the_first_is_dead(store):
    open_study(store, "other").close()
    here, there = FORK.Pipe()
    process = FORK.Process(target=hold, args=(store.path, there))
    process.start()
    holder = here.recv()
    with pytest.raises(StudyError, match=rf"study 'toy' is held by process {holder} on .* since "):
        open_study(store)
    open_study(store, "other").close()
    process.kill()
    process.join()
    open_study(store).close()


def try_lease(path, connection):
    lease = take_lease(path, 1)
    connection.send(lease is not None)


def free_for_others(path):
    here, there = FORK.Pipe()
    process = FORK.Process(target=try_lease, args=(path, there))
    process.start()
    free = here.recv()
    process.join()
    return free


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
        pids = list(pool.map(pid_after, [0.3, 0.3]))
        connection.send(pids)
        study.run(Toy(0.05), TRIALS, executor=pool)


def pid_after(pause_s):
    time.sleep(pause_s)
    return os.getpid()


def alive(pid):
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="looks into /proc")
def test_workers_do_not_outlive_a_killed_study(store):
    here, there = FORK.Pipe()
    process = FORK.Process(target=start_workers, args=(store.path, there))
    process.start()
    workers = here.recv()
    assert len(set(workers)) == 2
    assert all(alive(w) for w in workers)
    process.kill()
    process.join()
    deadline = time.monotonic() + 5
    while any(alive(w) for w in workers) and time.monotonic() < deadline:
        time.sleep(0.02)
    assert not any(alive(w) for w in workers)
    open_study(store, batch=2).close()
