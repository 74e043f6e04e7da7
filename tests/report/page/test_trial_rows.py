import csv
import io
import json
from dataclasses import replace

import numpy as np
import pytest
from report_studies import other_study

from chargetune.report import read_study
from chargetune.report.page.trial_rows import study_head, study_summary, theta_document, trace_csv, trial_rows
from chargetune.report.study_view import read_studies
from charging_problems import changed


@pytest.fixture(scope="module")
def view(stores):
    return read_study(stores["mixed"], "charge")


def test_rows_and_head_are_json(stores):
    for path in stores.values():
        view = read_study(path, "charge")
        text = json.dumps([study_head(view), trial_rows(view, view.trials), study_summary(view)], allow_nan=False)
        assert "charge" in text


def test_rows_say_what_the_trials_say(view):
    for row, trial in zip(trial_rows(view, view.trials), view.trials, strict=True):
        assert (row["number"], row["status"], row["trace"]) == (trial.number, trial.status, trial.trace_sha256 is not None)
        if trial.score is None:
            assert (row["feasible"], row["value"], row["metrics"], row["counted"]) == (None, None, {}, False)
            assert set(row["excesses"].values()) == {None}
        else:
            assert row["value"] == pytest.approx(-trial.score.objective)
            assert row["excesses"] == {name: pytest.approx(1e3 * value, rel=1e-6) for name, value in trial.score.excess.items()}
            assert row["theta"] == pytest.approx(list(trial.theta))
            assert row["counted"] == trial.feasible


def test_the_papers_method_counts_every_score(stores):
    view = read_study(stores["ei"], "charge")
    rows = trial_rows(view, view.trials)
    assert all(row["counted"] for row in rows)
    assert rows[0]["value"] == pytest.approx(-view.trials[0].score.performance)


def test_head_names_limits_and_theta(view):
    head = study_head(view)
    assert [x["name"] for x in head["limits"]] == ["current_min_A", "current_max_A", "voltage_max_V", "voltage_min_V"]
    assert [x["entry"] for x in head["theta"]] == list(view.space.entries)
    told = [(x["label"], x["unit"], x["tolerance"], x["drawn"]) for x in head["excesses"]]
    assert told == [("voltage over 4.2 V", "mV", pytest.approx(35.0), True), ("voltage under 2.5 V", "mV", pytest.approx(35.0), False)]
    assert head["metrics"]["t80_min"] == ["time to 80 % SOC", "min"]


def test_a_figure_of_merit_that_no_trial_has_is_left_out_and_the_worst_objective_is_in_its_unit(view):
    told = {"t80_min": None, "t99_min": None, "objective_worst": -0.5}
    trials = [replace(t, score=replace(t.score, metrics=told)) for t in view.trials if t.score is not None]
    timed = replace(view, trials=trials, problem=changed(view.problem, charge_time_to_soc=0.8))
    minutes = timed.problem.episode.steps * timed.problem.controller.sampling_time_s / 60
    assert study_head(timed)["metrics"] == {"objective_worst": ["t80, worst plant", "min"]}
    assert trial_rows(timed, trials)[0]["metrics"] == {"objective_worst": pytest.approx(0.5 * minutes)}


def test_the_loss_is_named_by_what_is_minimised(view):
    timed = changed(view.problem, charge_time_to_soc=0.8)
    views = [view, replace(view, tuner="ei"), replace(view, problem=timed), replace(view, problem=None)]
    assert [study_head(v)["objective"]["label"] for v in views] == [
        "mean of (z_d - z)^2", "-G", "time to 80 % SOC (min)", "objective (larger is better)",
    ]  # fmt: skip
    # Minutes, not shares of the episode.
    share = -view.trials[0].score.objective
    assert trial_rows(views[2], view.trials)[0]["value"] == pytest.approx(share * 150 * 10 / 60, rel=1e-6)


def test_summary(stores):
    mixed, failed = (study_summary(read_studies(stores[kind])[0]) for kind in ("mixed", "failed"))
    assert (mixed["done"], mixed["failed"], mixed["running"]) == (8, 2, 0)
    assert (failed["done"], failed["failed"], failed["best"]) == (0, 10, None)


def test_other_systems_have_no_limits_in_their_document(tmp_path):
    (view,) = read_studies(other_study(tmp_path / "o.sqlite", "crane"))
    assert study_head(view)["limits"] == []
    assert read_studies(view.location, only=99) == []


def test_theta_document_goes_back_into_the_space(view):
    document = theta_document(view, view.tuned)
    np.testing.assert_array_equal(view.space.from_dict(document["theta"]), view.tuned.theta)
    assert document["units"] == {"backoff_V": "V", "R0_ratio": "1", "R1_ratio": "1"}


def test_csv_has_every_number_to_the_last_bit(view):
    episode = view.episode(view.tuned)
    table = list(csv.DictReader(io.StringIO(trace_csv(episode))))
    assert len(table) == len(episode)
    start, end = episode.signal("voltage_V")
    for name, values in (("time_s", episode.time_s), ("current_A", episode.input[:, 0]), ("voltage_V", start), ("voltage_V end", end)):
        np.testing.assert_array_equal([float(row[name]) for row in table], values)
    assert {"soc", "true voltage_V", "solver status", "estimated soc"} <= set(table[0])
