"""The one result of a study: what counts, that it is stored, and that none outlives the trials it was made from."""

from dataclasses import dataclass, replace

import pytest
from study_toy import Halfway, Toy, open_study

from chargetune.episode.score import Score
from chargetune.learning import ExpectedImprovement, Sobol
from chargetune.study.result import Reason, measured_result, read_result, with_belief
from chargetune.study.store.salvage import salvage
from chargetune.study.store.store import Store, StoreError
from chargetune.study.trial import Trial, TrialStatus


def done(number, objective, excess, *, performance=0.0, tolerance=0.01):
    return Trial(number, (), TrialStatus.DONE, Score(objective, performance, {"v": excess}, {"v": tolerance}))


def failed(number):
    return Trial(number, (), TrialStatus.FAILED, ending="the plant gave up")


def decided(trials, believed, **settings):
    found = with_belief(trials, lambda: next((t for t in trials if t.number == believed), None), by_performance=False, **settings)
    assert found.asked
    return (None if found.trial is None else found.trial.number), found.reason


def test_what_was_measured():
    trials = [failed(0), done(1, 1.0, 0.01), done(2, 1.0, -0.5), done(3, 9.0, 0.02, performance=6.0), Trial(4, ())]
    assert measured_result(trials).trial.number == 1
    assert measured_result(trials).reason is Reason.MEASURED
    assert measured_result(trials, by_performance=True).trial.number == 3
    assert measured_result(trials, by_performance=True).kept is None
    assert measured_result([trials[0], trials[4]]).facts() == {
        "trial": None, "reason": "none", "asked": True, "sentence": "no trial has a score",
    }  # fmt: skip


def test_the_closest_is_so_in_tolerances():
    """1 mV over and 0.1 K over is closer than 0.5 V over with 1 K to spare."""

    def two(number, volts, kelvins):
        return Trial(number, (), TrialStatus.DONE, Score(0.0, 0.0, {"V": volts, "K": kelvins}, {"V": 0.0005, "K": 0.5}))

    found = measured_result([two(0, 0.45, -1.0), two(1, 0.0015, 0.6)])
    assert (found.trial.number, found.reason, found.kept) == (1, Reason.CLOSEST, None)


def test_a_belief_counts_where_noise_may_have_passed_the_best():
    # Trial 1 is measured best and rides its limit, so that noise may have let it pass; the tuner believes so.
    trials = [done(0, 1.0, -0.5), done(1, 4.0, 0.005), done(2, 3.0, -0.005), done(3, 9.0, 0.5), failed(4)]
    assert decided(trials, 2) == (2, Reason.BELIEVED)
    assert decided(trials, None) == (1, Reason.MEASURED)
    # Measured to break a limit by more than its noise: no result, whatever is believed.
    assert decided(trials, 3) == (1, Reason.MEASURED)
    assert decided(trials, 4) == (1, Reason.MEASURED)


def test_a_belief_does_not_overrule_what_was_measured_beyond_doubt():
    # A cost of 4.38 that was measured to keep the limit by more than noise explains, and one of 8.58 that a twin believes best.
    assert decided([done(0, -8.58, -0.5), done(1, -4.38, -0.02)], 0) == (1, Reason.MEASURED)
    # Better still is one that rides its limit, which the tuner does not believe in; there it may be right.
    assert decided([done(0, -8.58, -0.5), done(1, -4.38, -0.02), done(2, -4.0, 0.005)], 0) == (1, Reason.CLEAR)
    assert decided([done(0, -8.58, -0.5), done(1, -4.38, -0.02), done(2, -4.0, 0.005)], 1) == (1, Reason.BELIEVED)


def test_of_trials_under_conditions_of_their_own_the_newest_that_kept_its_limits_is_the_result():
    # Trial 0 began nearly full: its time is the shortest, and no merit of its theta.
    trials = [done(0, 9.0, -0.5), done(1, 1.0, -0.5), done(2, 2.0, -0.02), done(3, 3.0, 0.5), failed(4)]
    assert decided(trials, 0, newest=True) == (2, Reason.NEWEST)
    assert decided(trials, 3, newest=True) == (2, Reason.NEWEST)
    assert decided(trials[:3], 2, newest=True) == (2, Reason.BELIEVED)
    assert decided([done(0, 9.0, 0.5), done(1, 1.0, 0.2)], 1, newest=True) == (1, Reason.CLOSEST)
    assert decided(trials, 2) == (0, Reason.MEASURED)


@dataclass(frozen=True)
class Believes(Halfway):
    """Believes best the trial of this place among those it is shown, earlier studies' first; counts how often it is asked."""

    place: int = 0

    def best(self, space, trials):
        assert all(t.status is not TrialStatus.RUNNING for t in trials)
        assert all(t.episode is not None for t in trials if t.trace_sha256 is not None)
        ASKED.append(len(trials))
        return self.place


ASKED = []


@dataclass(frozen=True)
class Noisy:
    """The toy with a tolerance so wide that each trial that kept the limit may have done so by noise."""

    def __call__(self, theta, seed):
        score, episode, ending = Toy()(theta, seed)
        return replace(score, tolerance={"v": 2.0}), episode, ending


@pytest.fixture
def store(tmp_path):
    with Store(tmp_path / "s.db") as opened:
        yield opened


def test_it_is_stored_and_the_tuner_is_asked_once(store):
    ASKED.clear()
    with open_study(store, tuner=Believes(3, place=2)) as study:
        best = study.run(Noisy(), 6)
        assert (best.number, study.best().number != 2) == (2, True)
        for _ in range(3):
            assert study.result().trial.number == 2
            assert study.run(Noisy(), 6).number == 2
    assert ASKED == [6]
    with Store(store.location, read_only=True) as other:
        found = read_result(other, other.study("toy"))
        assert (found.trial.number, found.reason, found.asked) == (2, Reason.BELIEVED, True)
        # Of fewer trials it is not known.
        part = read_result(other, other.study("toy"), other.trials(1)[:5])
        assert (part.reason, part.asked) == (Reason.MEASURED, False)


def test_none_outlives_its_trials(store):
    with open_study(store, tuner=Believes(3, place=2)) as study:
        study.run(Noisy(), 6)
        (trial,) = study.ask()
        # A trial that runs has shown nothing yet.
        assert read_result(store, study.record).trial.number == 2
        study.tell(trial.number, Score(9.0, 9.0, {"v": -3.0}, {"v": 2.0}))
        stale = read_result(store, study.record)
        assert (stale.trial.number, stale.asked) == (6, False)
        assert (study.result().trial.number, study.result().asked) == (6, True), "kept beyond doubt, and better"
        assert read_result(store, study.record).asked
    with open_study(store, tuner=Believes(3, place=1), accept_changed=True) as study:
        assert not read_result(store, study.record).asked, "another tuner has not been asked"


def test_one_of_an_earlier_study_is_no_result(store, tmp_path):
    with open_study(store) as study:
        study.run(Noisy(), 6)
        earlier = tuple(study.trials())
    for place, reason in ((2, Reason.MEASURED), (8, Reason.BELIEVED)):
        with Store(tmp_path / f"{place}.db") as other, open_study(other) as later:
            later.advance(Noisy(), 6)
            found = replace(later, tuner=Believes(3, place=place), earlier=earlier).result()
            assert found.reason is reason
            if reason is Reason.BELIEVED:
                assert found.trial.number == 2


def test_an_interruption_asks_nobody_and_the_next_call_does(store):
    ASKED.clear()

    def interrupted(theta, seed):
        if len(store.trials(1)) == 4:
            raise KeyboardInterrupt
        return Noisy()(theta, seed)

    with open_study(store, tuner=Believes(3, place=2)) as study:
        with pytest.raises(KeyboardInterrupt):
            study.run(interrupted, 6)
        assert ASKED == []
        assert not read_result(store, study.record).asked
        study.run(Noisy(), 6)
    assert ASKED == [6]


def test_the_papers_method_has_the_best_performance(store):
    for name, tuner, reason in (("ei", ExpectedImprovement(seed=1), Reason.PERFORMANCE), ("sobol", Sobol(seed=1), Reason.MEASURED)):
        with open_study(store, name, tuner=tuner) as study:
            study.run(Toy(), 3)
            assert study.result().reason is reason
            if reason is Reason.PERFORMANCE:
                assert study.result().trial == study.best_performance()


def test_a_salvaged_store_has_it_too_and_none_where_its_trial_is_lost(store, tmp_path):
    with open_study(store, tuner=Believes(3, place=2)) as study:
        study.run(Noisy(), 6)
    salvage(store.location, tmp_path / "copy.db")
    with Store(tmp_path / "copy.db", read_only=True) as copy:
        assert read_result(copy, copy.study("toy")).facts() == read_result(store, store.study("toy")).facts()


def test_whoever_lost_the_study_writes_no_result(store):
    with open_study(store, tuner=Believes(3, place=2)) as study:
        study.advance(Noisy(), 3)
        store.note_holder(1, 1, "elsewhere")
        with pytest.raises(StoreError, match="taken over"):
            study.result()
