import shutil
import sqlite3
import subprocess
import sys

import numpy as np
import pytest
from report_studies import TRIALS, charging

from chargetune.battery.charging.evaluate import run_charge
from chargetune.model.parameter_space import Parameter, ParameterSpace
from chargetune.report import read_study
from chargetune.study.store.store import Store, StoreError
from chargetune.study.study import Study


def test_the_view_is_what_the_store_holds(stores):
    view = read_study(stores["mixed"], "charge")
    with Store(stores["mixed"], read_only=True) as store:
        assert list(view.trials) == store.trials(store.study("charge").id)
    assert view.problem == charging(tolerance_V=0.035).problem()
    assert view.space == view.problem.space
    assert view.tuner == "sobol"
    assert [t.number for t in read_study(stores["mixed"], "charge", trials=3).trials] == [0, 1, 2]


@pytest.mark.parametrize(
    ("kind", "untuned", "tuned", "label"),
    [
        ("mixed", 0, 8, "tuned"),
        ("failed", 0, None, "tuned"),
        ("violating", 0, "closest", "tuned, over a limit"),
        ("ei", 0, "G", "tuned, over a limit"),
    ],
)
def test_untuned_and_tuned_trial(stores, kind, untuned, tuned, label):
    view = read_study(stores[kind], "charge")
    scored = [t for t in view.trials if t.score is not None]
    if tuned == "closest":
        tuned = min(scored, key=lambda t: t.score.excess["voltage_max_V"]).number
    if tuned == "G":
        tuned = max(scored, key=lambda t: t.score.performance).number
    assert view.untuned.number == untuned
    assert (None if view.tuned is None else view.tuned.number) == tuned
    assert {t.number for t in view.others} == set(range(TRIALS)) - {untuned, tuned}
    assert view.tuned_label == label


def test_episodes_are_those_that_ran(stores):
    view = read_study(stores["mixed"], "charge")
    read = {t.number: episode for t, episode in view.episodes(view.trials)}
    assert sorted(read) == [n for n in range(TRIALS) if n != 6]
    for number in (0, 8):
        again = run_charge(view.problem, view.trials[number].theta, view.trials[number].seed)
        assert read[number].meta() == again.meta()
        for name, array in again.arrays().items():
            assert np.array_equal(read[number].arrays()[name], array), name
    assert view.episode(None) is None
    assert view.episode(view.trials[6]) is None


def test_unknown_study_names_those_there_are(stores):
    with pytest.raises(StoreError, match=r"no study 'chrage'; there are: charge"):
        read_study(stores["mixed"], "chrage")


def test_no_such_store_is_not_made(tmp_path):
    with pytest.raises(StoreError, match="no such store"):
        read_study(tmp_path / "none.sqlite", "charge")
    assert not list(tmp_path.iterdir())


def test_study_without_trials_is_refused(tmp_path):
    space = ParameterSpace((Parameter("x", 0.0, 1.0, 0.5),))
    with Store(tmp_path / "s.sqlite") as store, Study.create_or_resume(store, "new", config={}, space=space, tuner=None):
        pass
    with pytest.raises(ValueError, match="study 'new' has no trials yet"):
        read_study(tmp_path / "s.sqlite", "new")


def test_damaged_trace_is_named(stores, tmp_path):
    path = shutil.copy(stores["mixed"], tmp_path / "damaged.sqlite")
    connection = sqlite3.connect(path)
    with connection:
        connection.execute("UPDATE trace SET data = zeroblob(100) WHERE number = 2")
    connection.close()
    view = read_study(path, "charge")
    assert len(view.episode(view.trials[1])) > 0
    with pytest.raises(StoreError, match="trace of trial 2 is damaged"):
        list(view.episodes(view.trials))


def test_reading_changes_nothing(stores):
    before = stores["mixed"].read_bytes()
    view = read_study(stores["mixed"], "charge")
    list(view.episodes(view.trials))
    assert stores["mixed"].read_bytes() == before


def test_import_leaves_matplotlib_and_torch_alone():
    code = "import sys, chargetune.report; sys.exit(str([m for m in ('matplotlib', 'torch') if m in sys.modules]))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False).stderr.strip() == "[]"
