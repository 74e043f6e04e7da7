"""``chargetune campaign`` as a user runs it."""

import json
import tomllib
from pathlib import Path

import pytest
from commands import chargetune

from chargetune.battery.studies.campaign import load_campaign
from study_text import study_text

pytestmark = pytest.mark.usefixtures("virtual_machine")

EXAMPLES = Path(__file__).parents[2] / "examples"
STUDY = study_text(study={"trials": 3}, controller={"mismatch_seed": 1})


def test_table_resume_and_json(tmp_path):
    (tmp_path / "one.toml").write_text(STUDY)
    (tmp_path / "two.toml").write_text(STUDY.replace("60", "120"))
    path = tmp_path / "all.toml"
    path.write_text('[campaign]\nconfigs = ["one.toml", "two.toml"]\nseeds = "0:2"\n')
    store = tmp_path / "s.sqlite"
    table = chargetune("campaign", path, "--store", store).stdout
    assert [line.split()[:5] for line in table.splitlines() if " seed " in line] == [
        [name, "seed", seed, "done", "3/3"] for name in ("one", "two") for seed in ("0", "1")
    ]
    assert "of 2" in table

    path.write_text(path.read_text() + "trials = 5\n")
    answer = json.loads(chargetune("campaign", path, "--store", store, "--workers", 1, "--json").stdout)
    assert [(s["study"], s["config"], s["seed"], s["state"], s["trials"]) for s in answer["studies"]] == [
        (f"{name} seed {seed}", f"{name}.toml", seed, "done", 5) for name in ("one", "two") for seed in (0, 1)
    ]
    listed = json.loads(chargetune("show", store, "--json").stdout)["studies"]
    assert sorted(s["name"] for s in listed) == sorted(s["study"] for s in answer["studies"])
    best = {s["name"]: s["best"] and s["best"]["number"] for s in listed}
    assert all(s["best"]["trial"] == best[s["study"]] for s in answer["studies"] if s["best"]["feasible"])

    (tmp_path / "one.toml").write_text(STUDY.replace("60", "50"))
    stopped = chargetune("campaign", path, "--store", store, "--workers", 1, code=1).stdout
    assert "one seed 0 stopped: StudyError: study 'one seed 0' was begun with something else" in " ".join(stopped.split())


def test_what_is_wrong_is_said_before_anything_is_stored(tmp_path):
    (tmp_path / "one.toml").write_text(STUDY)
    path = tmp_path / "all.toml"
    path.write_text('[campaign]\nconfigs = ["one.toml"]\nseeds = "3"\n')
    message = chargetune("campaign", path, "--store", tmp_path / "s.sqlite", code=2).stderr
    assert "all.toml: campaign.seeds = '3': allowed are different whole numbers >= 0" in message
    (tmp_path / "one.toml").write_text(STUDY + "[limits]\nvoltage_max_V = 3.0\n")
    path.write_text('[campaign]\nconfigs = ["one.toml"]\n')
    chargetune("campaign", path, "--store", tmp_path / "s.sqlite", code=2)
    assert not (tmp_path / "s.sqlite").exists()


def test_the_example_is_a_campaign():
    entries = load_campaign(EXAMPLES / "campaign.toml")
    names = tomllib.loads((EXAMPLES / "campaign.toml").read_text())["campaign"]["configs"]
    assert [e.source for e in entries] == [name for name in names for _ in range(3)]
