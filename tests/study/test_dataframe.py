"""What a notebook calls: the HTML of each object, the bar, the data frame."""

import subprocess
import sys
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from study_toy import SPACE, Toy, open_study

from chargetune.battery.case_study.configurations import case_study
from chargetune.battery.charging.evaluate import run_charge
from chargetune.episode.episode import Ending
from chargetune.episode.score import Score
from chargetune.study.dataframe import trials_dataframe
from chargetune.study.trial import Trial, TrialStatus


class Outline(HTMLParser):
    """Every tag closed in order; the text of each cell; what the document would run."""

    def __init__(self, text):
        super().__init__()
        self.open, self.cells, self.tags = [], [], []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)
        assert not [name for name, _ in attributes if name.startswith("on")]
        self.open.append(tag)
        if tag in ("td", "th"):
            self.cells.append("")

    def handle_startendtag(self, tag, attributes):
        self.handle_starttag(tag, attributes)
        self.handle_endtag(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] in ("td", "th"):
            self.cells[-1] += data

    def after(self, name):
        return self.cells[self.cells.index(name) + 1]


def test_a_study_shows_its_best_theta_with_units(store):
    with open_study(store) as study:
        assert Outline(study._repr_html_()).after("trials") == "none"
        study.run(Toy(), 24)
        shown = Outline(study._repr_html_())
        best = study.best()
        failed = sum(t.status == "failed" for t in study.trials())
        assert shown.cells[0] == "trials"
        assert shown.after("trials") == f"24: {24 - failed} done, {failed} failed"
        assert shown.after("best trial") == str(best.number)
        assert shown.after("why") == "it is the best that was measured to keep every limit"
        assert shown.after("x") == f"{best.theta[0]:.5g}"
        assert shown.after("objective") == f"{best.score.objective:.5g}"
        assert shown.after("t80_min") == "-"


def test_trials_and_scores_show_themselves_and_what_is_unknown(store):
    score = Score(1.25, -3.0, {"voltage": 0.002, "<b>": -1.0}, {"voltage": 0.001, "<b>": 0.0}, {"t80_min": None, "t95_min": 31.5})
    shown = Outline(score._repr_html_())
    row = shown.cells.index("voltage")
    assert shown.cells[row : row + 4] == ["voltage", "0.002", "0.001", "no"]
    assert "<b>" in shown.cells  # as text
    assert shown.after("limits kept") == "no"
    assert shown.after("t80_min") == "-"
    running = Outline(Trial(3, (0.5, 2.0))._repr_html_())
    assert (running.after("status"), running.after("ending"), running.after("theta")) == ("running", "-", "0.5, 2")
    evil = "<script>alert(1)</script>"
    assert "script" not in Outline(Trial(4, (0.5,), TrialStatus.FAILED, ending=evil)._repr_html_()).tags
    done = Trial(5, (0.5,), TrialStatus.DONE, score, "done")
    assert done._repr_html_().endswith(score._repr_html_())


def test_an_episode_shows_a_curve_for_each_signal():
    problem = case_study("backoff", 1).problem()
    episode = run_charge(problem, seed=0)
    html = episode._repr_html_()
    shown = Outline(html)
    assert shown.after("intervals") == "360 of 10 s"
    assert shown.tags.count("polyline") == len(episode.input_names) + len(episode.output_names)
    voltage = episode.signal("voltage_V")[1]
    assert f"voltage_V (V): {voltage.min():.4g} to {voltage.max():.4g} in" in html
    blind = replace(episode, output_end=np.full_like(episode.output_end, np.nan), message="<i>")
    assert Outline(blind._repr_html_()).tags.count("polyline") == len(episode.input_names)
    assert "no finite sample" in blind._repr_html_()
    empty = Outline(episode.cut(0, Ending.PLANT, "it never began")._repr_html_())
    assert empty.after("ending") == "plant it never began"


def test_the_data_frame_holds_the_trials_and_invents_nothing(store):
    with open_study(store) as study:
        assert len(study.trials_dataframe()) == 0
        study.run(Toy(), 24)
        study.ask()
        frame, trials = study.trials_dataframe(), study.trials()
    assert list(frame.index) == list(range(25))
    assert list(frame.columns)[:9] == [
        "status", "ending", "feasible", "objective", "performance", "asked_at", "told_at", "x", "r",
    ]  # fmt: skip
    np.testing.assert_array_equal(frame[["x", "r"]].to_numpy(), [t.theta for t in trials])
    done = frame[frame.status == "done"]
    scores = [t.score for t in trials if t.score]
    assert list(done.objective) == [s.objective for s in scores]
    assert list(done.excess_v) == [s.excess["v"] for s in scores]
    assert list(done.feasible) == [s.feasible for s in scores]
    others = frame[frame.status != "done"]
    assert set(others.status) == {"failed", "running"}
    assert others[["objective", "performance", "excess_v", "x_end"]].isna().all().all()
    assert frame.t80_min.isna().all()


def test_without_its_packages_the_message_names_the_extra(store, monkeypatch):
    for package in ("pandas", "tqdm.auto"):
        monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ImportError, match=r"needs pandas: pip install 'chargetune\[notebook\]'"):
        trials_dataframe(SPACE, [])
    with open_study(store) as study:
        with pytest.raises(ImportError, match=r"progress=True needs tqdm: pip install 'chargetune\[notebook\]'"):
            study.run(Toy(), 2, progress=True)
        assert study.trials() == []


def test_a_bar_counts_the_trials_also_of_a_resumed_study(store, capsys):
    with open_study(store) as study:
        study.run(Toy(), 5, progress=False)
        assert capsys.readouterr().err == ""
        study.run(Toy(), 9, progress=True)
        best = study.best()
    said = capsys.readouterr().err
    assert "5/9" in said
    assert "9/9" in said
    assert f"best {best.score.objective:.4g}" in said


def test_neither_pandas_nor_tqdm_is_imported_before_it_is_used():
    code = "import sys, chargetune.study.study; assert not {'pandas', 'tqdm'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)
