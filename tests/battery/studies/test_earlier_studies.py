"""The key [[study.earlier]] of a study file."""

import pytest

from chargetune.battery.charging.evaluate import Evaluation
from chargetune.battery.studies.open_study import open_study
from chargetune.battery.studies.study_file import load_config
from chargetune.study.store.store import Store
from chargetune.study.warm_start import Earlier
from study_text import study_text

pytestmark = pytest.mark.usefixtures("virtual_machine")

QUICK = study_text(study={"name": "NAME"}, episode={"steps": 30})
KEY = """
[[study.earlier]]
store = "old.sqlite"
study = "old"
"""


def test_a_study_file_names_earlier_studies(tmp_path):
    (tmp_path / "old.toml").write_text(QUICK.replace("NAME", "old"))
    (tmp_path / "new.toml").write_text(QUICK.replace("NAME", "new") + KEY)
    for name in ("old", "new"):
        config = load_config(tmp_path / f"{name}.toml")
        with Store(tmp_path / f"{name}.sqlite") as store, open_study(store, config, tmp_path) as study:
            study.run(Evaluation(config.problem(tmp_path)), 3)
    with Store(tmp_path / "old.sqlite") as old, Store(tmp_path / "new.sqlite") as new:
        before, taken, own = old.trials(1), new.earlier(1), new.trials(1)
        assert [(t.theta, t.score, t.trace_sha256) for t in taken] == [(t.theta, t.score, t.trace_sha256) for t in before]
        # Sobol's points go on where the earlier study ended.
        assert not {t.theta for t in own} & {t.theta for t in before}
        assert new.study("new").identity["earlier"] == ["old in old.sqlite"]


def test_a_url_is_no_path(tmp_path):
    table = KEY.replace("old.sqlite", "postgresql://me@host/cells")
    (tmp_path / "s.toml").write_text(QUICK + table)
    assert load_config(tmp_path / "s.toml").earlier(tmp_path) == [Earlier("postgresql://me@host/cells", "old")]


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ('[[study.earlier]]\nstore = "a"', r"study.earlier\[0\].study is not given"),
        ('[[study.earlier]]\nstore = ""\nstudy = "x"', r"study.earlier\[0\].store = '', allowed is a text that is not empty"),
        ('[[study.earlier]]\nstore = "a"\nstudy = "x"\ntrials = 3', r"study.earlier\[0\].trials is not a known key"),
        ('[study.earlier]\nstore = "a"\nstudy = "x"', r"study.earlier = a table, allowed is tables \[\[study.earlier\]\]"),
    ],
)
def test_bad_tables_are_refused_by_name(tmp_path, table, message):
    (tmp_path / "s.toml").write_text(QUICK + table)
    with pytest.raises(ValueError, match=message):
        load_config(tmp_path / "s.toml")


def test_a_safe_study_begins_with_no_other_cells_trials(tmp_path):
    text = QUICK.replace("NAME", "safe").replace("sobol", "twin") + "[safety]\n" + KEY
    (tmp_path / "s.toml").write_text(text)
    with Store(tmp_path / "s.sqlite") as store, pytest.raises(ValueError, match=r"\[safety\] is given with \[\[study.earlier\]\]"):
        open_study(store, load_config(tmp_path / "s.toml"), tmp_path)
    with Store(tmp_path / "s.sqlite") as store:
        assert store.studies() == []
