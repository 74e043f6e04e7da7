import os
import signal
from contextlib import suppress

import pytest

from chargetune.battery.charging.evaluate import Evaluation
from chargetune.battery.studies.campaign import load_campaign, run_campaign
from chargetune.battery.studies.open_study import open_study
from chargetune.study.executors import process_executor
from chargetune.study.store.store import Store
from study_text import study_text

QUICK = study_text(study={"trials": 9, "batch": 2})
CAMPAIGN = """
[campaign]
configs = ["a.toml", "b.toml"]
seeds = [1, 4]
trials = 5
mismatch_from_seed = true
"""


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "a.toml").write_text(QUICK)
    (tmp_path / "b.toml").write_text(QUICK.replace("batch = 2", "").replace("60", "120"))
    (tmp_path / "c.toml").write_text(CAMPAIGN)
    return tmp_path


@pytest.fixture(scope="module", autouse=True)
def _virtual_machine():
    """Here and in the workers, which would all compile the same episodes at once, for a few charges each."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CHARGETUNE_CC", "none")
        yield


@pytest.fixture(scope="module")
def workers(_virtual_machine):
    with process_executor(2) as executor:
        yield executor


def essence(path):
    with Store(path, read_only=True) as store:
        return {r.name: [(t.theta, t.seed, t.status, t.score, t.trace_sha256) for t in store.trials(r.id)] for r in store.studies()}


def one_by_one(path, entries):
    with Store(path) as store:
        for entry in entries:
            with open_study(store, entry.config, entry.folder) as study:
                study.run(Evaluation(entry.config.problem(entry.folder)), entry.config.study.trials)
    return essence(path)


def test_a_campaign_is_its_studies(folder, workers):
    entries = load_campaign(folder / "c.toml")
    assert [e.name for e in entries] == ["a seed 1", "a seed 4", "b seed 1", "b seed 4"]
    assert [e.config.controller.mismatch_seed for e in entries] == [1, 4, 1, 4]
    seen = []
    rows = run_campaign(entries, folder / "s.db", workers, 2, progress=seen.append)
    assert [(r.name, r.state, r.told, r.message) for r in rows] == [(e.name, "done", 5, None) for e in entries]
    assert {s.name for s in seen} == {e.name for e in entries}
    assert essence(folder / "s.db") == one_by_one(folder / "whole.db", entries)
    for row in rows:
        with Store(folder / "s.db") as store:
            trials = store.trials(store.study(row.name).id)
        assert row.violating == sum(not t.feasible for t in trials)
        assert row.best in trials
    assert run_campaign(entries, folder / "s.db", workers, 2, progress=seen.append) == rows
    assert len({s.name for s in seen}) == len(entries)


def test_an_interrupted_campaign_goes_on(folder, workers):
    entries = load_campaign(folder / "c.toml")

    def stop(_):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_campaign(entries, folder / "s.db", workers, 1, progress=stop)
    assert len(essence(folder / "s.db")) < 4
    assert {r.state for r in run_campaign(entries, folder / "s.db", workers, 3)} == {"done"}
    assert essence(folder / "s.db") == one_by_one(folder / "whole.db", entries)


def test_dead_workers_cost_nothing(folder):
    (folder / "c.toml").write_text(CAMPAIGN.replace("trials = 5", "trials = 7"))
    entries = load_campaign(folder / "c.toml")
    with process_executor(2) as executor:
        pids = {executor.submit(os.getpid).result() for _ in range(20)}
        assert len(pids) == 2

        def kill(_):
            while pids:
                with suppress(ProcessLookupError):
                    os.kill(pids.pop(), signal.SIGKILL)

        rows = run_campaign(entries, folder / "s.db", executor, 2, progress=kill)
    assert {r.state for r in rows} == {"done"}
    assert essence(folder / "s.db") == one_by_one(folder / "whole.db", entries)


def test_a_study_that_cannot_go_on_does_not_stop_the_others(folder, workers):
    entries = load_campaign(folder / "c.toml")
    run_campaign(entries, folder / "s.db", workers, 2)
    (folder / "a.toml").write_text(QUICK.replace("steps = 60", "steps = 50"))
    (folder / "c.toml").write_text(CAMPAIGN.replace("trials = 5", "trials = 6"))
    rows = run_campaign(load_campaign(folder / "c.toml"), folder / "s.db", workers, 2)
    assert [(r.state, r.told) for r in rows] == [("stopped", 5), ("stopped", 5), ("done", 6), ("done", 6)]
    assert rows[0].message.startswith("StudyError: study 'a seed 1' was begun with something else:\n  config.episode.steps: 60 -> 50")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"seeds = [1, 4]": "seeds = []"}, r"campaign.seeds = \[\]: allowed are different whole numbers >= 0"),
        ({"seeds = [1, 4]": "seeds = [1, 1]"}, r"campaign.seeds = \[1, 1\]: allowed"),
        ({"seeds = [1, 4]": "seeds = [-1]"}, r"campaign.seeds = \[-1\]: allowed"),
        ({"seeds = [1, 4]": "seeds = '4:1'"}, "campaign.seeds = '4:1': allowed"),
        ({"seeds = [1, 4]": "seeds = '4'"}, "campaign.seeds = '4': allowed"),
        ({"seeds = [1, 4]": "seeds = 'a:b'"}, "campaign.seeds = 'a:b': allowed"),
        ({"seeds = [1, 4]": "seeds = [true]"}, r"campaign.seeds\[0\] = true, allowed is a whole number"),
        ({"trials = 5": "trials = 0"}, "campaign.trials = 0, allowed is at least 1"),
        ({"trials = 5": "trails = 5"}, "campaign.trails is not a known key"),
        ({'["a.toml", "b.toml"]': "[]"}, r"campaign.configs = \[\]: list should have at least 1 item"),
        ({'"b.toml"': '"a.toml"'}, "campaign.configs = .*: allowed are files of different names"),
        ({'"b.toml"': '"none.toml"'}, "campaign.configs: there is no file .*none.toml"),
        ({"[campaign]": "[campagne]"}, "campagne is not a known key; did you mean campaign"),
        ({"[campaign]": "[campaign"}, "c.toml is not valid TOML"),
    ],
)
def test_bad_campaigns_are_refused_before_anything_is_stored(folder, change, message):
    ((old, new),) = change.items()
    (folder / "c.toml").write_text(CAMPAIGN.replace(old, new))
    with pytest.raises(ValueError, match=message):
        load_campaign(folder / "c.toml")


def test_a_study_file_with_an_error_is_named(folder):
    (folder / "b.toml").write_text("[episode]\nsteps = 1.5\n")
    with pytest.raises(ValueError, match=r"b.toml: episode.steps = 1.5, allowed is a whole number"):
        load_campaign(folder / "c.toml")
    (folder / "b.toml").write_text("[episode]\nsteps = 40\n")
    with pytest.raises(ValueError, match=r"b.toml: theta is empty"):
        load_campaign(folder / "c.toml")


@pytest.mark.parametrize("count", [0, -2, True, 1.0])
def test_bad_workers(folder, workers, count):
    with pytest.raises(ValueError, match=f"workers = {count}, allowed is an integer >= 1"):
        run_campaign(load_campaign(folder / "c.toml"), folder / "s.db", workers, count)
