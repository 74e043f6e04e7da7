"""Bad use that no other file here refuses: what a plant returns, what a file holds."""

import pickle
import re
import sqlite3
from dataclasses import replace
from hashlib import sha256
from pathlib import Path

import pytest
from study_toy import Toy, essence, open_study

import chargetune
from chargetune.episode.score import Score
from chargetune.study.executors import process_executor
from chargetune.study.store.store import Store, StoreError

GOOD = Score(1.0, 1.0, {"v": -0.1}, {"v": 0.0}, {"t80_min": None})


class Returns:
    """An evaluation that returns this score."""

    def __init__(self, score):
        self.score = score

    def __call__(self, theta, seed):
        return self.score, None, "done"


@pytest.mark.parametrize("value", [None, float("inf"), float("-inf"), float("nan"), "1.0", True, 1 + 1j, [1.0]])
@pytest.mark.parametrize("field", ["objective", "performance", "excess", "metrics"])
def test_a_score_that_is_no_number_is_a_failed_trial_that_names_field_and_value(store, field, value):
    if field == "metrics" and value is None:
        return  # None is what a metric is that the episode never reached
    bad = replace(GOOD, **{field: {"v": value} if field in ("excess", "metrics") else value})
    name = f"score.{field}[v]" if field in ("excess", "metrics") else f"score.{field}"
    with open_study(store) as study:
        assert study.run(Returns(bad), 2) is None
        for trial in study.trials():
            assert trial.ending == f"ValueError: {name} = {value!r}, allowed is a finite number"
            assert (trial.status, trial.score) == ("failed", None)


def test_nonsense_from_a_worker_process_is_told_in_the_same_words(store):
    with open_study(store) as study, process_executor(1) as pool:
        study.run(Returns(replace(GOOD, objective="much")), 1, executor=pool)
        assert study.trials()[0].ending == "ValueError: score.objective = 'much', allowed is a finite number"


class Evil:
    """Unpickling it leaves a mark."""

    def __init__(self, mark):
        self.mark = mark

    def __reduce__(self):
        return Path.touch, (self.mark,)


def test_a_pickle_is_never_loaded(store, tmp_path):
    mark = tmp_path / "mark"
    data = pickle.dumps(Evil(mark))
    with open_study(store) as study:
        study.run(Toy(), 2)
        before = essence(study.trials())
    with sqlite3.connect(store.location) as raw:
        # Whoever can write the file can also write the hash.
        raw.execute("UPDATE trace SET data = ? WHERE number = 1", (data,))
        raw.execute("UPDATE trial SET trace_sha256 = ? WHERE number = 1", (sha256(data).hexdigest(),))
    raw.close()
    with open_study(store) as study:
        with pytest.raises((StoreError, ValueError)):
            study.trace(1)
        assert study.trace(0) is not None
        assert essence(study.trials())[0] == before[0]
    (tmp_path / "pickle.db").write_bytes(data)
    with pytest.raises(StoreError, match="not a store"):
        Store(tmp_path / "pickle.db")
    assert not mark.exists()
    pickle.loads(data)  # noqa: S301 - made here; the mark is one
    assert mark.exists()


def test_no_module_reads_pickles():
    """torch.load and joblib read them too, NumPy when it is allowed to."""
    reading = re.compile(r"pickle\.(load|Unpickler)|(torch|joblib|dill|shelve)\.(load|open)|allow_pickle=True")
    files = list(Path(chargetune.__file__).parent.rglob("*.py"))
    assert len(files) > 50
    assert [str(f) for f in files if reading.search(f.read_text("utf-8"))] == []
