"""A store that the first schema's program wrote, brought to this schema."""

import hashlib
import multiprocessing
import os
import shutil
import signal
import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from sqlalchemy import Engine, event
from study_toy import Toy, essence, open_study

from chargetune.study.result import Reason, read_result
from chargetune.study.store.schema import SCHEMA_VERSION
from chargetune.study.store.store import Store, StoreError
from chargetune.study.trial import best_feasible

FORK = multiprocessing.get_context("fork")
# Written by the program of schema 1: study "toy" (batch 2) with 8 told trials and one running, study "second" with 2.
OLD = Path(__file__).parent / "data" / "schema-1.db"
FAILED = 4


@pytest.fixture
def old(tmp_path):
    return Path(shutil.copy(OLD, tmp_path / "s.db"))


def voltage(theta, seed):
    return Toy()(theta, seed)[1].voltage


def columns(path):
    with closing(sqlite3.connect(path)) as connection:
        tables = [row[0] for row in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table' ORDER BY name")]
        return {t: sorted(row[1:] for row in connection.execute("SELECT * FROM pragma_table_info(?)", (t,))) for t in tables}


def test_an_old_store_is_migrated_with_a_copy_and_its_study_goes_on(old, tmp_path):
    before = old.read_bytes()
    with Store(old) as store:
        trials = store.trials(1)
        assert [t.status for t in trials] == ["failed" if k == FAILED else "done" for k in range(8)] + ["running"]
        assert [t.attempt for t in trials] == [1] * 9
        assert store.trace(1, FAILED) is None
        for trial in (t for t in trials if t.status == "done"):
            arrays, meta = store.trace(1, trial.number)
            np.testing.assert_array_equal(arrays["voltage"], voltage(trial.theta, trial.seed))
            assert meta["units"] == {"voltage": "V"}
        with open_study(store, batch=2) as study:
            study.run(Toy(), 10)
            continued = essence(study.trials())
        assert [r.name for r in store.studies()] == ["toy", "second"]
    with Store(tmp_path / "new.db") as store, open_study(store, batch=2) as study:
        study.run(Toy(), 10)
        assert essence(study.trials()) == continued
    assert columns(old) == columns(tmp_path / "new.db")
    copy = tmp_path / "s.db.schema-1"
    with closing(sqlite3.connect(copy)) as connection:
        assert connection.execute("SELECT count(*) FROM trial").fetchone() == (11,)
        assert connection.execute("SELECT max(schema_version) FROM chargetune_store").fetchone() == (1,)
    assert before == OLD.read_bytes()
    with closing(sqlite3.connect(old)) as connection:
        assert connection.execute("SELECT schema_version FROM chargetune_store ORDER BY 1").fetchall() == [(1,), (SCHEMA_VERSION,)]


def test_the_second_schema_is_migrated_and_its_result_is_what_was_measured_until_the_tuner_is_asked(tmp_path):
    # Written by the program of schema 2: study "toy" (batch 2) with 8 told trials and one running, study "second" with 2.
    path = Path(shutil.copy(OLD.with_name("schema-2.db"), tmp_path / "s.db"))
    with pytest.raises(StoreError, match=r"schema version 2, this program reads version 3; `chargetune store migrate .*s.db`"):
        Store(path, read_only=True)
    with Store(path) as store:
        record = store.study("toy")
        trials = store.trials(record.id)
        assert [t.status for t in trials] == ["failed" if k == FAILED else "done" for k in range(8)] + ["running"]
        found = read_result(store, record)
        assert (found.trial, found.reason, found.asked) == (best_feasible(trials), Reason.MEASURED, False)
        assert "the tuner was not asked" in found.sentence
        with open_study(store, batch=2) as study:
            study.run(Toy(), 10)
        assert read_result(store, record).asked
    Store(tmp_path / "new.db").close()
    assert columns(path) == columns(tmp_path / "new.db")
    assert (tmp_path / "s.db.schema-2").exists()


def test_a_store_is_migrated_once_and_a_copy_is_never_overwritten(old, tmp_path):
    (tmp_path / "s.db.schema-1").write_text("of an earlier attempt")
    for _ in range(2):
        Store(old).close()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["s.db", "s.db.schema-1", "s.db.schema-1.1"]
    assert (tmp_path / "s.db.schema-1").read_text() == "of an earlier attempt"


def test_reading_migrates_nothing_and_says_what_does(old):
    before = old.read_bytes()
    with pytest.raises(StoreError, match=r"schema version 1, this program reads version 3; `chargetune store migrate .*s.db`"):
        Store(old, read_only=True)
    assert old.read_bytes() == before


@pytest.mark.parametrize("kind", ["hash", "content", "dtype"])
def test_a_damaged_trace_stays_flagged(old, kind):
    with closing(sqlite3.connect(old)) as connection:
        data = connection.execute("SELECT data FROM trace WHERE study_id = 1 AND number = 3").fetchone()[0]
        bad = data[:-4] + b"????" if kind != "dtype" else data.replace(b'"<f8"', b'"<O8"')
        connection.execute("UPDATE trace SET data = ? WHERE study_id = 1 AND number = 3", (bad,))
        if kind != "hash":  # as a faulty program would have stored it
            connection.execute("UPDATE trial SET trace_sha256 = ? WHERE study_id = 1 AND number = 3", (hashlib.sha256(bad).hexdigest(),))
        connection.commit()
    with Store(old) as store:
        with pytest.raises(StoreError, match="the trace of trial 3 is damaged"):
            store.trace(1, 3)
        assert all(store.trace(1, k) is not None for k in range(8) if k not in (3, FAILED))


def die_at(path, statement):
    @event.listens_for(Engine, "before_cursor_execute")
    def listen(_connection, _cursor, sql, *_):
        if sql.startswith(statement):
            os.kill(os.getpid(), signal.SIGKILL)

    Store(path)


@pytest.mark.parametrize("statement", ["ALTER TABLE study", "ALTER TABLE holder", "UPDATE trace", "INSERT INTO chargetune_store"])
def test_a_kill_leaves_the_old_store_whole(old, statement):
    process = FORK.Process(target=die_at, args=(old, statement))
    process.start()
    process.join()
    assert process.exitcode == -signal.SIGKILL
    with pytest.raises(StoreError, match="schema version 1"):
        Store(old, read_only=True)
    with Store(old) as store:
        assert len(store.trials(1)) == 9
        assert store.trace(1, 7) is not None


def open_and_count(path, connection):
    with Store(path) as store:
        connection.send(len(store.trials(1)))


def test_several_processes_migrate_together(old, tmp_path):
    pipes = [FORK.Pipe() for _ in range(4)]
    processes = [FORK.Process(target=open_and_count, args=(old, there)) for _, there in pipes]
    for process in processes:
        process.start()
    assert [here.recv() for here, _ in pipes] == [9] * 4
    for process in processes:
        process.join()
    assert len(list(tmp_path.glob("s.db.schema-1*"))) == 1
