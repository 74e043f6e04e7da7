"""Check and salvage, of files and servers: nothing whole is lost, nothing damaged passes, the source stays as it is."""

import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from sqlalchemy import text
from study_toy import SPACE, Halfway, Toy, essence, open_study

from chargetune.study.store import damaged_reader
from chargetune.study.store.integrity import check_store
from chargetune.study.store.salvage import salvage
from chargetune.study.store.store import Store, StoreError
from chargetune.study.warm_start import Earlier

TRIALS = 16


@pytest.fixture(scope="module")
def template(tmp_path_factory):
    """Two studies with told, failed and running trials."""
    path = tmp_path_factory.mktemp("template") / "s.db"
    with Store(path) as store:
        for name in ("a", "b"):
            with open_study(store, name) as study:
                study.run(Toy(), TRIALS)
                study.hand_out(study.ask())
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    return path


@pytest.fixture
def filled(template, location):
    if "postgresql" in location:
        salvage(template, location)
    else:
        shutil.copy(template, location)
    return location


def change(location, statement):
    with Store(location) as store, store._engine.execution_options(writing=True).begin() as connection:
        if "postgresql" in location:
            connection.execute(text("SET LOCAL search_path TO chargetune"))
        assert connection.execute(text(statement)).rowcount == 1


def content(location):
    with Store(location, read_only=True) as store:
        return {
            r.name: (r.created_at, r.identity, r.versions, store.trials(r.id), store.earlier(r.id), traces(store, r.id))
            for r in store.studies()
        }


def traces(store, study):
    found = {t.number: store.trace(study, t.number) for t in store.trials(study)}
    return {n: None if t is None else ({k: v.tolist() for k, v in t[0].items()}, t[1]) for n, t in found.items()}


def findings(location):
    return [(f.study, f.trial, f.what) for f in check_store(location).findings]


def test_a_whole_store_is_whole_and_its_copy_equal(filled, tmp_path):
    verdict = check_store(filled)
    with_trace = sum(t.trace_sha256 is not None for c in content(filled).values() for t in c[3])
    assert (verdict.studies, verdict.trials, verdict.traces, verdict.findings) == (2, 2 * TRIALS + 2, with_trace, ())
    steps = []
    saved = salvage(filled, tmp_path / "copy.db", lambda done, total: steps.append((done, total)))
    assert (saved.studies, saved.trials, saved.traces, saved.left) == (2, 2 * TRIALS + 2, with_trace, ())
    assert steps[-1] == (with_trace, with_trace)
    assert content(tmp_path / "copy.db") == content(filled)


def test_a_copy_goes_on_as_the_store_would_have(filled, tmp_path):
    salvage(filled, tmp_path / "copy.db")
    found = []
    for path in (filled, tmp_path / "copy.db"):
        with Store(path) as store, open_study(store, "a") as study:
            study.run(Toy(), TRIALS + 5)
            found.append(essence(study.trials()))
    assert found[0] == found[1]


def test_from_a_file_to_a_server(tmp_path, postgres):
    with Store(tmp_path / "s.db") as store, open_study(store) as study:
        study.run(Toy(), 5)
    salvage(tmp_path / "s.db", postgres)
    assert content(postgres) == content(tmp_path / "s.db")
    with Store(postgres) as store, open_study(store) as study:
        study.run(Toy(), 7)
        assert len(study.trials()) == 7


# (statement, the trial it names, what the check says, whether the trial is left out of the copy)
DAMAGE = {
    "trace": ("UPDATE trace SET data = :x WHERE study_id = 1 AND number = 1", 1, "its trace is damaged", False),
    "trace gone": ("DELETE FROM trace WHERE study_id = 1 AND number = 1", 1, "its trace is missing or cannot be read", False),
    "hash": ("UPDATE trial SET trace_sha256 = 'f' WHERE study_id = 1 AND number = 1", 1, "its SHA-256 is not the stored one", False),
    "score": ("UPDATE trial SET score = '{' WHERE study_id = 1 AND number = 1", 1, "cannot be read", True),
    "theta": ("UPDATE trial SET theta = 'x' WHERE study_id = 1 AND number = 1", 1, "cannot be read", True),
    "status": ("UPDATE trial SET status = 'running' WHERE study_id = 1 AND number = 1", 1, "cannot be read", True),
    "no score": ("UPDATE trial SET score = NULL WHERE study_id = 1 AND number = 1", 1, "cannot be read", True),
    "told": ("UPDATE trial SET told_at = NULL WHERE study_id = 1 AND number = 1", 1, "these contradict each other", True),
}


@pytest.mark.parametrize("kind", DAMAGE)
def test_what_is_wrong_is_named_and_the_rest_saved(filled, tmp_path, kind):
    statement, number, what, left_out = DAMAGE[kind]
    before = content(filled)
    change(filled, statement.replace(":x", "'\\x0011'" if "postgresql" in filled else "x'0011'"))
    ((study, trial, said),) = findings(filled)  # this, and nothing else
    assert (study, trial) == ("a", number)
    assert what in said
    saved = salvage(filled, tmp_path / "new.db")
    assert [(f.study, f.trial) for f in saved.left] == [("a", number)]
    after = content(tmp_path / "new.db")
    assert after["b"] == before["b"]
    assert [t for t in after["a"][3] if t.number != number] == [t for t in before["a"][3] if t.number != number]
    assert findings(tmp_path / "new.db") == ([("a", number, "missing")] if left_out else [])
    one = [t for t in after["a"][3] if t.number == number]
    if left_out:
        assert one == []
    else:
        assert (one[0].score, one[0].trace_sha256) == (before["a"][3][number].score, None)
        assert said == one[0].provenance["trace_lost"]


def test_a_study_with_a_gap_is_read_and_begun_with_but_does_not_go_on(filled, tmp_path):
    change(filled, "UPDATE trial SET theta = 'x' WHERE study_id = 1 AND number = 3")
    salvage(filled, tmp_path / "new.db")
    assert findings(tmp_path / "new.db") == [("a", 3, "missing")]
    with Store(tmp_path / "new.db") as store:
        with open_study(store, "a") as study, pytest.raises(StoreError, match="lacks trials since it was salvaged"):
            study.ask()
        with open_study(store, "a again", earlier=[Earlier(store.location, "a")]) as study:
            assert len(study.earlier) == TRIALS - 1
            study.run(Toy(), 2)


def test_a_study_whose_description_is_lost(filled, tmp_path):
    change(filled, "UPDATE study SET identity = '{}' WHERE id = 1")
    found = findings(filled)
    assert found[0] == ("a", None, "the SHA-256 of its description is not the stored one")
    assert found[1:] == [("a", number, "its study is damaged") for number in range(TRIALS + 1)]
    saved = salvage(filled, tmp_path / "new.db")
    assert (saved.studies, saved.trials) == (1, TRIALS + 1)
    assert list(content(tmp_path / "new.db")) == ["b"]


def test_a_target_with_studies_is_refused(filled, tmp_path):
    with pytest.raises(StoreError, match="one store, allowed is a new one"):
        salvage(filled, filled)
    with Store(tmp_path / "other.db") as other:
        open_study(other, tuner=Halfway(), space=SPACE).close()
    with pytest.raises(StoreError, match="there are studies in it, allowed is a new store"):
        salvage(filled, tmp_path / "other.db")


@pytest.mark.parametrize("location", ["sqlite"], indirect=True)
class TestFile:
    """Bytes of the file itself are damaged; a server looks after its own."""

    @pytest.fixture(autouse=True)
    def stray(self, monkeypatch):
        """Rows are looked for until so many numbers in a row have none; the last row here has the number 2 TRIALS + 2."""
        monkeypatch.setattr(damaged_reader, "STRAY", 500)

    def ruin(self, path, kind):
        with closing(sqlite3.connect(path)) as connection:
            root = connection.execute("SELECT rootpage FROM sqlite_master WHERE name = 'trial'").fetchone()[0]
            index = connection.execute("SELECT rootpage FROM sqlite_master WHERE name = 'sqlite_autoindex_trial_1'").fetchone()[0]
        content = bytearray(path.read_bytes())
        size = int.from_bytes(content[16:18], "big")
        if kind == "cut":
            del content[len(content) * 3 // 5 // size * size + 100 :]
        elif kind == "index":
            content[(index - 1) * size : index * size] = bytes(size)
        elif kind == "table":
            content[(root - 1) * size : root * size] = bytes(size)
        else:
            # Leaves of trees of tables; each row lies on one of them.
            leaves = [k for k in range(2, len(content) // size) if content[k * size] == 13]
            for k in leaves[len(leaves) // 2 : len(leaves) // 2 + 3]:
                content[k * size : (k + 1) * size] = np.random.default_rng(k).bytes(size)
        path.write_bytes(content)
        return content

    @pytest.mark.parametrize("kind", ["cut", "index", "leaves"])
    def test_what_lies_on_other_pages_is_saved(self, filled, tmp_path, kind):
        path = Path(filled)
        before = content(path)
        damaged = self.ruin(path, kind)
        with pytest.raises(StoreError, match=r"damaged, nothing was changed .* `chargetune store salvage`"):
            Store(path)
        assert check_store(path).findings
        saved = salvage(path, tmp_path / "new.db")
        assert path.read_bytes() == damaged
        after = content(tmp_path / "new.db")
        assert saved.studies == 2
        assert saved.trials >= (2 * TRIALS + 2 if kind == "index" else TRIALS // 2)
        for name, (*_, trials, _, found) in after.items():
            known = {t.number: t for t in before[name][3]}
            for trial in trials:
                if "trace_lost" not in trial.provenance:
                    assert trial == known[trial.number]
                    assert found[trial.number] == before[name][5][trial.number]
                assert trial.score == known[trial.number].score
        lost = 2 * TRIALS + 2 - saved.trials
        assert (lost > 0 or any(f.trial is not None for f in saved.left)) == (kind != "index")
        assert bool(saved.left) == (kind != "index")

    def test_a_table_that_is_gone_is_named(self, filled, tmp_path):
        self.ruin(Path(filled), "table")
        saved = salvage(filled, tmp_path / "new.db")
        assert (saved.studies, saved.trials) == (2, 0)
        assert any("rows of the table trial cannot be read" in str(f) for f in saved.left)

    def test_what_is_no_store_is_refused(self, filled, tmp_path):
        content = bytearray(Path(filled).read_bytes())
        content[:16] = bytes(16)
        Path(filled).write_bytes(content)
        (tmp_path / "empty.db").touch()
        (tmp_path / "text.db").write_text("time,voltage\n" * 1000)
        with closing(sqlite3.connect(tmp_path / "other.db")) as connection:
            connection.execute("CREATE TABLE t (x)")
        for path, message in (
            (filled, "not a store"),
            (tmp_path / "none.db", "no such store"),
            (tmp_path / "empty.db", "an empty file"),
            (tmp_path / "text.db", "not a store"),
            (tmp_path / "other.db", "no store of this program"),
        ):
            for act in (check_store, lambda p: salvage(p, tmp_path / "new.db")):
                with pytest.raises(StoreError, match=message):
                    act(path)
        assert not (tmp_path / "new.db").exists()
        assert (tmp_path / "empty.db").stat().st_size == 0


def test_a_server_without_a_store(postgres, tmp_path):
    with pytest.raises(StoreError, match="no store of this program"):
        check_store(postgres)
