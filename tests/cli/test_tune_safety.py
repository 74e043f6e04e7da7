"""`chargetune tune` with a table [safety]."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from commands import run

from chargetune.battery.cell.cell import default_cell
from chargetune.battery.charging.evaluate import evaluate
from chargetune.battery.charging.range_settings import ChargingRangeSettings
from chargetune.battery.charging.tunables import ResistanceRatio
from chargetune.battery.studies.open_study import make_tuner
from chargetune.battery.studies.study_file import load_config
from chargetune.cli.tune import _closing
from chargetune.study.result import Reason, StudyResult
from chargetune.study.trial import Trial, TrialStatus
from charging_problems import charging_problem

STUDY = """
[study]
name = "safe"
tuner = "{tuner}"
trials = 2
[controller]
mismatch_seed = 1
[episode]
steps = 120
soc_start = 0.4
[sensors]
voltage_noise_sd_V = 0.002
[objective]
verdict_samples = 5
[theta.R0]
scale = true
lower = 0.1
upper = 4.0
[safety]
{safety}
"""


def tune(folder, safety, tuner="twin", *options):
    study = folder / "study.toml"
    study.write_text(STUDY.format(tuner=tuner, safety=safety))
    return run("tune", study, "--store", folder / "s.sqlite", *options, cwd=folder)


def test_a_safe_study_says_what_it_promised_and_spent(tmp_path):
    done = tune(tmp_path, "budget_mVs = 100.0", "twin", "--json")
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["violating"] == 0
    assert found["tuned"]["trial"] == 1
    assert found["safety"] == {"probability": 0.95, "violation_mVs": 0.0, "budget_mVs": 100.0, "ended_at_a_limit": 0, "stopped": None}


def test_an_unsafe_start_is_found_before_the_first_charge(tmp_path):
    done = tune(tmp_path, "start = { R0_scale = 0.5 }")
    assert done.returncode == 2
    assert "unsafe-start" in done.stderr
    assert not (tmp_path / "s.sqlite").exists()


def test_a_trial_ended_at_the_limit_spends_the_budget_and_stops_the_study(tmp_path):
    done = tune(tmp_path, "start = { R0_scale = 0.5 }\nbudget_mVs = 1.0\nabort_margin_V = 0.03", "twin", "--force", "--json")
    assert done.returncode == 2
    assert "the budget of violation is spent" in done.stderr
    found = json.loads(done.stdout)
    assert found["trials"] == 1
    assert found["safety"]["ended_at_a_limit"] == 1
    assert found["safety"]["violation_mVs"] > 1.0


@pytest.mark.parametrize(
    ("safety", "tuner", "said"),
    [
        ("probability = 0.95", "default", "allowed is tuner = 'twin'"),
        ("probability = 1.5", "twin", "probability = 1.5"),
        ("budget_mVs = -1.0", "twin", "budget_mVs = -1.0"),
        ("abort_margin_V = 0.0", "twin", "abort_margin_V = 0"),
        ("start = { R0_rat = 2.0 }", "twin", "R0_rat"),
    ],
)
def test_nonsense_is_refused_by_name(tmp_path, safety, tuner, said):
    done = tune(tmp_path, safety, tuner)
    assert done.returncode == 2
    assert said in done.stderr


def test_what_is_unknown_of_the_plant_is_told_to_the_twin(tmp_path):
    study = tmp_path / "unknown.toml"
    example = (Path(__file__).parents[2] / "examples" / "safe_charge.toml").read_text()
    study.write_text(example + "\n[twin]\ncapacity_spread = 0.03\nsoc_spread = 0.01\nocv_spread_V = 0.003\n")
    config = load_config(study)
    problem = config.problem(tmp_path)
    tuner = make_tuner("twin", 0, problem, config.twin)
    assert [(one.name, one.sd) for one in tuner.loop.twin.unknowns[3:]] == [("capacity_Ah", 0.03), ("soc", 0.01), ("voltage_V", 0.003)]
    assert config.document(tmp_path)["twin"]["soc_spread"] == 0.01
    with pytest.raises(ValueError, match=r"\[twin\] is given with tuner = 'sobol'"):
        make_tuner("sobol", 0, replace(problem, safety=None), config.twin)
    study.write_text(study.read_text().replace("soc_spread = 0.01", "soc_spread = -0.01"))
    with pytest.raises(ValueError, match=r"twin.soc_spread = -0\.01"):
        load_config(study)


def test_a_limit_that_the_twin_cannot_predict_is_not_promised(tmp_path):
    study = tmp_path / "plated.toml"
    example = Path(__file__).parents[2] / "examples"
    text = (example / "dfn_fast_charge.toml").read_text().replace('tuner = "range"', 'tuner = "twin"')
    study.write_text(text.replace('"okane2022.toml"', f'"{example / "okane2022.toml"}"') + "\n[safety]\nprobability = 0.9\n")
    config = load_config(study)
    problem = config.problem(tmp_path)
    with pytest.raises(ValueError, match=r"anode_min_V, which the cell's circuit does not predict"):
        make_tuner(config.study.tuner, 0, problem)


def test_tune_says_which_trial_is_the_result_and_why(capsys):
    problem = charging_problem(default_cell(), mismatch_seed=1, R0=ResistanceRatio(0.1, 4.0))
    thetas = [np.full(9, 2.5), np.full(9, 3.0)]
    trials = [Trial(k, tuple(theta), status=TrialStatus.DONE, score=evaluate(problem, theta, k)[0]) for k, theta in enumerate(thetas)]
    _closing(problem, trials, StudyResult(trials[1], Reason.BELIEVED))
    said = " ".join(capsys.readouterr().out.split())
    assert "the result is trial 1: the tuner believes it best from all traces" in said
    assert "theta of trial 1:" in said
    assert said.endswith("a table [range] in the study file tunes it for all of them")
    _closing(replace(problem, range=ChargingRangeSettings(resistance=0.1)), trials, StudyResult(trials[0], Reason.MEASURED))
    said = " ".join(capsys.readouterr().out.split())
    assert "the result is trial 0: it is the best that was measured" in said
    assert "this theta holds for the cell and the start" not in said


@pytest.mark.parametrize(("upper", "code"), [(1.2, 1), (4.0, 0)])
def test_check_says_what_stops_the_first_trial(tmp_path, upper, code):
    """With resistances of at most 1.2 times what is believed no corner of theta keeps the limits on plants of the prior."""
    path = tmp_path / "study.toml"
    path.write_text(STUDY.format(tuner="twin", safety="").replace("upper = 4.0", f"upper = {upper}"))
    checked = run("check", path, "--json")
    found = [f["code"] for f in json.loads(checked.stdout)["findings"] if f["severity"] == "error"]
    assert (checked.returncode, found) == (code, ["no-safe-start"] * code)
    assert ("no corner of theta keeps every limit" in checked.stdout) == bool(code)
