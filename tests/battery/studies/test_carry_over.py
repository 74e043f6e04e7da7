"""A study whose file was changed: what is comparable counts, what is not is set apart, and each reader says so."""

import pytest

from chargetune.battery.charging.verdict import score_episode
from chargetune.battery.studies.open_study import evaluation_of, open_study
from chargetune.battery.studies.study_file import load_config
from chargetune.report.limit_recheck import recheck
from chargetune.report.study_view import read_study
from chargetune.study.result import Reason, read_result
from chargetune.study.store.integrity import check_store
from chargetune.study.store.salvage import salvage
from chargetune.study.store.store import Store
from chargetune.study.study import StudyError
from chargetune.study.trial import TrialStatus
from study_text import study_text

pytestmark = pytest.mark.usefixtures("virtual_machine")

STUDY = {"study": {"name": "s"}, "controller": {"mismatch_seed": 1}, "episode": {"steps": 90}}


def config_of(folder, **tables):
    text = study_text(**{name: {**STUDY.get(name, {}), **tables.get(name, {})} for name in {**STUDY, **tables}})
    (folder / "s.toml").write_text(text)
    return load_config(folder / "s.toml")


@pytest.fixture(scope="module")
def told(tmp_path_factory):
    folder = tmp_path_factory.mktemp("told")
    config = config_of(folder)
    with Store(folder / "s.sqlite") as store, open_study(store, config) as study:
        study.run(evaluation_of("sobol", config.problem()), 6)
    return folder / "s.sqlite"


@pytest.fixture
def changed(told, tmp_path):
    """The trials and the result after one more change of the same store."""
    path = tmp_path / "s.sqlite"
    path.write_bytes(told.read_bytes())

    def change(more=0, **tables):
        config = config_of(tmp_path, **tables)
        with Store(path) as store:
            with open_study(store, config, accept_changed=True) as study:
                if more:
                    study.run(evaluation_of(config.study.tuner, config.problem()), len(study.trials()) + more)
            record = store.study("s")
            return store.trials(record.id), read_result(store, record)

    change.path = path
    return change


def of(trials, status):
    return [t.number for t in trials if t.status is status]


def test_what_lies_outside_of_narrower_bounds_is_no_result_and_counts_again_within_wider_ones(changed):
    first, result = changed()
    assert result.reason is Reason.MEASURED
    narrow = {"theta.backoff": {"nodes": 3, "lower_V": 0.0, "upper_V": 0.06}}
    trials, found = changed(more=2, **narrow)
    apart = [t.number for t in first if max(t.theta) > 0.06]
    assert apart
    assert of(trials, TrialStatus.APART) == apart
    assert max(found.trial.theta) <= 0.06
    assert f"{len(apart)} trials of before a change set apart (theta is outside the bounds)" in found.sentence
    # Every reader has the same result, and can do with it what it does.
    view = read_study(changed.path, "s")
    assert view.result == found
    assert len(view.problem.space.validate(view.tuned.theta)) == 3
    assert not check_store(str(changed.path)).findings
    again, _ = changed()
    assert again[:6] == first
    assert of(again, TrialStatus.APART) == []


@pytest.mark.parametrize(
    ("tables", "line"),
    [
        ({"limits": {"voltage_max_V": 4.1}}, "limits.voltage_max_V: (not given) -> 4.1"),
        ({"limits": {"tolerance_V": 0.05}}, "limits.tolerance_V: 0.0005 -> 0.05"),
        ({"episode": {"soc_target": 0.8}}, "episode.soc_target: 1.0 -> 0.8"),
        ({"objective": {"charge_time_to_soc": 0.2}}, "objective.charge_time_to_soc: (absent) -> 0.2"),
        ({"objective": {"soc_windows": 7}}, "objective.soc_windows: 5 -> 7"),
    ],
)
def test_another_judgement_is_made_again_from_the_traces(changed, tables, line):
    first, _ = changed()
    trials, found = changed(**tables)
    assert {t.status for t in trials} == {TrialStatus.DONE}
    assert f"6 trials of before a change judged again from the traces ({line})" in found.sentence
    view = read_study(changed.path, "s")
    for trial, episode in view.episodes(trials):
        assert trial.score == score_episode(view.problem, episode)
        assert all(check.agrees for check in recheck(view.problem, episode, trial.score))
    back, result = changed()
    assert (back, result.note) == (first, "")


def test_a_lowered_limit_does_not_call_a_charge_kept_that_went_beyond_it(changed):
    first, before = changed()
    trials, found = changed(limits={"voltage_max_V": 4.1})
    best = trials[before.trial.number]
    assert before.trial.feasible
    assert not best.feasible
    excess = first[best.number].score.excess["voltage_max_V"]
    assert best.score.excess["voltage_max_V"] == pytest.approx(excess + 0.1)
    assert found.trial.number != best.number or found.reason is Reason.CLOSEST


@pytest.mark.parametrize(
    ("tables", "line"),
    [
        ({"controller": {"horizon": 6}}, "controller.horizon: 5 -> 6"),
        ({"controller": {"sampling_time_s": 20.0}}, "controller.sampling_time_s: 10.0 -> 20.0"),
        ({"sensors": {"voltage_noise_sd_V": 0.002}}, "sensors.voltage_noise_sd_V: 0.0 -> 0.002"),
        ({"episode": {"steps": 100}}, "episode.steps: 90 -> 100"),
        ({"limits": {"current_max_A": 3.0}}, "limits.current_max_A: (not given) -> 3.0"),
        ({"theta.backoff": {"at": "predicted"}}, 'theta.backoff.at: "measured" -> "predicted"'),
    ],
)
def test_trials_of_another_closed_loop_are_set_apart(changed, tables, line):
    first, _ = changed()
    trials, found = changed(**tables)
    assert of(trials, TrialStatus.APART) == list(range(6))
    assert (found.trial, found.reason) == (None, Reason.NONE)
    assert f"6 trials of before a change set apart (another closed loop: {line})" in found.sentence
    # Judged by other limits they stay what they are, and the loop of then brings them back.
    changed(**{**tables, "objective": {"soc_windows": 4}})
    assert changed()[0] == first


def test_the_study_goes_on_with_the_trials_that_count(changed):
    trials, found = changed(more=2, controller={"horizon": 6})
    assert [t.status for t in trials] == [TrialStatus.APART] * 6 + [TrialStatus.DONE] * 2
    # The tuner begins anew, with the untuned controller.
    assert trials[6].theta == trials[0].theta
    assert found.trial.number in (6, 7)


def test_what_only_chooses_thetas_changes_no_trial(changed):
    first, _ = changed()
    trials, found = changed(study={"name": "s", "tuner": "default"})
    assert (trials, found.note) == (first, "")


def test_other_entries_of_theta_are_another_study(changed):
    for tables in ({"theta.R1": {"lower": 0.5}}, {"theta.backoff": {"nodes": 4}}):
        with pytest.raises(StudyError, match="begin a study with another name"):
            changed(**tables)


def test_a_copy_keeps_what_is_set_apart(changed, tmp_path):
    trials, _ = changed(controller={"horizon": 6})
    salvage(changed.path, tmp_path / "copy.sqlite")
    with Store(tmp_path / "copy.sqlite") as store:
        assert store.trials(store.study("s").id) == trials
