import itertools
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
import pytest
from study_toy import CONFIG, SEED, SPACE, Halfway, Toy, ToyEpisode, essence, misspelt, open_study, refused

from chargetune.episode.score import Score
from chargetune.model.parameter_space import Parameter, ParameterSpace
from chargetune.plants.plant import SetUpError
from chargetune.study.evaluation import trial_seed
from chargetune.study.store.store import Store, StoreError
from chargetune.study.study import SAME_FAILURES, StudyError
from chargetune.study.trial import Trial, TrialStatus, best_feasible, best_performance

GOOD = Score(1.0, 1.0, {"v": -0.1}, {"v": 0.0})


@dataclass(frozen=True)
class Fixed:
    """Proposes what it was given."""

    thetas: tuple

    def ask(self, space, trials, n=1):
        return np.array(self.thetas)


@dataclass(frozen=True)
class Sees:
    """A tuner whose proposals depend on which trials are running."""

    tuner: Halfway

    def ask(self, space, trials, n=1):
        shift = 1e-3 * sum(t.number + 1 for t in trials if t.status == "running")
        return np.clip(self.tuner.ask(space, trials, n) - [[shift, 0.0]], [[0.0, 0.1]], None)


def uninterrupted(tmp_path, trials=24, **changes):
    with Store(tmp_path / "whole.db") as store, open_study(store, **changes) as study:
        study.run(Toy(), trials)
        return essence(study.trials())


def test_the_toy_is_worth_testing_with(tmp_path):
    found = uninterrupted(tmp_path)
    assert [e[0] for e in found] == list(range(24))
    assert {e[2] for e in found} == {"done", "failed"}
    assert {e[3].feasible for e in found if e[3]} == {True, False}
    assert any(e[4].startswith("RuntimeError: the plant gave up at x = 0.") for e in found if e[2] == "failed")
    assert len({e[5] for e in found}) == 24


def test_same_seed_same_trials_other_seed_other_trials(store, tmp_path):
    with open_study(store) as study:
        study.run(Toy(), 24)
        assert essence(study.trials()) == uninterrupted(tmp_path)
    for name, change in {"b": {"seed": 12}, "c": {"tuner": Halfway(4)}}.items():
        with open_study(store, name, **change) as study:
            study.run(Toy(), 24)
            assert essence(study.trials()) != uninterrupted(tmp_path)


@pytest.mark.parametrize("batch", [1, 3, 4])
def test_ask_and_tell_by_hand_is_run(store, tmp_path, batch):
    with open_study(store, batch=batch) as study:
        while len(study.trials()) < 24:
            for trial in reversed(study.ask(batch)):
                assert study.running()
                try:
                    score, episode, ending = Toy()(np.array(trial.theta), trial.seed)
                except RuntimeError as error:
                    study.fail(trial.number, f"RuntimeError: {error}")
                else:
                    study.tell(trial.number, score, episode, ending=ending)
        assert not study.running()
        assert essence(study.trials()) == uninterrupted(tmp_path, batch=batch)


@pytest.mark.parametrize("workers", [1, 2, 5])
@pytest.mark.parametrize("batch", [1, 4])
def test_workers_and_order_of_finishing_do_not_matter(store, tmp_path, batch, workers):
    def late_first(theta, seed):
        threading.Event().wait(0.004 * (seed % 4))
        return Toy()(theta, seed)

    with open_study(store, batch=batch) as study, ThreadPoolExecutor(workers) as pool:
        study.run(late_first, 12, executor=pool)
        assert essence(study.trials()) == uninterrupted(tmp_path, 12, batch=batch)


def test_one_worker_gives_the_trials_of_batches_of_one(store, tmp_path):
    with open_study(store) as study, ThreadPoolExecutor(1) as pool:
        study.run(Toy(), 12, executor=pool, workers=1)
        assert essence(study.trials()) == uninterrupted(tmp_path, 12)
        assert all(t.provenance["pending"] == [] for t in study.trials())


def test_each_trial_says_from_what_it_was_proposed(store, tmp_path):
    def learnt(study):
        return [t.provenance["learnt_sha256"] for t in study.trials()]

    with open_study(store, batch=2) as study:
        study.run(Toy(), 6)
        found = learnt(study)
    assert found[::2] == found[1::2]
    assert len(set(found)) == 3
    with Store(tmp_path / "again.db") as other, open_study(other, batch=2) as study:
        study.run(Toy(), 3)
        study.run(Toy(), 6)
        assert learnt(study) == found
    with Store(tmp_path / "other.db") as other, open_study(other, batch=2) as study:
        (first, _) = study.ask(2)
        study.fail(first.number, "the sensor")
        study.run(Toy(), 4)
        assert learnt(study)[0] == found[0]
        assert learnt(study)[2] != found[2]


def test_a_free_worker_is_given_a_new_theta_at_once(store):
    """Trial 0 ends when trial 5 has begun: with batches that would wait for ever."""
    sixth = threading.Event()

    def evaluate(theta, seed):
        if seed == trial_seed(SEED, 5):
            sixth.set()
        if seed == trial_seed(SEED, 0):
            assert sixth.wait(30)
        return Toy()(theta, seed)

    with open_study(store) as study, ThreadPoolExecutor(3) as pool:
        told = []
        study.run(evaluate, 9, executor=pool, workers=3, progress=lambda trial, *_: told.append(trial.number))
        trials = study.trials()
    assert sorted(told) == list(range(9))
    assert told.index(0) >= 3
    assert [t.provenance["pending"] for t in trials[:2]] == [[], [0]]
    assert all(0 in t.provenance["pending"] for t in trials[1:6])
    assert all(len(t.provenance["pending"]) <= 2 for t in trials)


def test_a_theta_proposed_beside_pending_trials_can_be_found_again_from_the_record(store):
    begun, three = itertools.count(), threading.Barrier(3)

    def evaluate(theta, seed):
        if next(begun) < 3:
            # However slow the machine, the third is proposed while two are running.
            three.wait(timeout=60)
        threading.Event().wait(0.004 * (seed % 4))
        return Toy()(theta, seed)

    with open_study(store, tuner=Sees(Halfway(3))) as study, ThreadPoolExecutor(3) as pool:
        study.run(evaluate, 14, executor=pool, workers=3)
        trials = study.trials()
        assert any(len(t.provenance["pending"]) == 2 for t in trials)
        for t in trials:
            pending = t.provenance["pending"]
            asked = [replace(b, status="running", score=None) if b.number in pending else b for b in trials[: t.number]]
            np.testing.assert_array_equal(study.tuner.ask(SPACE, asked, 1), [t.theta])


@pytest.mark.parametrize("workers", [1, 3])
def test_ctrl_c_among_workers_and_going_on(store, workers):
    calls = itertools.count(1)

    def interrupted(theta, seed):
        if next(calls) in {4, 11}:
            raise KeyboardInterrupt
        return Toy()(theta, seed)

    for _ in range(2):
        with open_study(store) as study, ThreadPoolExecutor(workers) as pool:
            with pytest.raises(KeyboardInterrupt):
                study.run(interrupted, 24, executor=pool, workers=workers)
            assert 1 <= len(study.running()) <= workers
    with open_study(store) as study:
        study.run(Toy(), 24)
        trials = study.trials()
    assert [t.number for t in trials] == list(range(24))
    assert not any(t.status == "running" or t.losses > 0 for t in trials)


@pytest.mark.parametrize("change", [{"workers": 0}, {"workers": True}, {"workers": 1.0}, {"attempts": 0}, {"attempts": None}])
def test_bad_workers_and_attempts(store, change):
    ((name, value),) = change.items()
    with open_study(store) as study, pytest.raises(ValueError, match=f"{name} = {value}, allowed is an integer >= 1"):
        study.run(Toy(), 3, **change)


def test_stopping_within_a_batch_and_going_on_is_one_study(store, tmp_path):
    for trials in (1, 6, 7, 7, 13, 24):
        with open_study(store, batch=4) as study:
            study.run(Toy(), trials)
            assert len(study.trials()) == trials
    assert essence(store.trials(1)) == uninterrupted(tmp_path, batch=4)


@pytest.mark.parametrize("batch", [1, 4])
@pytest.mark.parametrize("workers", [None, 2])
def test_ctrl_c_stops_and_the_same_call_resumes(store, tmp_path, batch, workers):
    calls = itertools.count(1)

    def interrupted(theta, seed):
        if next(calls) in {3, 9, 10}:
            raise KeyboardInterrupt
        return Toy()(theta, seed)

    stops = 0
    with ThreadPoolExecutor(workers or 1) as pool:
        for _ in range(4):
            with open_study(store, batch=batch) as study:
                try:
                    study.run(interrupted, 24, executor=pool if workers else None)
                except KeyboardInterrupt:
                    stops += 1
                    assert len(study.trials()) < 24
                    assert 1 <= len(study.running()) <= batch
    assert 2 <= stops <= 3
    assert essence(store.trials(1)) == uninterrupted(tmp_path, batch=batch)


def test_progress_sees_incumbent_violations_and_failures(store):
    seen = []
    with open_study(store) as study:
        study.run(Toy(), 9)
        best = study.run(Toy(), 24, progress=lambda *args: seen.append(args))
        trials = study.trials()
        assert best == study.best() == seen[-1][1]
    assert [args[0] for args in seen] == trials[9:]
    for trial, incumbent, violating, failures in seen:
        so_far = trials[: trial.number + 1]
        assert incumbent == best_feasible(so_far)
        assert violating == sum(t.status == "done" and not t.feasible for t in so_far)
        assert failures == sum(t.status == "failed" for t in so_far)
    assert seen[-1][2] > 0
    assert seen[-1][3] > 0


def test_best_takes_the_feasible_one_and_the_earlier_of_equals():
    def done(number, objective, performance, excess):
        return Trial(number, (), TrialStatus.DONE, Score(objective, performance, {"v": excess}, {"v": 0.01}))

    trials = [Trial(0, ()), Trial(1, (), TrialStatus.FAILED), done(2, 1, 5, 0.01), done(3, 1, 6, 0), done(4, 9, 6, 0.02)]
    assert best_feasible(trials).number == 2
    assert best_performance(trials).number == 3
    assert best_feasible(reversed(trials)).number == 2
    assert best_feasible([trials[4]]) is None
    assert best_performance(trials[:2]) is None


@pytest.mark.parametrize(
    ("result", "reason"),
    [
        ((Score(float("nan"), 0.0, {}, {}), None, "done"), r"ValueError: score\.objective = nan"),
        ((Score(0.0, 0.0, {"v": float("inf")}, {}), None, "done"), r"ValueError: score\.excess\[v\] = inf"),
        ((None, ToyEpisode(np.ones(3)), "sensor: voltage is nan"), "sensor: voltage is nan"),
        ((GOOD, None, None), "ValueError: ending = None"),
        ((GOOD, None), "ValueError: not enough values"),
        ((1.0, None, "done"), "ValueError: score = 1.0"),
    ],
)
def test_what_evaluate_gives_wrong_is_a_failed_trial_without_numbers(store, result, reason):
    with open_study(store) as study:
        assert study.run(lambda *_: result, 2) is None
        trials = study.trials()
    assert [t.status for t in trials] == ["failed"] * 2
    assert all(t.score is None and t.ending.startswith(reason.replace("\\", "")) for t in trials)
    has_trace = isinstance(result, tuple) and isinstance(result[1], ToyEpisode)
    assert [t.trace_sha256 is not None for t in trials] == [has_trace] * 2


def test_tell_and_fail_are_idempotent_and_refuse_nonsense(store):
    with open_study(store) as study:
        a, b = study.ask(2)
        episode = ToyEpisode(np.array([4.0, np.nan]))
        told = study.tell(a.number, GOOD, episode)
        assert study.tell(a.number, GOOD, ToyEpisode(episode.voltage.copy())) == told
        with pytest.raises(StoreError, match="another result"):
            study.fail(a.number, "no")
        for objective in (None, float("nan"), float("inf"), "1"):
            with pytest.raises(ValueError, match=r"score\.objective = .* a finite number"):
                study.tell(b.number, replace(GOOD, objective=objective))
        with pytest.raises(ValueError, match="ending = ''"):
            study.fail(b.number, "")
        with pytest.raises(StoreError, match="no trial 2"):
            study.tell(2, GOOD)
        assert study.running() == [b]
        assert study.fail(b.number, "gone") == study.fail(b.number, "gone")
        np.testing.assert_array_equal(study.trace(a.number)[0]["voltage"], episode.voltage)
        assert study.best() == study.best_performance() == told


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"config": {"plant": {"noise": 2e-3, "steps": 20}, "name": "toy"}}, r"config\.plant\.noise: 0\.001 -> 0\.002"),
        ({"config": {"plant": {"noise": 1e-3}, "name": "toy"}}, r"config\.plant\.steps: 20 -> \(absent\)"),
        ({"tuner": Halfway(4)}, r"tuner\.seed: 3 -> 4"),
        ({"seed": 12}, r"seed: 11 -> 12"),
        ({"batch": 2}, r"batch: 1 -> 2"),
        ({"space": ParameterSpace((replace(SPACE.parameters[0], upper=0.9), SPACE.parameters[1]))}, r"space\[0\]\.upper: 1\.0 -> 0\.9"),
    ],
)
def test_resume_with_something_changed(store, change, line):
    with open_study(store) as study:
        study.run(Toy(), 3)
        before = essence(study.trials())
    with pytest.raises(StudyError, match=line):
        open_study(store, **change)
    with open_study(store) as study:
        assert essence(study.trials()) == before
    with open_study(store, **change, accept_changed=True) as study:
        study.run(Toy(), 4)
        trials = study.trials()
    assert essence(trials)[:3] == before
    assert trials[3].provenance["study_sha256"] != trials[2].provenance["study_sha256"]
    with open_study(store, **change) as study:
        assert len(study.trials()) == 4


def test_other_parameters_are_never_accepted(store):
    open_study(store).close()
    for parameters in ((SPACE.parameters[1], SPACE.parameters[0]), (SPACE.parameters[0],), (replace(SPACE.parameters[0], unit="V"),)):
        with pytest.raises(StudyError, match="tunes other parameters"):
            open_study(store, space=ParameterSpace(parameters), accept_changed=True)


def test_what_is_not_in_the_identity_may_change(store):
    open_study(store, config={"steps": 1, "nodes": (1, 2)}).close()
    open_study(store, config={"nodes": [1.0, np.float64(2)], "steps": 1}).close()


@pytest.mark.parametrize("name", ["", " a", "a ", "../a", "a/b", "a\\b", "<b>a</b>", "a\nb", "_a", "-a", "a" * 101, 'a"b', "a&b", "a\0"])
def test_bad_names(store, name):
    with pytest.raises(ValueError, match="study name = "):
        open_study(store, name)
    assert store.studies() == []


@pytest.mark.parametrize("name", ["a", "both, seed 3", "2026-01-02 R1 (model)", "Zelle Größe @25", "a" * 100])
def test_good_names(store, name):
    with open_study(store, name):
        assert store.study(name).name == name


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"seed": -1}, "seed = -1, allowed is an integer >= 0"),
        ({"seed": True}, "seed = True"),
        ({"batch": 0}, "batch = 0, allowed is an integer >= 1"),
        ({"batch": 1.5}, "batch = 1.5"),
        ({"space": ParameterSpace(())}, "no parameters"),
        ({"config": {"a": {"b": float("nan")}}}, r"study\.config\.a\.b = nan"),
        ({"config": {"a": object()}}, r"study\.config\.a is a object"),
    ],
)
def test_bad_arguments_are_refused_before_anything_is_stored(store, change, message):
    with pytest.raises(ValueError, match=message):
        open_study(store, **change)
    assert store.studies() == []


@pytest.mark.parametrize("n", [0, -1, True, 1.0])
def test_bad_counts(store, n):
    with open_study(store) as study:
        with pytest.raises(ValueError, match=f"n = {n}"):
            study.ask(n)
        with pytest.raises(ValueError, match=f"trials = {n}"):
            study.run(Toy(), n)


@pytest.mark.parametrize(
    ("thetas", "error"),
    [
        (((0.5, 7.0),), r"theta: r = 7, allowed is \[0.1, 6\]"),
        (((0.5, np.nan),), "theta: r = nan"),
        (((0.5,),), r"shape \(1, 1\), expected \(1, 2\)"),
        (((0.5, 1.0), (0.5, 1.0)), r"shape \(2, 2\), expected \(1, 2\)"),
    ],
)
def test_bad_proposals_never_become_trials(store, thetas, error):
    with open_study(store, tuner=Fixed(thetas)) as study:
        with pytest.raises((ValueError, StudyError), match=error):
            study.run(Toy(), 1)
        assert study.trials() == []


def test_seeds_are_independent_and_fit_into_json():
    seeds = [trial_seed(study, number) for study in range(30) for number in range(100)]
    assert len(set(seeds)) == 3000
    assert all(0 <= s < 2**53 for s in seeds)
    assert abs(np.mean(seeds) / 2**53 - 0.5) < 0.03
    assert trial_seed(0, 0) == 4232842298785526  # pinned: a new version must repeat old studies


def test_ask_with_pending_trials(store):
    with open_study(store, batch=2) as study:
        first = study.ask(3)
        assert [t.number for t in first] == [0, 1, 2]
        assert study.running() == study.trials() == first
        with pytest.raises(StudyError, match=r"the trials \[0, 1\] are not told"):
            study.ask_batch(10)
        study.tell(0, GOOD)
        assert [t.number for t in study.ask()] == [3]


def test_config_of_the_toy_is_stored(store):
    with open_study(store) as study:
        study.run(Toy(), 1)
        (trial,) = study.trials()
        assert study.record.identity["config"] == CONFIG
        assert trial.provenance["study_sha256"] == study.record.identity_sha256
        assert trial.provenance["versions"]["numpy"] == np.__version__
        assert Parameter(**{**study.record.identity["space"][1], "default": (1.0,)}) == SPACE.parameters[1]


@pytest.mark.parametrize("workers", [None, 2])
@pytest.mark.parametrize(("evaluate", "reason"), [(misspelt, "NameError: name 'undefined_name' is not defined"), (refused, "plant: par")])
def test_an_error_that_no_theta_could_avoid_ends_the_study_and_burns_no_trial(store, evaluate, reason, workers):
    with open_study(store) as study:
        with pytest.raises(SetUpError) as caught:
            study.run(evaluate, 6, workers=workers)
        assert str(caught.value).startswith(reason)
        assert evaluate.__name__ in caught.value.details, "the traceback names the line"
        assert all(t.status == "running" for t in study.trials())
        # Mended, the same call goes on from there.
        study.run(Toy(), 4, workers=workers)
        assert [t.number for t in study.trials() if t.status != "running"] == [0, 1, 2, 3]


@pytest.mark.parametrize("result", [None, (GOOD, "text", "done")])
def test_what_can_never_be_an_outcome_ends_the_study(store, result):
    with open_study(store) as study, pytest.raises(SetUpError, match=r"TypeError|AttributeError"):
        study.run(lambda *_: result, 2)


def test_the_same_failure_from_the_first_trial_on_ends_the_study(store):
    with open_study(store) as study:
        with pytest.raises(StudyError, match=r"each of the first 3 trials failed for the same reason.*the pump is dry"):
            study.run(lambda *_: (None, None, "the pump is dry"), 9)
        assert [t.status for t in study.trials()] == ["failed"] * SAME_FAILURES
        # Asked again it goes on: somebody may know better.
        study.run(Toy(), 5)
        assert len(study.trials()) == 5


def test_trials_that_ended_at_a_limit_or_for_different_reasons_do_not(store):
    reasons = iter(["a", "b", "b", "b"])
    with open_study(store) as study:
        study.run(lambda *_: (None, None, next(reasons)), 4)
    with open_study(store, "limits") as study:
        study.run(lambda *_: (None, None, "limit trip: level above 1"), 4)
        assert len(study.trials()) == 4
