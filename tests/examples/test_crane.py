"""The crane of the examples: both ways to tune it, on the true plant."""

import runpy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from chargetune.episode.episode import Ending, Trip
from chargetune.episode.stepwise import run_episode
from chargetune.study.evaluation import evaluate_trial

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.fixture
def example(monkeypatch, tmp_path):
    """What a script defines, run where it may write."""
    monkeypatch.syspath_prepend(str(EXAMPLES))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")

    return lambda name: runpy.run_path(str(EXAMPLES / f"{name}.py"))


@pytest.mark.parametrize("seed", range(2))
def test_no_trial_of_safe_mode_swings_too_far_and_it_gets_faster(example, tmp_path, seed):
    crane = example("safe_crane")
    (limit,) = crane["LIMITS"]
    # A quarter of the plants: the limit is the same, and the search has room for it.
    few = crane["ct"].TwinSettings(plants=16, judges=32, rounds=3)
    found = crane["tune"](3, seed, tmp_path / "crane.sqlite", few)
    assert len(found) == 3
    for _, episode, score in found:
        assert score.excess["angle"] <= limit.tolerance
        # The verdict by hand: noise-free samples of the plant, the first one at rest.
        assert np.abs(episode.state[:, 2]).max() <= limit.upper + limit.tolerance
    objectives = [score.objective for _, _, score in found]
    # 4.07 m s with the most cautious theta, 3.326 is what a grid of 4000 thetas that keep the limit reaches.
    assert max(objectives[1:]) > objectives[0] + 0.5


def test_the_script_keeps_its_store_and_draws(example, tmp_path, capsys):
    example("custom_system")["main"](2)
    assert (tmp_path / "crane.sqlite").stat().st_size > 0
    assert (tmp_path / "crane.pdf").read_bytes().startswith(b"%PDF")
    assert "untuned: done" in capsys.readouterr().out


def test_a_move_that_ends_early_is_a_failed_trial(example):
    """Half a move has half the distance integral."""
    crane = example("custom_system")
    controller, ct = crane["CONTROLLER"], crane["ct"]

    def evaluate(theta, seed):
        plant = ct.SimulatedPlant(crane["crane"](1.0), {})
        episode = run_episode(controller, plant, steps=30, theta=theta, seed=seed, trips=[Trip("position", upper=0.5)])
        return ct.score_limits(episode, crane["LIMITS"], objective=crane["closeness"])

    outcome = evaluate_trial(evaluate, tuple(crane["SPACE"].default), 0)
    assert outcome.score is None
    assert outcome.trace is not None
    assert outcome.ending.startswith("limit trip: position")


def test_a_move_that_the_user_interrupted_says_nothing_of_theta(example):
    """It stops the study, as Ctrl-C does, and its trial is run again."""
    crane = example("custom_system")

    def evaluate(theta, seed):
        _, episode, _ = crane["evaluate"](theta, seed)
        return crane["ct"].score_limits(replace(episode, ending=Ending.INTERRUPTED), crane["LIMITS"], objective=crane["closeness"])

    with pytest.raises(KeyboardInterrupt):
        evaluate_trial(evaluate, tuple(crane["SPACE"].default), 0)


def test_one_theta_keeps_every_crane_of_the_range(example, tmp_path):
    crane = example("range_crane")
    few = crane["ct"].RangeSettings(plants=12, pool=4, iterations=6)
    trials, best = crane["tune"](2, 60, tmp_path / "cranes.sqlite", few)
    assert best.score.metrics["violating_plants"] == 0
    assert best.score.metrics["plants"] == 60
    # The untuned controller believes in a rope that is too short for all of them.
    untuned, _, _ = crane["ct"].RangeEvaluation(crane["LOOP"], 60)(crane["SPACE"].default, 0)
    assert untuned.metrics["violating_plants"] > 30
    assert len(trials) == 2
