"""A study of the tuner "range" as a user runs it: tune, show, report, web, certify."""

import json
import re
import shutil
import sqlite3
from pathlib import Path

import pytest
from commands import chargetune
from starlette.testclient import TestClient

from chargetune.report.figures.study_figures import figures_of
from chargetune.report.page.trial_rows import study_head, trial_rows
from chargetune.report.study_view import read_study
from chargetune.verify import verify
from chargetune.web.app import make_app
from study_text import study_text

EXAMPLES = Path(__file__).parents[2] / "examples"
RANGE = {"soc_start": [0.3, 0.5], "resistance": 0.1, "growth": 0.2, "draws": 12}
TABLES = {
    "study": {"name": "use", "tuner": "range", "trials": 2},
    "controller": {"mismatch_seed": 1, "horizon": 3, "sampling_time_s": 20.0},
    "episode": {"steps": 75, "soc_start": 0.4},
    "sensors": {"voltage_noise_sd_V": 0.0005},
    "theta.backoff": {"nodes": 2, "lower_V": 0.0, "upper_V": 0.2},
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A study of two thetas on twelve drawn plants each."""
    path = tmp_path_factory.mktemp("range")
    (path / "use.toml").write_text(study_text(**TABLES, range=RANGE))
    (path / "tune.txt").write_text(chargetune("tune", path / "use.toml", "--store", path / "use.sqlite").stdout)
    return path


@pytest.fixture(scope="module")
def trials(folder):
    return json.loads(chargetune("show", folder / "use.sqlite", "--study", "use", "--json").stdout)["trials"]


def count(trial):
    metrics = trial["metrics"]
    return f"{metrics['violating_plants']:.0f} of {metrics['plants']:.0f}"


def test_a_trial_is_a_theta_on_the_drawn_plants(folder, trials):
    assert [t["metrics"]["plants"] for t in trials] == [12, 12]
    for trial in trials:
        over = trial["metrics"]["violating_plants"]
        assert (over == 0) == trial["feasible"]
        assert (max(trial["excess"].values()) > 0.0005) == (over > 0)
        assert max(trial["theta"]) > 0.0
    text = (folder / "tune.txt").read_text()
    assert "drawn plants over a limit" in text


def test_show_says_on_how_many_plants_a_limit_was_broken(folder, trials):
    text = chargetune("show", folder / "use.sqlite", "--study", "use").stdout
    assert "plants" in text
    assert "…" not in text
    assert re.findall(r"_V\[\d\]", text) == ["_V[0]", "_V[1]"]
    for trial in trials:
        assert count(trial) in re.sub(r"\s+", " ", text)


def test_the_report_speaks_of_the_range_and_evaluates_what_a_trial_is(folder, trials):
    page = folder / "use.html"
    chargetune("report", folder / "use.sqlite", "-o", page)
    text = re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", page.read_text()))
    assert "soc_start 0.3 to 0.5, resistance +-0.1, growth 0.2" in text
    assert "SOC of the range of use to" in text
    result = next(t for t in trials if f"trial {t['number']}" in text.partition("Why this one")[0])
    assert f"({count(result)} drawn plants over a limit)" in text
    assert "each trace is that of one drawn plant" in text
    assert "every stored excess is what its trace says" not in text
    # What no charge reached has no row, and the worst plant's objective is told as the mean of all of them is.
    merit = page.read_text().partition("figure of merit")[2].partition("</table>")[0]
    assert "time to 99 % SOC" not in merit
    rows = [re.findall(r"<td[^>]*>(.*?)</td>", row) for row in merit.split("</tr>")[1:-1]]
    assert rows
    assert all({*row[1:-1]} != {"-"} for row in rows)
    worst = next(row for row in rows if row[0] == "mean (z_d - z)^2, worst plant")
    assert float(worst[1]) == pytest.approx(-trials[0]["metrics"]["objective_worst"], rel=1e-4)
    # On drawn plants an evaluation takes seconds: entries are put back, not moved.
    assert "Finite differences" not in text
    assert "untuned, offset_free" in text
    # The same theta on the same draws is worth the same: a single charge of the nominal cell would not be.
    again = re.search(r"evaluated again now, largest difference ([\d.e+-]+)", text)
    assert float(again.group(1)) < 1e-9
    view = read_study(folder / "use.sqlite", "use")
    assert "trace that of the plant with the largest excess" in view.remark
    assert set(figures_of(view)) == {"trajectories", "backoff", "convergence"}


def test_the_live_pages_show_the_study(folder):
    client = TestClient(make_app(folder / "use.sqlite"), base_url="http://127.0.0.1")
    for path in ("/", "/studies/1"):
        assert client.get(path).status_code == 200
    drawing = client.get("/studies/1/trials/0").json()
    assert {panel["key"] for panel in drawing["panels"]} >= {"soc", "voltage_V", "current_A"}
    assert trial_rows(view := read_study(folder / "use.sqlite", "use"), view.trials)[0]["metrics"]["plants"] == 12
    assert "trace that of the plant with the largest excess" in study_head(view)["remark"]


def test_the_certificate_is_of_the_range_that_theta_was_tuned_for(folder):
    path = folder / "c.json"
    chargetune("certify", folder / "use.sqlite", "--episodes", 20, "--trial", 0, "-o", path)
    told = json.loads(path.read_text())
    assert told["origin"]["range"] == "the study's [range]"
    given = {name: value for name, value in told["range"].items() if value}
    assert given == {name: value for name, value in RANGE.items() if name != "draws"}
    assert verify(path) == []
    text = chargetune("certify", folder / "use.sqlite", "--episodes", 20, "--trial", 0, "--growth", 0, "-o", folder / "d.json").stdout
    assert "range of use (the study's [range], with other growth): soc_start 0.3 to 0.5, resistance +-0.1" in re.sub(r"\s+", " ", text)
    assert json.loads((folder / "d.json").read_text())["range"]["growth"] == 0


def test_a_range_that_cannot_be_tuned_is_refused(tmp_path, refused):
    path = tmp_path / "s.toml"
    path.write_text(study_text(**TABLES))
    assert "tuner = 'range' is given without a table [range]" in refused("tune", path, "--store", tmp_path / "s.sqlite")


def test_a_range_of_an_electrochemical_plant(tmp_path):
    # A single particle at its voltage limit, which the sensor reads up to 4 mV too low: so far theta has to stay away.
    tables = {
        "study": {"name": "own", "tuner": "range", "trials": 1},
        "cell": {"file": str(EXAMPLES / "okane2022.toml")},
        "controller": {"horizon": 2, "sampling_time_s": 60.0},
        "plant": {"model": "SPM"},
        "estimator": {"kind": "offset_free"},
        "estimator.offset_free": {"soc": "measured", "backoff_sd": 0.0},
        "limits": {"current_max_A": 10.0, "tolerance_V": 0.0001},
        "episode": {"steps": 5, "soc_start": 0.75},
        "theta.backoff": {"nodes": 2, "lower_V": 0.0, "upper_V": 0.02},
        "range": {"voltage_bias_V": 0.004, "draws": 3},
    }
    (tmp_path / "s.toml").write_text(study_text(**tables))
    told = json.loads(chargetune("tune", tmp_path / "s.toml", "--store", tmp_path / "s.sqlite", "--workers", 2, "--json").stdout)
    assert told["tuned"]["metrics"]["plants"] == 3
    assert told["tuned"]["feasible"]
    assert max(told["theta"].values()) > 0.0035
    assert json.loads(chargetune("verify", tmp_path / "s.sqlite", "--json").stdout)["verified"]


def test_compare_charges_the_same_drawn_plants_in_every_way(folder, trials):
    done = chargetune("compare", folder / "use.toml", "--store", folder / "use.sqlite", "--draws", 4, "--workers", 1, "--json")
    told = json.loads(done.stdout)
    rows = {row["name"]: row for row in told["rows"]}
    wanted = ["CC-CV that keeps all limits", "multi-step CC that keeps all limits", "nominal MPC", "nominal offset-free MPC"]
    wanted.append("best constant backoff")
    assert list(rows) == [*wanted, "tuned", "MPC that knows each plant", "plant oracle"]
    assert rows["nominal offset-free MPC"]["worst_excess"]["voltage_max_V"] < rows["nominal MPC"]["worst_excess"]["voltage_max_V"]
    assert {row["draws"] for row in rows.values()} == {told["draws"]} == {4}
    assert (rows["plant oracle"]["violations"], rows["plant oracle"]["ratio"]) == (0, 1.0)
    assert told["range"]["soc_start"] == [0.3, 0.5]
    assert told["result"]["trial"] in {t["number"] for t in trials}
    text = chargetune("compare", folder / "use.toml", "--draws", 2, "--workers", 1).stdout
    assert "The same 2 drawn plants in every row" in re.sub(r"\s+", " ", text)
    assert "of 2" in text


def test_a_campaign_tunes_it_as_tune_does(folder, trials):
    (folder / "campaign.toml").write_text('[campaign]\nconfigs = ["use.toml"]\nseeds = [0]\ntrials = 1\n')
    chargetune("campaign", folder / "campaign.toml", "--store", folder / "campaign.sqlite", "--workers", 1)
    name = json.loads(chargetune("show", folder / "campaign.sqlite", "--json").stdout)["studies"][0]["name"]
    (again,) = json.loads(chargetune("show", folder / "campaign.sqlite", "--study", name, "--json").stdout)["trials"]
    assert again["theta"] == trials[0]["theta"]
    assert again["metrics"] == trials[0]["metrics"]


def test_compare_refuses_what_has_no_meaning_over_a_range(folder, tmp_path, refused):
    assert "--figure is given for a study with a table [range]" in refused("compare", folder / "use.toml", "--figure", tmp_path / "a.pdf")
    plain = tmp_path / "s.toml"
    plain.write_text(study_text())
    assert "--draws 3: allowed only for a study with a table [range]" in refused("compare", plain, "--draws", 3)


def test_verify_evaluates_each_drawn_plant_again(folder, tmp_path, chargetune_here):
    assert "2 trials evaluated again: every figure is what theta and seed give" in chargetune("verify", folder / "use.sqlite").stdout
    told = json.loads(chargetune("verify", folder / "use.sqlite", "--study", "use", "--trial", 1, "--json").stdout)
    assert told["verified"] is True
    # Somebody counts a plant less.
    path = tmp_path / "other.sqlite"
    shutil.copy(folder / "use.sqlite", path)
    with sqlite3.connect(path) as connection:
        connection.execute("update trial set score = replace(score, '\"plants\":12.0', '\"plants\":11.0') where number = 0")
    code, said, _ = chargetune_here("verify", path)
    assert code == 1
    assert "study 'use', trial 0: metrics.plants: stated 11.0, recomputed 12.0" in said
    assert "1 figure not as stated" in said
    assert "0 studies of" in chargetune("verify", path, "--trial", 5, code=2).stderr
    assert "allowed are use" in chargetune("verify", path, "--study", "other", code=2).stderr
    assert "allowed are a certificate and a store" in chargetune("verify", folder / "use.toml", code=2).stderr


def test_export_has_a_row_for_each_drawn_plant(folder, trials, tmp_path):
    pandas = pytest.importorskip("pandas", reason="pandas is in the extra export")
    chargetune("store", "export", folder / "use.sqlite", "--format", "csv", "--out", tmp_path)
    names = {path.name for path in (tmp_path / "use").iterdir()}
    assert {"trial-0000.bdf.csv", "trial-0000.median.bdf.csv", "trial-0000.best.bdf.csv", "trial-0000.plants.csv"} < names
    plants = pandas.read_csv(tmp_path / "use" / "trial-0000.plants.csv")
    assert len(plants) == 12
    assert plants["objective"].mean() == pytest.approx(trials[0]["objective"], rel=1e-9)
    assert plants["excess of voltage_max_V"].max() == pytest.approx(trials[0]["excess"]["voltage_max_V"], rel=1e-9)
    assert plants["drawn soc_start"].between(*RANGE["soc_start"]).all()
    # The worst plant's trace is the one of the trial.
    voltage = {name: pandas.read_csv(tmp_path / "use" / f"trial-0000{name}.bdf.csv")["Voltage / V"].max() for name in ("", ".best")}
    assert voltage[""] > voltage[".best"]


def test_a_damaged_trace_leaves_the_report_its_other_parts(folder, tmp_path):
    path = tmp_path / "damaged.sqlite"
    shutil.copy(folder / "use.sqlite", path)
    with sqlite3.connect(path) as connection:
        connection.execute("update trace set data = x'00'")
    assert "over 12 drawn plants" in report(folder / "use.sqlite", tmp_path / "whole.html")
    text = report(path, tmp_path / "damaged.html")
    assert "over 12 drawn plants" not in text
    assert "is damaged" in text


def report(store, page):
    chargetune("report", store, "-o", page)
    return page.read_text()
