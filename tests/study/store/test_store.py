import multiprocessing
import os
import resource
import shutil
import signal
import sqlite3
import tempfile
import time
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from sqlalchemy import event
from study_toy import CONFIG, SPACE, Halfway, Toy, essence, open_study

from chargetune.episode.score import Score
from chargetune.study.store.integrity import check_store
from chargetune.study.store.store import Store, StoreError
from chargetune.study.store.trace import encode
from chargetune.study.trial import Trial

SCORE = Score(-1.0, -1.5, {"v": 0.1}, {"v": 0.0}, {"t80_min": None})
TRACE = encode({"v": np.arange(5.0)}, {"unit": "V"})


def a_study(store, trials=2, name="a"):
    record = store.add_study(name, {"config": CONFIG})
    store.add_trials(record.id, [Trial(k, (0.1 * k, 1.0), seed=k, asked_at="t") for k in range(trials)])
    return record.id


def finish(store, study, number, score=SCORE, ending="done", trace=TRACE):
    return store.finish_trial(study, number, score=score, ending=ending, trace=trace, provenance={"by": "test"})


def raw(store, *statements):
    with closing(sqlite3.connect(store.location, isolation_level=None)) as connection:
        return [connection.execute(*s) if isinstance(s, tuple) else connection.execute(s) for s in statements][-1].fetchall()


@contextmanager
def unprivileged():
    """Permission bits do not bind the superuser; as somebody else they do."""
    user = os.geteuid()
    if user == 0:
        os.seteuid(65534)
    try:
        yield
    finally:
        os.seteuid(user)


@pytest.fixture
def public():
    folder = Path(tempfile.mkdtemp())
    folder.chmod(0o755)
    yield folder
    folder.chmod(0o755)
    shutil.rmtree(folder)


@pytest.mark.parametrize("when", ["BEFORE INSERT ON trace", "AFTER INSERT ON trace", "BEFORE UPDATE ON trial", "AFTER UPDATE ON trial"])
def test_trace_and_result_are_stored_both_or_neither(store, when):
    study = a_study(store)
    raw(store, f"CREATE TRIGGER fault {when} BEGIN SELECT RAISE(ABORT, 'injected fault'); END")
    with pytest.raises(StoreError, match="injected fault"):
        finish(store, study, 0)
    assert raw(store, "SELECT count(*) FROM trace") == [(0,)]
    assert store.trials(study)[0].status == "running"
    raw(store, "DROP TRIGGER fault")
    assert finish(store, study, 0).status == "done"
    assert store.trace(study, 0) is not None


def room(store, pages):
    """Leave the file so many pages to grow, as a disk would."""
    with store._engine.connect() as connection:
        used = connection.exec_driver_sql("PRAGMA page_count").scalar()
        connection.exec_driver_sql(f"PRAGMA max_page_count={used + pages}")


BIG = encode({"v": np.random.default_rng(0).random(200_000)}, {})


def test_full_disk_loses_nothing_and_the_result_can_be_told_again(tmp_path):
    with Store(tmp_path / "s.db", busy_timeout_s=0.3) as store:
        study = a_study(store)
        finish(store, study, 0)
        room(store, 10)
        start = time.monotonic()
        with pytest.raises(StoreError, match="the disk is full"):
            finish(store, study, 1, trace=BIG)
        assert 0.2 < time.monotonic() - start < 5
        assert [t.status for t in store.trials(study)] == ["done", "running"]
        assert check_store(store.location).findings == ()
        room(store, 10_000)
        finish(store, study, 1, trace=BIG)
        assert store.trace(study, 1)[0]["v"].size == 200_000


def test_a_result_waits_for_room_on_the_disk(store):
    study = a_study(store)
    room(store, 10)
    starts = []

    @event.listens_for(store._engine, "begin")
    def make_room(connection):
        starts.append(time.monotonic())
        if len(starts) == 3:
            connection.exec_driver_sql("PRAGMA max_page_count=100000")

    assert finish(store, study, 0, trace=BIG).status == "done"
    assert len(starts) == 3
    assert store.trace(study, 0)[0]["v"].size == 200_000


def fill_up(path, connection):
    """Write until the system refuses: no byte of this process beyond 400 kB of a file."""
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (400_000, 400_000))
    runs = []

    def evaluate(theta, seed):
        runs.append(seed)
        return SCORE, Noise(seed), "done"

    with Store(path, busy_timeout_s=0.0) as store, open_study(store) as study:
        try:
            study.run(evaluate, 1000)
        except StoreError as error:
            connection.send((len(runs), str(error)))


@dataclass(frozen=True)
class Noise:
    seed: int

    def arrays(self):
        return {"v": np.random.default_rng(self.seed).random(2000)}

    def meta(self):
        return {}


def test_when_the_system_writes_no_more_the_study_stops_and_goes_on_later(tmp_path):
    fork = multiprocessing.get_context("fork")
    here, there = fork.Pipe()
    process = fork.Process(target=fill_up, args=(tmp_path / "s.db", there))
    process.start()
    assert here.poll(30)
    runs, message = here.recv()
    process.join()
    assert process.exitcode == 0
    assert "full" in message or "reading or writing failed on the disk" in message
    with Store(tmp_path / "s.db") as store, open_study(store) as study:
        told = [t for t in study.trials() if t.status == "done"]
        # The last one was evaluated and could not be told, or not even be begun.
        assert len(told) in {runs - 1, runs}
        assert len(told) > 5
        assert check_store(store.location).findings == ()
        study.run(lambda theta, seed: (SCORE, Noise(seed), "done"), len(told) + 3)
        assert {t.status for t in study.trials()} == {"done"}


def a_filled_file(path):
    with Store(path) as store:
        for name in "abcdefgh":
            study = a_study(store, 60, name)
            finish(store, study, 0)
    return path


def overwrite(path, start, data):
    content = bytearray(path.read_bytes())
    content[start : start + len(data)] = data
    path.write_bytes(content)


REFUSED = {
    "folder": (lambda p: p.mkdir(), "a directory"),
    "text": (lambda p: p.write_text("time,voltage\n" * 100), "not a store"),
    "empty": (lambda p: p.touch(), "an empty file"),
    "head": (lambda p: overwrite(a_filled_file(p), 0, b"x" * 16), "not a store"),
    "cut": (lambda p: os.truncate(a_filled_file(p), p.stat().st_size // 2), "damaged"),
    "garbage": (lambda p: overwrite(a_filled_file(p), 4096, np.random.default_rng(0).bytes(p.stat().st_size - 4096)), "damaged"),
    "zeros": (lambda p: overwrite(a_filled_file(p), 8192, bytes(p.stat().st_size - 8192)), "damaged"),
    "other": (lambda p: raw_create(p, "CREATE TABLE t (x)"), "not a store of this program"),
}


def raw_create(path, statement):
    with closing(sqlite3.connect(path)) as connection:
        connection.execute(statement)


@pytest.mark.parametrize("read_only", [False, True])
@pytest.mark.parametrize("kind", REFUSED)
def test_what_is_no_store_is_refused_and_left_as_it_is(tmp_path, kind, read_only):
    path = tmp_path / "s.db"
    make, message = REFUSED[kind]
    make(path)
    before = None if path.is_dir() else path.read_bytes()
    with pytest.raises(StoreError, match=message) as caught:
        Store(path, read_only=read_only)
    assert str(path) in str(caught.value)
    assert before is None or path.read_bytes() == before


@pytest.mark.parametrize("read_only", [False, True])
def test_no_folder(tmp_path, read_only):
    (tmp_path / "file").write_text("x")
    for path in (tmp_path / "none" / "s.db", tmp_path / "file" / "s.db"):
        with pytest.raises(StoreError, match="no such store" if read_only else "there is no folder"):
            Store(path, read_only=read_only)
    with pytest.raises(StoreError, match="too long"):
        Store(tmp_path / ("x" * 300), read_only=read_only)


def test_folder_without_write_permission(public):
    with unprivileged(), pytest.raises(StoreError, match="permission"):
        Store(public / "s.db")
    path = public / "t.db"
    with Store(path) as store:
        finish(store, a_study(store), 0)
    path.chmod(0o444)
    public.chmod(0o555)
    with unprivileged():
        with pytest.raises(StoreError, match="permission"):
            Store(path)
        with Store(path, read_only=True) as store:
            assert len(store.trials(1)) == 2
    assert sorted(p.name for p in public.iterdir()) == ["t.db"]


def test_long_lock_ends_in_a_message_that_names_the_holder(tmp_path):
    with Store(tmp_path / "s.db", busy_timeout_s=0.2) as store, open_study(store) as study:
        trial = study.ask()[0]
        with closing(sqlite3.connect(store.location, isolation_level=None)) as other:
            other.execute("BEGIN IMMEDIATE")
            start = time.monotonic()
            with pytest.raises(StoreError, match=rf"locked by another process.*last holder: process {os.getpid()} on "):
                study.tell(trial.number, SCORE)
            assert 0.1 < time.monotonic() - start < 5
            other.execute("ROLLBACK")
        assert study.tell(trial.number, SCORE).status == "done"


def test_commits_are_on_the_disk(store):
    with store._engine.connect() as connection:
        assert connection.exec_driver_sql("PRAGMA journal_mode").scalar() == "wal"
        assert connection.exec_driver_sql("PRAGMA synchronous").scalar() == 2
        assert connection.exec_driver_sql("PRAGMA foreign_keys").scalar() == 1


def test_leftover_of_a_killed_creation_is_no_second_name_of_the_store(store):
    leftover = Path(store.location).with_name(f".other.db.{os.getpid()}.new")
    leftover.hardlink_to(store.location)
    a_study(store)
    with Store(Path(store.location).with_name("other.db")) as other:
        assert other.studies() == []
    assert [r.name for r in store.studies()] == ["a"]
    assert not leftover.exists()


def test_bad_timeout(tmp_path):
    with pytest.raises(ValueError, match="busy_timeout_s = -1"):
        Store(tmp_path / "s.db", busy_timeout_s=-1)


def test_two_thousand_trials_list_fast(store):
    record = store.add_study("a", {})
    theta = tuple(np.random.default_rng(0).random(16))
    store.add_trials(record.id, [Trial(k, theta, provenance={"versions": {"numpy": "2.0"}}) for k in range(2000)])
    text = '{"excess":{"v":0.1},"metrics":{"t80_min":null},"objective":1.0,"performance":1.0,"tolerance":{"v":0.0}}'
    blob = os.urandom(20_000)
    with closing(sqlite3.connect(store.location)) as connection:
        connection.execute("UPDATE trial SET status = 'done', score = ?", (text,))
        connection.executemany("INSERT INTO trace (study_id, number, data) VALUES (?, ?, ?)", [(record.id, k, blob) for k in range(2000)])
        connection.commit()
    start = time.process_time()
    with Store(store.location, read_only=True) as reader:
        trials = reader.trials(record.id)
    assert len(trials) == 2000
    assert trials[-1].score is not None
    assert time.process_time() - start < 1.0  # 0.1 s here


def test_a_study_of_the_toy_is_whole_in_the_file(store):
    with open_study(store) as study:
        study.run(Toy(), 6)
        for trial in study.trials():
            assert (study.trace(trial.number) is None) == (trial.status == "failed")
        before = essence(study.trials())
    with Store(store.location, read_only=True) as reader:
        assert essence(reader.trials(reader.study("toy").id)) == before
        assert reader.study("toy").identity["tuner"] == {"type": "Halfway", "seed": 3}
    assert Halfway().ask(SPACE, []).shape == (1, 2)
