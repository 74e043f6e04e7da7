"""The commands as a user runs them."""

import json
import re
import sqlite3
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
from commands import chargetune

from chargetune.battery.identification.layouts import CLOCKS, SHORT_UNITS
from study_text import study_text

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "examples"


def write(folder, text, name="study.toml"):
    path = folder / name
    path.write_text(text)
    return path


QUICK = study_text(study={"name": "quick", "trials": 6}, controller={"mismatch_seed": 1})


@pytest.fixture(scope="module")
def cases(shared):
    return {case["name"]: case for case in json.loads((shared / "reference" / "p0.json").read_text())["cases"]}


@pytest.mark.parametrize(("file", "name"), [("exact", "seed0"), ("model", "seed0-model-U1"), ("backoff", "seed0-backoff")])
def test_simulate_gives_the_reference_trajectories(file, name, cases):
    out = json.loads(chargetune("simulate", EXAMPLES / f"reference_{file}.toml", "--json").stdout)
    case = cases[name]
    np.testing.assert_allclose(out["current_A"], case["current"], atol=0.010)
    np.testing.assert_allclose(out["soc"], case["soc"], atol=1e-5)
    np.testing.assert_allclose(out["voltage_start_V"], case["voltage_start"], atol=1e-3)
    np.testing.assert_allclose(out["voltage_end_V"], case["voltage_end"], atol=1e-3)
    assert abs(out["overshoot_mV"] - case["max_overshoot_mV"]) < 1.0
    assert set(out["status"]) == {0}


@pytest.mark.usefixtures("virtual_machine")
def test_every_reference_case_can_be_named_in_a_config(cases, tmp_path):
    for name, case in cases.items():
        text = "[controller]\n"
        if name != "oracle":
            text += f"mismatch_seed = {re.match('seed([0-9]+)', name)[1]}\n"
        text += f'overpotential = "{"exact" if case["U1"] == "measured" else "model"}"\n'
        text += f"[theta.backoff]\nnodes = 7\n[theta.values]\nbackoff_V = {case['backoff_V']}\n"
        assert tomllib.loads(text)
        if name in {"oracle", "seed2-backoff", "seed5-model-U1"}:
            out = json.loads(chargetune("simulate", write(tmp_path, text), "--json").stdout)
            np.testing.assert_allclose(out["current_A"], case["current"], atol=0.010)


@pytest.mark.usefixtures("virtual_machine")
def test_simulate_takes_theta_by_name_and_by_position(tmp_path):
    path = write(tmp_path, QUICK)
    named = json.loads(chargetune("simulate", path, "--theta", '{"backoff_V": [0.1, 0.1, 0.1]}', "--json").stdout)
    listed = json.loads(chargetune("simulate", path, "--theta", "0.1,0.1,0.1", "--json").stdout)
    untuned = json.loads(chargetune("simulate", path, "--json").stdout)
    assert named["current_A"] == listed["current_A"] != untuned["current_A"]
    assert named["overshoot_mV"] < untuned["overshoot_mV"]


@pytest.mark.parametrize(
    ("theta", "words"),
    [
        ("0.1,0.1", ["--theta has 2 values", "these 3", "backoff_V[2]"]),
        ("0.1,0.1,0.3", ["backoff_V[2] = 0.3", "[0, 0.2] V"]),
        ("a,b", ["--theta", "numbers"]),
        ('{"backof": 1}', ["backof", "backoff_V"]),
        ("{", ["--theta", "JSON"]),
    ],
)
def test_a_bad_theta_is_refused(theta, words, tmp_path, refused):
    message = refused("simulate", write(tmp_path, QUICK), "--theta", theta)
    assert all(word in message for word in words), message


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("[controller]", "[controler]"), ["controler is not a known key"]),
        (("steps = 60", "stepps = 60"), ["episode.stepps is not a known key"]),
        (("steps = 60", "steps = true"), ["episode.steps = true", "a whole number"]),
        (("steps = 60", 'steps = "60"'), ["episode.steps = '60'", "a whole number"]),
        (("steps = 60", "steps = 0"), ["steps = 0", "[1, 1000000]"]),
        (("trials = 6", "trials = 0"), ["study.trials = 0", "1"]),
        (("nodes = 3", "nodes = 1"), ["nodes = 1", "[2, 50]"]),
        (("upper_V = 0.2", "upper_V = -0.1"), ["upper_V", "-0.1"]),
        (("mismatch_seed = 1", "horizon = 0"), ["horizon = 0", "[1, 50]"]),
        (("mismatch_seed = 1", "horizon = 51"), ["horizon = 51", "[1, 50]"]),
        (("mismatch_seed = 1", "sampling_time_s = -1.0"), ["sampling_time_s = -1.0"]),
        (("mismatch_seed = 1", "mismatch_seed = -1"), ["mismatch_seed = -1", ">= 0"]),
        (("mismatch_seed = 1", 'overpotential = "guessed"'), ["overpotential", "guessed", "model", "exact"]),
        (("[episode]", "[limits]\nvoltage_max_V = 2.0\n[episode]"), ["voltage_max_V = 2.0", "(2.5, 4.2] V"]),
        (("[episode]", "[limits]\ncurrent_max_A = 0.0\n[episode]"), ["current_max_A = 0.0", "(0, 6] A"]),
        (("[episode]", "[limits]\ncurrent_max_A = nan\n[episode]"), ["current_max_A = nan", "(0, 6] A"]),
        (("[episode]", "[episode]\nsoc_start = 50.0"), ["soc_start = 50.0", "[0, 1]"]),
        (("[episode]", "[episode]\nsoc_start = 0.9\nsoc_target = 0.5"), ["soc_target = 0.5", "soc_start = 0.9"]),
        (("[episode]", "[episode]\nsoc_start = 1.0\nsoc_target = 1.0"), ["soc_target"]),
        (("[study]", '[cell]\nfile = "missing.toml"\n[study]'), ["missing.toml"]),
        (("[study]", "[study"), ["not valid TOML"]),
    ],
)
def test_a_bad_config_is_refused_before_anything_runs(change, words, tmp_path, refused):
    message = refused("tune", write(tmp_path, QUICK.replace(*change)), "--store", tmp_path / "s.sqlite")
    assert all(word in message for word in words), message
    assert not (tmp_path / "s.sqlite").exists()


@pytest.mark.usefixtures("virtual_machine")
def test_a_config_with_a_byte_order_mark_is_read(tmp_path):
    path = tmp_path / "bom.toml"
    path.write_bytes(b"\xef\xbb\xbf" + QUICK.encode())
    assert json.loads(chargetune("simulate", path, "--json").stdout)["ending"] == "done"


def test_a_missing_file_and_a_missing_theta_are_refused(tmp_path):
    assert "nowhere.toml" in chargetune("tune", tmp_path / "nowhere.toml", code=2).stderr
    empty = write(tmp_path, "[study]\nname = 'x'\n")
    assert "theta is empty" in chargetune("tune", empty, code=2, cwd=tmp_path).stderr


def test_tune_resumes_shows_and_draws(tmp_path):
    path = write(tmp_path, QUICK)
    first = json.loads(chargetune("tune", path, "--trials", 4, "--out", tmp_path / "out", "--json").stdout)
    assert first["trials"] == 4
    done = chargetune("tune", path, "--out", tmp_path / "out")
    assert "6 trials" in done.stdout
    assert "resumed: 4 trials" in done.stderr
    (store,) = (tmp_path / "out").glob("*.sqlite")
    again = json.loads(chargetune("tune", path, "--store", store, "--json").stdout)
    whole = json.loads(chargetune("tune", path, "--store", tmp_path / "whole.sqlite", "--json").stdout)
    assert again == whole
    assert whole["tuned"]["feasible"]
    assert {p.suffix for p in (tmp_path / "out").iterdir()} >= {".png", ".json", ".sqlite"}

    shown = json.loads(chargetune("show", tmp_path / "whole.sqlite", "--json").stdout)["studies"]
    assert [(s["name"], s["done"]) for s in shown] == [("quick", 6)]
    trials = json.loads(chargetune("show", tmp_path / "whole.sqlite", "--study", "quick", "--json").stdout)["trials"]
    assert [t["number"] for t in trials] == list(range(6))
    assert trials[whole["tuned"]["trial"]]["objective"] == max(t["objective"] for t in trials if t["feasible"])
    assert "quick" in chargetune("show", tmp_path / "whole.sqlite").stdout
    assert "other" in chargetune("show", tmp_path / "whole.sqlite", "--study", "other", code=2).stderr


@pytest.mark.usefixtures("virtual_machine")
def test_another_seed_or_a_changed_config_does_not_resume_silently(tmp_path):
    path, store = write(tmp_path, QUICK), tmp_path / "s.sqlite"
    chargetune("tune", path, "--trials", 2, "--store", store)
    assert "seed" in chargetune("tune", path, "--trials", 2, "--seed", 5, "--store", store, code=2).stderr
    changed = write(tmp_path, QUICK.replace("steps = 60", "steps = 50"), "changed.toml")
    assert "steps" in chargetune("tune", changed, "--trials", 2, "--store", store, code=2).stderr


def test_workers_do_not_change_the_trials(tmp_path):
    text = QUICK.replace("trials = 6", "trials = 6\nbatch = 3")
    path = write(tmp_path, text)
    alone = json.loads(chargetune("tune", path, "--store", tmp_path / "1.sqlite", "--json").stdout)
    two = json.loads(chargetune("tune", path, "--store", tmp_path / "2.sqlite", "--workers", 2, "--json").stdout)
    assert alone == two


def test_a_file_that_is_no_store_is_refused_and_left_alone(tmp_path):
    path = tmp_path / "notes.txt"
    path.write_text("not a database, but somebody's notes " * 100)
    before = path.read_bytes()
    assert "notes.txt" in chargetune("show", path, code=2).stderr
    assert "notes.txt" in chargetune("tune", write(tmp_path, QUICK), "--store", path, code=2).stderr
    assert path.read_bytes() == before


def test_reproduce_writes_claims_rows_and_figures(tmp_path):
    # The start of a worker takes longer than its studies.
    for case, workers in (("backoff", 2), ("model", 1)):
        done = chargetune("reproduce", case, "--seeds", "1:3", "--trials", 3, "--tuner", "sobol", "--workers", workers, "--out", tmp_path)
        assert "2 seeds" in done.stdout or "of 2 seeds" in done.stdout
    result = json.loads((tmp_path / "claims.json").read_text())
    assert [c["id"] for c in result["claims"]] == list(range(1, 13))
    assert all(c["of"] == 2 and 0 <= c["holds"] <= 2 for c in result["claims"])
    assert result["claims"][0]["holds"] == 2
    assert result["claims"][4]["holds"] == 2
    rows = result["per_seed"]
    assert [r["seed"] for r in rows] == [1, 2]
    assert abs(rows[0]["untuned"]["overshoot_mV"] - 62.5) < 1
    assert {"untuned", "tuned", "violating_trials", "worst_excess_mV"} <= set(rows[0])
    assert len(list(tmp_path.rglob("*.png"))) >= 4


def test_reproduce_of_a_learnt_stage_cost(tmp_path):
    done = chargetune("reproduce", "rbf", "--seeds", "1", "--trials", 1, "--workers", 1, "--out", tmp_path)
    assert "cautious cost" in done.stdout
    result = json.loads((tmp_path / "claims.json").read_text())
    (row,) = result["per_seed"]
    assert abs(row["untuned"]["overshoot_mV"] - 62.5) < 1
    assert row["safe_twin"]["overshoot_mV"] < 0
    assert [way["name"] for way in result["summary"]["ways"]][1:3] == ["offset-free", "cautious cost"]


@pytest.mark.parametrize("seeds", ["3:3", "a:b", "-1:2", "1,1"])
def test_bad_seeds_are_refused(seeds, tmp_path, refused):
    assert "--seeds" in refused("reproduce", "model", f"--seeds={seeds}", "--out", tmp_path / "o")


def test_help_lists_every_unit_that_is_accepted():
    said = " ".join(chargetune("identify", "--help").stdout.split())
    assert f"--time-unit <str> {', '.join((*SHORT_UNITS['time'], *CLOCKS))}." in said
    assert f"--current-unit <str> {', '.join(SHORT_UNITS['current'])}." in said


def test_help_is_light():
    heavy = "{'casadi', 'torch', 'numpy', 'matplotlib', 'pydantic'}"
    code = f"import sys; import chargetune.cli; print(sorted({{m.split('.')[0] for m in sys.modules}} & {heavy}))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
    for command in ((), ("tune",), ("simulate",), ("show",), ("reproduce",)):
        assert "--help" in chargetune(*command, "--help").stdout


def test_a_store_survives_being_read_while_written(tmp_path):
    path, store = write(tmp_path, QUICK), tmp_path / "s.sqlite"
    chargetune("tune", path, "--store", store)
    with sqlite3.connect(store) as connection:
        assert connection.execute("pragma integrity_check").fetchone() == ("ok",)
    assert store.stat().st_size > 0
