"""A trial evaluated again from its theta and seed: nothing differs, and what was changed is named."""

from dataclasses import replace

import pytest
from study_toy import Toy

from chargetune.study.evaluation import evaluate_trial
from chargetune.study.recompute import recompute
from chargetune.study.store.trace import decode
from chargetune.study.trial import Trial, TrialStatus

THETA, SEED = (0.4, 1.5), 11


@pytest.fixture
def stored():
    """A told trial and its trace."""
    outcome = evaluate_trial(Toy(), THETA, SEED)
    trial = Trial(number=0, theta=THETA, status=TrialStatus.DONE, score=outcome.score, ending=outcome.ending, seed=SEED)
    return trial, decode(outcome.trace)


def test_what_was_stored_comes_again(stored):
    assert recompute(Toy(), *stored) == []


def test_each_number_that_was_changed_is_named(stored):
    trial, (arrays, meta) = stored
    score = replace(trial.score, objective=trial.score.objective + 1e-3, metrics={**trial.score.metrics, "t80_min": 3.0})
    first, second = recompute(Toy(), replace(trial, score=score), (arrays, meta))
    assert (first.name, second.name) == ("objective", "metrics.t80_min")
    assert first.stated - first.recomputed == pytest.approx(1e-3)
    assert (second.stated, second.recomputed) == (3.0, None)
    # A trace is compared sample by sample; 4 V times 1e-6 is rounding.
    (found,) = recompute(Toy(), trial, ({**arrays, "voltage": arrays["voltage"] + 1e-4}, meta))
    assert (found.name, found.recomputed) == ("voltage", "up to 0.0001 off")
    (found,) = recompute(Toy(), trial, ({**arrays, "voltage": arrays["voltage"][:-1]}, meta))
    assert (found.name, found.stated, found.recomputed) == ("voltage", "shape (19,)", "shape (20,)")
    # Another seed is other noise, another theta another objective.
    assert {one.name for one in recompute(Toy(), replace(trial, seed=SEED + 1), (arrays, meta))} >= {"objective", "voltage"}
    assert {one.name for one in recompute(Toy(), replace(trial, theta=(0.5, 1.5)), (arrays, meta))} >= {"objective", "metrics.x_end"}


def test_how_a_solve_went_and_the_last_digits_are_no_difference(stored):
    trial, (arrays, meta) = stored
    rounded = {"voltage": arrays["voltage"] * (1 + 1e-8), "kkt": arrays["voltage"], "best.iterations": arrays["voltage"]}
    assert recompute(Toy(), trial, (rounded, meta)) == []


def test_an_evaluation_that_fails_now_differs_in_everything(stored):
    def broken(theta, seed):
        raise RuntimeError("the plant is gone")

    found = {one.name: one for one in recompute(broken, *stored)}
    assert found["ending"].recomputed == "RuntimeError: the plant is gone"
    assert found["objective"].recomputed is None
    assert found["voltage"].recomputed == "missing"


def test_a_trial_that_failed_fails_again():
    outcome = evaluate_trial(Toy(), (0.9, 1.0), SEED)
    failed = Trial(number=0, theta=(0.9, 1.0), status=TrialStatus.FAILED, ending=outcome.ending, seed=SEED)
    assert "gave up" in failed.ending
    assert recompute(Toy(), failed, None) == []
    (found,) = recompute(Toy(), replace(failed, theta=THETA), None)
    assert (found.name, found.recomputed) == ("ending", "done")


def test_a_trial_that_is_not_told_is_refused():
    with pytest.raises(ValueError, match="trial 3: status = running, allowed are done and failed"):
        recompute(Toy(), Trial(number=3, theta=THETA), None)


def test_a_store_of_an_earlier_version_holds_less(stored):
    trial, (arrays, meta) = stored
    assert recompute(Toy(), replace(trial, score=replace(trial.score, metrics={})), ({"voltage": arrays["voltage"]}, meta)) == []
    assert recompute(Toy(), trial, None) == []
