"""kill -9 during `tune` at random moments: the same command again ends as if nothing had happened."""

import json
import random
import time
from multiprocessing import get_context

from commands import chargetune, run, told

from study_text import study_text

KILLS = 20
# Of this process, which has imported everything: twenty starts of Python would take most of the time.
FORK = get_context("fork")
CONFIG = study_text(study={"name": "killed", "trials": 60}, controller={"mismatch_seed": 2}, episode={"steps": 120})


def command(config, store):
    return "tune", config, "--store", store, "--json"


def trials(store):
    return json.loads(chargetune("show", store, "--study", "killed", "--json").stdout)["trials"]


def test_twenty_kills_change_nothing(tmp_path):
    config, store = tmp_path / "killed.toml", tmp_path / "killed.sqlite"
    config.write_text(CONFIG)
    whole = chargetune(*command(config, tmp_path / "whole.sqlite"))
    rng = random.Random(0)  # noqa: S311 - moments of a test, no secret
    kills = 0
    while kills < KILLS:
        before = told(store)
        process = FORK.Process(target=run, args=command(config, store))
        process.start()
        if kills % 2:
            # While trials are written, however long starting took.
            while process.is_alive() and told(store) == before:
                time.sleep(0.01)
            time.sleep(rng.uniform(0.0, 0.1))
        else:
            # While it starts, so that some kills meet the first writes.
            time.sleep(rng.uniform(0.0, 0.4))
        if not process.is_alive():
            # It came to its end: go on with a fresh study.
            for file in tmp_path.glob("killed.sqlite*"):
                file.unlink()
            continue
        process.kill()
        process.join()
        kills += 1
    again = chargetune(*command(config, store))
    assert json.loads(again.stdout) == json.loads(whole.stdout)
    assert trials(store) == trials(tmp_path / "whole.sqlite")
