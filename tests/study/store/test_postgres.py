"""What can only happen with a server: connections that break, wrong addresses, no rights."""

import contextlib
import os
import socket
import threading
from pathlib import Path

import numpy as np
import psycopg
import pytest
from sqlalchemy import event
from study_toy import Toy, essence, open_study

from chargetune.episode.score import Score
from chargetune.study.result import read_result
from chargetune.study.store import postgres as server
from chargetune.study.store.database import database_at, store_name
from chargetune.study.store.store import Store, StoreError
from chargetune.study.store.trace import encode
from chargetune.study.trial import Trial

SCORE = Score(-1.0, -1.5, {"v": 0.1}, {"v": 0.0})
TRACE = encode({"v": np.arange(5.0)}, {})


def cut_all(url, who="chargetune"):
    """End every connection of this program to the server, as a restart or a router would."""
    with psycopg.connect(url, autocommit=True) as connection:
        query = "SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE application_name = %s AND pid <> pg_backend_pid()"
        return len(connection.execute(query, [who]).fetchall())


# Before which statement of the transaction the connection breaks.
@pytest.mark.parametrize("statement", ["SET LOCAL", "INSERT INTO chargetune.trace", "UPDATE chargetune.trial"])
def test_a_result_is_told_although_the_connection_breaks(postgres, statement):
    cuts = []

    with Store(postgres) as store, open_study(store) as study:
        (trial,) = study.ask()

        @event.listens_for(store._engine, "before_cursor_execute")
        def cut(_connection, _cursor, sql, *_):
            if sql.startswith(statement) and not cuts:
                cuts.append(cut_all(postgres))

        told = store.finish_trial(study.record.id, 0, score=SCORE, ending="done", trace=TRACE, provenance={}, term=study.term)
        assert len(cuts) == 1
        assert cuts[0] >= 1
        assert study.trials() == [told]
        assert told.theta == trial.theta
        assert study.trace(0) is not None


class Wire:
    """Passes bytes between a program and a server; ``deaf`` breaks the connection when the answer to a commit comes."""

    def __init__(self, folder, target):
        self.target, self.deaf, self.broken = target, False, 0
        self.listening = socket.socket(socket.AF_UNIX)
        self.listening.bind(str(folder / ".s.PGSQL.5432"))
        self.listening.listen()
        threading.Thread(target=self.accept, daemon=True).start()

    def accept(self):
        while True:
            try:
                here, _ = self.listening.accept()
            except OSError:
                return
            there = socket.socket(socket.AF_UNIX)
            there.connect(self.target)
            threading.Thread(target=self.forward, args=(here, there), daemon=True).start()
            threading.Thread(target=self.back, args=(there, here), daemon=True).start()

    def forward(self, source, sink):
        while (data := receive(source)) and send(sink, data):
            pass
        end(source, sink)

    def back(self, source, sink):
        while data := receive(source):
            if self.deaf and b"COMMIT\0" in data:
                self.deaf, self.broken = False, self.broken + 1
                break
            if not send(sink, data):
                break
        end(source, sink)


def receive(connection):
    try:
        return connection.recv(65536)
    except OSError:
        return b""


def send(connection, data):
    """Whether the other side still listens."""
    try:
        connection.sendall(data)
    except OSError:
        return False
    return True


def end(*connections):
    # Both sides, whichever broke: the other thread, waiting for one of them, ends too.
    for connection in connections:
        with contextlib.suppress(OSError):
            connection.shutdown(socket.SHUT_RDWR)
        connection.close()


@pytest.fixture
def wire(postgres, tmp_path_factory):
    # The path of a socket must be short.
    folder = tmp_path_factory.getbasetemp() / f"w{len(list(tmp_path_factory.getbasetemp().iterdir()))}"
    folder.mkdir()
    home = postgres.partition("host=")[2]
    wire = Wire(folder, f"{home}/.s.PGSQL.5432")
    wire.url = postgres.replace(home, str(folder))
    yield wire
    wire.listening.close()


ACTS = {
    "add_study": lambda s, k: s.add_study(f"new {k}", {"config": {}}),
    "add_trials": lambda s, k: s.add_trials(1, [Trial(len(s.trials(1)), (0.5,), asked_at="t")]),
    "hand_out": lambda s, k: s.hand_out(1, [t for t in s.trials(1) if not t.attempt][:1], "w"),
    "finish_trial": lambda s, k: s.finish_trial(1, k, score=SCORE, ending="done", trace=TRACE, provenance={}),
    "count_loss": lambda s, _: s.count_loss(1, 2),
    "change_study": lambda s, k: s.change_study(1, {"config": {"k": k}}),
    "note_holder": lambda s, k: s.note_holder(1, 1, "host"),
}


@pytest.mark.parametrize("act", ACTS)
def test_a_commit_whose_answer_is_lost_happens_once(wire, act):
    with Store(wire.url) as store:
        store.add_study("a", {}, hardware=True)
        store.add_trials(1, [Trial(k, (0.1 * k,), asked_at="t") for k in range(3)])
        ACTS[act](store, 0)
        before = len(store.studies()), len(store.trials(1)), sum(t.attempt for t in store.trials(1))
        wire.deaf = True
        ACTS[act](store, 1)
        assert wire.broken == 1
        after = len(store.studies()), len(store.trials(1)), sum(t.attempt for t in store.trials(1))
        grown = {"add_study": (1, 0, 0), "add_trials": (0, 1, 0), "hand_out": (0, 0, 1)}.get(act, (0, 0, 0))
        assert tuple(a - b for a, b in zip(after, before, strict=True)) == grown
        if act == "count_loss":
            assert store.trials(1)[2].losses == 2
        if act == "finish_trial":
            assert [t.status for t in store.trials(1)] == ["done", "done", "running"]


def test_a_study_goes_on_although_every_connection_breaks(postgres, tmp_path):
    with Store(tmp_path / "whole.db") as store, open_study(store) as study:
        study.run(Toy(), 6)
        wanted = essence(study.trials())
    with Store(postgres) as store, open_study(store) as study:
        study.run(Toy(), 6, progress=lambda *_: cut_all(postgres))
        assert essence(study.trials()) == wanted


def test_a_holder_who_lost_the_connection_is_fenced_off(postgres):
    with Store(postgres) as first, open_study(first) as before:
        before.ask()
        cut_all(postgres)
        with Store(postgres) as second:
            server._held.clear()  # as in another process: the first one's lock went with its connection
            with open_study(second), pytest.raises(StoreError, match="taken over"):
                before.tell(0, SCORE)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda u: u.replace("/db", "/no_such_db"), "no connection to the server .*does not exist"),
        (lambda u: u.partition("host=")[0] + "host=/nowhere", "no connection to the server"),
        (lambda u: "postgresql://localhost:1/db", "no connection to the server"),
        (lambda u: "postgresql://user:s3cret@localhost:x/db", "not a URL, allowed is postgresql://"),
        (lambda u: "mysql://user:s3cret@host/db", "store mysql://...: allowed are the path of a file and postgresql://"),
        (lambda u: u.replace("postgres:@", "somebody:s3cret@"), "role .*somebody.* does not exist"),
    ],
)
def test_what_is_no_server_is_refused_without_its_password(postgres, change, message):
    for read_only in (False, True):
        with pytest.raises(StoreError, match=message) as caught:
            Store(change(postgres), read_only=read_only)
        assert "s3cret" not in str(caught.value)


def test_a_database_without_a_store_is_not_made_by_reading(postgres):
    with pytest.raises(StoreError, match="no store in this database"):
        Store(postgres, read_only=True)
    with psycopg.connect(postgres) as connection:
        assert connection.execute("SELECT count(*) FROM pg_namespace WHERE nspname = 'chargetune'").fetchone() == (0,)


def test_reading_needs_no_right_to_write(postgres):
    with Store(postgres) as store, open_study(store) as study:
        study.run(Toy(), 2)
    with psycopg.connect(postgres, autocommit=True) as connection:
        name = f"reader{os.getpid()}"
        connection.execute(f"CREATE ROLE {name} LOGIN")
        connection.execute(f"GRANT USAGE ON SCHEMA chargetune TO {name}")
        connection.execute(f"GRANT SELECT ON ALL TABLES IN SCHEMA chargetune TO {name}")
        url = postgres.replace("postgres:@", f"{name}:@")
        try:
            with Store(url, read_only=True) as reader:
                assert len(reader.trials(1)) == 2
            with Store(url) as writer, pytest.raises(StoreError, match="no permission for this"):
                writer.add_study("b", {})
            with Store(url) as writer, pytest.raises(StoreError, match="no permission for this"):
                open_study(writer)
        finally:
            connection.execute(f"DROP OWNED BY {name}")
            connection.execute(f"DROP ROLE {name}")


def test_a_store_of_schema_2_gets_its_table_of_results_and_reading_adds_nothing(postgres):
    with Store(postgres) as store, open_study(store) as study:
        study.run(Toy(), 3)
        trials = study.trials()
    with psycopg.connect(postgres, autocommit=True) as connection:
        connection.execute("DROP TABLE chargetune.result")
        connection.execute("UPDATE chargetune.chargetune_store SET schema_version = 2")
    with pytest.raises(StoreError, match="schema version 2, this program knows version 3 on a server"):
        Store(postgres, read_only=True)
    with Store(postgres) as store:
        record = store.study("toy")
        assert store.trials(record.id) == trials
        assert not read_result(store, record).asked
        before = database_at(postgres).mark()
        with open_study(store) as study:
            found = study.result()
        assert read_result(store, record) == found
        assert found.asked
        assert database_at(postgres).mark() != before, "a page is told that the result changed"
    Store(postgres, read_only=True).close()


def test_the_password_is_in_no_label():
    url = "postgresql://me:s3cret@host:5433/cells"
    assert database_at(url).label == store_name(url) == "postgresql://me:***@host:5433/cells"
    assert "s3cret" not in repr(database_at(url))
    assert database_at(url).location == url
    assert store_name(Path("a") / "b.sqlite") == "b.sqlite"
