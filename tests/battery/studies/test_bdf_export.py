"""Export: what comes out is what is in the store, and a reader of the Battery Data Format understands it."""

import json

import numpy as np
import pandas as pd
import psycopg
import pytest

from chargetune.battery.charging.evaluate import Evaluation
from chargetune.battery.identification.cycler_files import read_record
from chargetune.battery.studies.bdf_export import bdf_columns, export
from chargetune.battery.studies.open_study import open_study
from chargetune.battery.studies.study_file import load_config
from chargetune.episode.episode import Episode
from chargetune.learning import Sobol
from chargetune.study.store.salvage import salvage
from chargetune.study.store.store import Store, StoreError
from chargetune.study.store.trace import encode
from chargetune.study.study import Study
from chargetune.study.warm_start import Earlier
from study_text import study_text

QUICK = study_text(study={"name": "quick"})


@pytest.fixture(scope="module", params=["sqlite", "postgres"])
def store(request, tmp_path_factory):
    folder = tmp_path_factory.mktemp("export")
    (folder / "s.toml").write_text(QUICK)
    config = load_config(folder / "s.toml")
    with Store(folder / "s.db") as opened:
        with open_study(opened, config) as study:
            study.run(Evaluation(config.problem()), 3)
            failed, _ = study.ask(2)
            study.fail(failed.number, 'PlantError: cable, "off"\n')
        if request.param == "sqlite":
            yield opened
            return
    # Not the fixture of one database for each test: this one is for the module.
    server = request.getfixturevalue("postgres_server")
    with psycopg.connect(server, autocommit=True) as connection:
        connection.execute("CREATE DATABASE exported")
    url = server.replace("/postgres?", "/exported?")
    salvage(folder / "s.db", url)
    with Store(url) as opened:
        yield opened


def read(path):
    # Before pandas 3 the last digit of a number was lost unless this was asked for.
    exact = {"float_precision": "round_trip"} if int(pd.__version__.split(".")[0]) < 3 else {}
    return pd.read_parquet(path) if path.suffix == ".parquet" else pd.read_csv(path, **exact)


@pytest.mark.parametrize("form", ["parquet", "csv"])
def test_every_trial_and_trace_is_there(store, tmp_path, form):
    steps = []
    written = export(store, tmp_path, form=form, step=lambda done, total: steps.append((done, total)))
    assert written.left == ()
    assert sorted(p.relative_to(tmp_path).as_posix() for p in written.files) == sorted(
        f"quick/{name}" for name in ("study.json", f"trials.{form}", *(f"trial-000{k}.bdf.{form}" for k in range(3)))
    )
    assert steps[-1] == (5, 5)
    trials = store.trials(1)
    table = read(tmp_path / "quick" / f"trials.{form}")
    assert table["trial"].tolist() == [0, 1, 2, 3, 4]
    assert table["status"].tolist() == [str(t.status) for t in trials]
    assert table["ending"].iloc[3] == trials[3].ending
    np.testing.assert_array_equal(table[[f"backoff_V[{k}]" for k in range(3)]], [t.theta for t in trials])
    np.testing.assert_array_equal(table["objective"].iloc[:3], [t.score.objective for t in trials[:3]])
    assert table["objective"].iloc[3:].isna().all()
    assert table["trace_sha256"].iloc[0] == trials[0].trace_sha256
    assert table["seed"].tolist() == [t.seed for t in trials]
    about = json.loads((tmp_path / "quick" / "study.json").read_text())
    assert about["identity"] == store.study("quick").identity


@pytest.mark.parametrize("form", ["parquet", "csv"])
def test_traces_are_battery_data_format(store, tmp_path, form):
    export(store, tmp_path, form=form)
    table = read(tmp_path / "quick" / f"trial-0001.bdf.{form}")
    episode = Episode.from_arrays(*store.trace(1, 1))
    np.testing.assert_array_equal(table["Test Time / s"], episode.time_s + 10.0)
    np.testing.assert_array_equal(table["Current / A"], episode.input[:, 0])
    np.testing.assert_array_equal(table["Voltage / V"], episode.signal("voltage_V")[1])
    np.testing.assert_array_equal(table["voltage at start / V"], episode.signal("voltage_V")[0])
    np.testing.assert_array_equal(table["soc / 1"], episode.signal("soc")[1])
    if form == "csv":
        record = read_record(tmp_path / "quick" / "trial-0001.bdf.csv")
        np.testing.assert_allclose(record.current_A, episode.input[:, 0])
        np.testing.assert_allclose(record.voltage_V, episode.signal("voltage_V")[1])
        # Charge-positive in both: the integral of the current is the charge that went in.
        gained = episode.input[:, 0].sum() * 10.0 / 3600.0
        assert record.charge_Ah[-1] - record.charge_Ah[0] == pytest.approx(gained - episode.input[0, 0] * 10.0 / 3600.0)


def test_a_temperature_is_in_degrees_and_is_read_back_in_kelvin(tmp_path):
    steps = 5
    outputs = np.column_stack([np.linspace(3.5, 4.0, steps), np.full(steps, 300.0)])
    episode = Episode(
        10.0, ("current_A",), ("voltage_V", "temperature_K"), ("A",), ("V", "K"), ("soc",),
        np.arange(steps) * 10.0, np.ones((steps, 1)), outputs, outputs, np.zeros((steps, 1)),
        np.zeros(steps, int), np.zeros(steps), np.zeros(steps, int), "done",
    )  # fmt: skip
    columns = bdf_columns(episode)
    np.testing.assert_allclose(columns["Surface Temperature / degC"], 26.85)
    assert "true" not in " ".join(columns)
    pd.DataFrame(columns).to_csv(tmp_path / "t.csv", index=False)
    np.testing.assert_allclose(read_record(tmp_path / "t.csv").temperature_K, 300.0)


def test_what_cannot_be_a_table_is_named_and_the_rest_written(tmp_path):
    (tmp_path / "s.toml").write_text(QUICK)
    config = load_config(tmp_path / "s.toml")
    with Store(tmp_path / "s.db") as store, open_study(store, config) as study:
        study.run(Evaluation(config.problem()), 2)
        (own,) = study.ask()
        study.finish(own.number, None, encode({"x": np.arange(3.0)}, {}), "a trace of the caller's own")
        with store._engine.execution_options(writing=True).begin() as connection:
            connection.exec_driver_sql("UPDATE trace SET data = x'00' WHERE number = 0")
        written = export(store, tmp_path / "out", form="csv")
    assert [line.split(": ")[0] for line in written.left] == ["study 'quick', trial 0", "study 'quick', trial 2"]
    assert "damaged" in written.left[0]
    assert "no episode of this library" in written.left[1]
    assert (tmp_path / "out/quick/trial-0001.bdf.csv").exists()
    assert len(read(tmp_path / "out/quick/trials.csv")) == 3


def test_names_that_no_file_system_takes_or_tells_apart(store, tmp_path):
    with Store(tmp_path / "s.db") as other:
        for name in ("quick: 1", "Quick_ 1", "b"):
            other.add_study(name, store.study("quick").identity)
        written = export(other, tmp_path / "out", form="csv")
        assert sorted({p.parent.name for p in written.files}) == ["Quick_ 1-2", "b", "quick_ 1-1"]
        assert {p.parent.name for p in export(other, tmp_path / "one", form="csv", study="b").files} == {"b"}
        with pytest.raises(StoreError, match="no study 'x'"):
            export(other, tmp_path / "none", study="x")
    assert not (tmp_path / "none").exists()


def test_trials_of_earlier_studies_are_among_them(store, tmp_path):
    (tmp_path / "s.toml").write_text(QUICK)
    space, earlier = load_config(tmp_path / "s.toml").problem().space, [Earlier(store.location, "quick")]
    with Store(tmp_path / "s.db") as new:
        Study.create_or_resume(new, "new", config={}, space=space, tuner=Sobol(), earlier=earlier).close()
        export(new, tmp_path / "out", form="csv")
    assert read(tmp_path / "out/new/trials.csv")["trial"].tolist() == [-4, -3, -2, -1]
    assert (tmp_path / "out/new/earlier-0004.bdf.csv").exists()


@pytest.mark.parametrize(("form", "without", "named"), [("parquet", "pyarrow", "pyarrow"), ("csv", "pandas", "pandas")])
def test_without_the_packages(store, tmp_path, monkeypatch, form, without, named):
    import chargetune.battery.studies.bdf_export as module

    real = module.find_spec
    monkeypatch.setattr(module, "find_spec", lambda name: None if name == without else real(name))
    with pytest.raises(ImportError, match=rf"export as {form} needs {named}: pip install 'chargetune\[export\]'"):
        export(store, tmp_path, form=form)
