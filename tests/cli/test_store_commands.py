"""chargetune store check, salvage, export, migrate."""

import json
import shutil
import sqlite3
import sys
from contextlib import closing
from pathlib import Path

import pytest
from commands import tuned

from chargetune.cli import main
from chargetune.study.store.salvage import salvage
from study_text import study_text

pytestmark = pytest.mark.usefixtures("virtual_machine")

QUICK = study_text(study={"name": "red quick", "trials": 4})
OLD = Path(__file__).parents[1] / "study" / "store" / "data" / "schema-1.db"


@pytest.fixture
def run(monkeypatch, capsys):
    """Run a command in this process; its exit code, stdout and stderr."""

    def command(*arguments):
        monkeypatch.setattr(sys, "argv", ["chargetune", *map(str, arguments)])
        code = 0
        try:
            main()
        except SystemExit as ended:
            code = ended.code or 0
        caught = capsys.readouterr()
        return code, caught.out, caught.err

    return command


@pytest.fixture(scope="module")
def studied(tmp_path_factory):
    return tuned(tmp_path_factory.mktemp("studied"), QUICK)


@pytest.fixture
def store(tmp_path, studied):
    path = tmp_path / "s.db"
    path.write_bytes(studied)
    return path


@pytest.fixture
def damaged(store):
    with closing(sqlite3.connect(store)) as connection:
        connection.execute("UPDATE trace SET data = x'00' WHERE number = 2")
        connection.commit()
    return store


def test_check(store, run):
    code, out, _ = run("store", "check", store)
    assert code == 0
    assert "1 study, 4 trials, 4 traces are whole; nothing wrong" in out
    code, out, _ = run("store", "check", store, "--json")
    assert code == 0
    assert json.loads(out) == {"store": str(store), "studies": 1, "trials": 4, "traces": 4, "findings": []}


def test_check_of_a_server(store, run, postgres):
    salvage(store, postgres)
    code, out, _ = run("store", "check", postgres, "--json")
    assert code == 0
    assert json.loads(out)["traces"] == 4
    code, out, _ = run("store", "export", postgres, "--out", store.parent / "out", "--json")
    assert code == 0
    assert len(json.loads(out)["files"]) == 6


def test_check_of_a_damaged_store_ends_with_1(damaged, run):
    code, out, _ = run("store", "check", damaged)
    assert code == 1
    assert "study 'red quick', trial 2: its trace is damaged" in out
    assert "4 trials, 3 traces are whole; 1 finding" in out
    assert "store salvage" in out
    code, out, _ = run("store", "check", damaged, "--json")
    assert code == 1
    (finding,) = json.loads(out)["findings"]
    assert (finding["study"], finding["trial"]) == ("red quick", 2)


def test_salvage(damaged, run, tmp_path):
    code, out, _ = run("store", "salvage", damaged, tmp_path / "new.db")
    assert code == 0
    assert "left: study 'red quick', trial 2: its trace is damaged" in out
    assert "1 study, 4 trials, 3 traces saved; 1 finding" in out
    assert run("store", "check", tmp_path / "new.db")[0] == 0
    assert run("store", "check", damaged)[0] == 1
    code, _, err = run("store", "salvage", damaged, tmp_path / "new.db")
    assert code == 2
    assert "there are studies in it, allowed is a new store" in err
    code, out, _ = run("store", "salvage", damaged, tmp_path / "other.db", "--json")
    assert (code, json.loads(out)["traces"], len(json.loads(out)["left"])) == (0, 3, 1)


def test_export(damaged, run, tmp_path):
    code, out, _ = run("store", "export", damaged, "--out", tmp_path / "out", "--format", "csv")
    assert code == 0
    assert "left: study 'red quick', trial 2" in out
    assert f"5 files in {tmp_path / 'out'}" in out
    assert (tmp_path / "out/red quick/trial-0003.bdf.csv").exists()
    code, _, err = run("store", "export", damaged, "--out", tmp_path / "out", "--study", "none")
    assert code == 2
    assert "no study 'none'; there are: red quick" in err


def test_export_without_pyarrow(store, run, tmp_path, monkeypatch):
    import chargetune.battery.studies.bdf_export as module

    monkeypatch.setattr(module, "find_spec", lambda name: None)
    code, _, err = run("store", "export", store, "--out", tmp_path / "out")
    assert code == 2
    assert "export as parquet needs pandas and pyarrow: pip install 'chargetune[export]'" in err


def test_migrate(run, tmp_path):
    shutil.copy(OLD, tmp_path / "old.db")
    code, _, err = run("store", "check", tmp_path / "old.db")
    assert code == 2
    assert "schema version 1, allowed is 3; `chargetune store migrate`" in err
    code, out, _ = run("store", "migrate", tmp_path / "old.db")
    assert code == 0
    assert "has this program's schema" in out
    assert (tmp_path / "old.db.schema-1").exists()


@pytest.mark.parametrize("command", ["check", "salvage", "export"])
def test_no_store(run, tmp_path, command):
    more = {"salvage": [tmp_path / "new.db"], "export": ["--out", tmp_path / "out"]}.get(command, [])
    code, _, err = run("store", command, tmp_path / "none.db", *more)
    assert code == 2
    assert f"{tmp_path / 'none.db'}: no such store" in err
    assert list(tmp_path.iterdir()) == []
