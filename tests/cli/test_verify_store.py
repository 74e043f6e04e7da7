"""verify on a store: each trial again from its theta and seed, also those that an earlier program wrote."""

import json
import shutil
import sqlite3
from pathlib import Path

import pytest
from commands import chargetune

from chargetune.battery.studies.open_study import open_study
from chargetune.battery.studies.study_file import load_config
from chargetune.study.store.store import Store
from chargetune.study.study import Study
from study_text import study_text

# Written by the released program, schema 2: three trials for each of its tuners.
RELEASED = Path(__file__).parents[1] / "study" / "store" / "data" / "schema-2-studies.db"


@pytest.fixture(scope="module")
def released(tmp_path_factory):
    path = tmp_path_factory.mktemp("released") / "old.db"
    shutil.copy(RELEASED, path)
    chargetune("store", "migrate", path)
    return path


def test_what_the_released_program_stored_comes_again(released):
    told = json.loads(chargetune("verify", released, "--json").stdout)
    assert told == {"file": str(released), "verified": True, "differences": []}


def test_a_trial_of_one_study(released):
    assert "1 trial evaluated again" in chargetune("verify", released, "--study", "safe", "--trial", 1).stdout
    said = chargetune("verify", released, "--trial", 1, code=2).stderr
    assert "--trial 1: 7 studies of" in said
    assert "allowed is one; --study names it" in said


def test_options_of_a_store_are_refused_with_a_certificate(tmp_path):
    path = tmp_path / "c.json"
    path.write_text("{}")
    assert "--trial = 1 is given with a certificate, allowed is it with a store" in chargetune("verify", path, "--trial", 1, code=2).stderr


def test_nothing_on_hardware_is_evaluated_again(tmp_path):
    path = tmp_path / "s.toml"
    path.write_text(study_text(study={"name": "bench"}))
    config = load_config(path)
    with Store(tmp_path / "s.db") as store, open_study(store, config, tmp_path) as study:
        identity = study.record.identity
    with (
        Store(tmp_path / "h.db") as store,
        Study.create_or_resume(
            store, "bench", config=identity["config"], space=study.space, tuner=study.tuner, seed=0, hardware=True
        ) as bench,
    ):
        bench.ask()
    assert "study 'bench' is on hardware, allowed is one whose plant is simulated" in chargetune("verify", tmp_path / "h.db", code=2).stderr


def test_another_program_would_be_named(released, tmp_path):
    """The same loops with one of its trials at another theta."""
    path = tmp_path / "moved.db"
    shutil.copy(released, path)
    with Store(path, read_only=True) as store:
        record = store.studies()[0]
        theta = store.trials(record.id)[1].theta
    with sqlite3.connect(path) as connection:
        moved = json.dumps([1.001 * value for value in theta])
        connection.execute("update trial set theta = ? where study_id = ? and number = 1", (moved, record.id))
    done = chargetune("verify", path, "--study", record.name, "--json", code=1)
    names = {one["name"] for one in json.loads(done.stdout)["differences"]}
    assert f"study {record.name!r}, trial 1: input" in names
    assert f"study {record.name!r}, trial 1: objective" in names
    assert all("trial 1: " in name for name in names)


def test_a_password_is_not_printed(postgres):
    """The same store on a server, by a URL with a password."""
    location = postgres.replace("postgres:@", "postgres:secret@")
    assert "secret" in location
    with Store(location):
        pass
    for options in ((), ("--json",)):
        done = chargetune("verify", location, *options)
        assert "secret" not in done.stdout + done.stderr
