"""The page as a browser would take it: nested as HTML must be, carrying all it needs, fetching nothing."""

import base64
import gzip
import json
import re
import sqlite3
from pathlib import Path

import plotly
import pytest
from html_check import parsed
from report_studies import HOSTILE, charging, other_study, run_charging

from chargetune.battery.charging.evaluate import evaluate
from chargetune.battery.charging.problem import with_feedback
from chargetune.report import read_study, report_page
from chargetune.report.page.html import table


def carried(page, name):
    return gzip.decompress(base64.b64decode(re.search(rf'id="{name}">([A-Za-z0-9+/=]+)</script>', page)[1]))


def sections(checker):
    return "".join(checker.text)


@pytest.fixture(scope="module")
def page(stores):
    return report_page(read_study(stores["mixed"], "charge"))


@pytest.mark.parametrize("kind", ["mixed", "violating", "ei", "failed"])
def test_html_is_well_formed(stores, kind):
    checker = parsed(report_page(read_study(stores[kind], "charge"), evaluate=False))
    text = sections(checker)
    for heading in ("What was tuned", "Limits, checked again", "Convergence", "Violations", "Failures", "Sensitivity", "Provenance"):
        assert heading in text
    assert ("There is no result" in text or "there is no result" in text) == (kind == "failed")
    assert ("did not keep the limits: no trial kept every limit, and it came closest" in text) == (kind == "violating")
    assert ("did not keep the limits: it has the best performance G" in text) == (kind == "ei")


def test_page_fetches_nothing(page):
    for tag, attributes in parsed(page).tags:
        for name in ("src", "href", "action", "data", "srcset"):
            assert name not in attributes, f"<{tag} {name}={attributes.get(name)}>"
    (policy,) = [a["content"] for t, a in parsed(page).tags if t == "meta" and a.get("http-equiv") == "Content-Security-Policy"]
    assert policy.startswith("default-src 'none';")
    assert "http" not in policy


def test_page_carries_plotly_and_the_trials(page, stores):
    assert carried(page, "plotly") == (Path(plotly.__file__).parent / "package_data" / "plotly.min.js").read_bytes()
    data, view = json.loads(carried(page, "data")), read_study(stores["mixed"], "charge")
    assert [row["number"] for row in data["rows"]] == [t.number for t in view.trials]
    assert [row["feasible"] for row in data["rows"]] == [None if t.score is None else t.feasible for t in view.trials]
    assert [s["number"] for s in data["shown"]] == [view.untuned.number, view.tuned.number]
    # Trial 6 left no trace.
    assert {d["number"] for d in data["others"]} == {t.number for t in view.others} - {6}
    assert len(data["sensitivity"]) >= 2


def test_text_says_what_the_store_says(page, stores):
    view, text = read_study(stores["mixed"], "charge"), sections(parsed(page))
    best = view.tuned
    for entry, value in zip(view.space.entries, best.theta, strict=True):
        assert f"{entry}{value:.5g}" in text
    assert f"trial {best.number}, which kept every limit" in text
    assert best.trace_sha256 in text
    assert view.record.identity_sha256 in text
    assert "the cycler lost its connection" in text
    assert "limit trip: too hot" in text
    # The run is deterministic, so evaluating again gives the same to rounding.
    assert float(re.search(r"largest difference([\d.e+-]+)", text)[1]) < 1e-9


def test_untuned_controller_with_feedback_stands_beside_the_result(page, stores):
    view = read_study(stores["mixed"], "charge")
    score, _, _ = evaluate(with_feedback(view.problem), None, view.tuned.seed)
    text = sections(parsed(page))
    assert "untuned, offset_free" in text
    assert "What it already does is no merit of learning" in text
    # One that reads the voltage overshoots less than the wrong model alone.
    assert score.metrics["overshoot_mV"] < view.start.score.metrics["overshoot_mV"]
    assert f"{score.metrics['overshoot_mV']:.4g}" in text
    assert "untuned, offset_free" not in report_page(view, evaluate=False)


def test_hundred_trials_fit_in_5_MB(tmp_path):
    config = charging()
    path = run_charging(tmp_path / "many.sqlite", config, trials=100)
    page = report_page(read_study(path, "charge"), evaluate=False)
    assert 1e6 < len(page.encode()) < 5e6


def test_markup_in_names_is_text(tmp_path):
    page = report_page(read_study(other_study(tmp_path / "other.sqlite"), HOSTILE))
    checker = parsed(page)
    assert sum(tag == "script" for tag, _ in checker.tags) == 5
    assert HOSTILE in sections(checker)
    assert '<script>alert("x")' not in page


def test_study_of_another_system(tmp_path):
    text = sections(parsed(report_page(read_study(other_study(tmp_path / "other.sqlite", "crane"), "crane"))))
    assert "not one of battery charging" in text
    assert "cannot be judged again" in text
    assert "Spearman" in text
    assert "Signals over time" not in text


def change(path, statement, *values):
    with sqlite3.connect(path) as connection:
        connection.execute(statement, values)
    connection.close()


def test_score_that_is_not_what_the_trace_says(tmp_path):
    path = run_charging(tmp_path / "s.sqlite", charging())
    with sqlite3.connect(path) as connection:
        (text,) = connection.execute("SELECT score FROM trial WHERE number = 4").fetchone()
    connection.close()
    score = json.loads(text)
    score["excess"]["voltage_max_V"] -= 0.001
    change(path, "UPDATE trial SET score = ? WHERE number = 4", json.dumps(score))
    assert "in trials 4 the stored score says something else" in sections(parsed(report_page(read_study(path, "charge"), evaluate=False)))


def test_damaged_trace_is_named(tmp_path):
    path = run_charging(tmp_path / "s.sqlite", charging())
    change(path, "UPDATE trace SET data = substr(data, 1, 200) WHERE number = 5")
    text = sections(parsed(report_page(read_study(path, "charge"), evaluate=False)))
    assert "trace of trial 5 is damaged" in text
    assert "Judged again: 9 trials with a trace; every stored excess is what its trace says" in text


def test_numbers_and_missing_values_in_a_table():
    markup = table(("a", "b"), [("<x>", 1 / 3), ("n", None), (("t", "bad"), 7)])
    for part in ("&lt;x&gt;", "<td>0.33333</td>", "<td>-</td>", '<td class="bad">t</td>', "<td>7</td>"):
        assert part in markup
