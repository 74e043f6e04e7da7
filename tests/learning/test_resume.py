"""Interrupted is uninterrupted: what another process proposes from the store is what this one would have, bit for bit."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from chargetune.battery.cell.cell import default_cell
from chargetune.battery.charging.evaluate import Evaluation, evaluate
from chargetune.battery.charging.soc_windows import ChargingWindows
from chargetune.battery.charging.tunables import ResistanceRatio
from chargetune.battery.charging.twin_loop import ChargingTwin
from chargetune.learning import Composite, IterativeLearning, Safety, TwinTuner
from chargetune.learning.twin.ensemble import condition
from chargetune.study.store.store import Store
from chargetune.study.study import Study
from charging_problems import charging_problem

# 24 intervals near full, where the voltage limit is met.
PROBLEM = charging_problem(
    default_cell(), mismatch_seed=1, R0=ResistanceRatio(0.1, 4.0, scale=True), voltage_noise_sd_V=0.002,
    soc_start=0.7, steps=24, verdict_samples=3,
)  # fmt: skip
# By tuner the trials of the whole study, and how many there are when it is interrupted: enough that it has learnt.
TUNERS = {
    "twin": (lambda: TwinTuner(ChargingTwin(PROBLEM), seed=2, pool=4, steps=2, iterations=3), 4, 2),
    "safe": (lambda: TwinTuner(ChargingTwin(PROBLEM), seed=2, safety=Safety()), 4, 2),
    "composite": (lambda: Composite(ChargingWindows(PROBLEM), seed=2, n_initial=2), 6, 4),
    "envelope": (lambda: IterativeLearning(ChargingTwin(PROBLEM)), 5, 2),
}


def go_on(path, name, count):
    """Run the study ``name`` up to ``count`` trials with a tuner of its own; its thetas and traces."""
    with (
        Store(path) as store,
        Study.create_or_resume(store, name, config={}, space=PROBLEM.space, tuner=TUNERS[name][0](), seed=5) as study,
    ):
        study.run(Evaluation(PROBLEM), count)
        return [(t.theta, t.trace_sha256) for t in study.trials()]


@pytest.mark.parametrize("name", TUNERS)
def test_a_study_that_was_interrupted_ends_as_one_that_was_not(name, tmp_path, monkeypatch):
    monkeypatch.setenv("CHARGETUNE_CC", "none")
    _, whole, part = TUNERS[name]
    uninterrupted = go_on(tmp_path / "whole.db", name, whole)
    assert go_on(tmp_path / "part.db", name, part) == uninterrupted[:part]
    code = f"import sys; sys.path[:0] = sys.argv[1:3]; from test_resume import go_on; go_on(sys.argv[3], {name!r}, {whole})"
    folders = [str(folder) for folder in Path(__file__).parents[:2]]
    subprocess.run([sys.executable, "-c", code, *folders, str(tmp_path / "part.db")], check=True)
    assert go_on(tmp_path / "part.db", name, whole) == uninterrupted
    # It learns: not all trials are one.
    assert len({theta for theta, _ in uninterrupted}) > 1


@pytest.mark.usefixtures("virtual_machine")
def test_what_a_twin_remembers_changes_nothing_that_it_says():
    """After more trials than it learns from, and after another study's have gone through the same twin."""
    trials = []
    for number, level in enumerate((4.0, 2.5, 2.0, 1.7, 1.6, 1.5)):
        score, episode, _ = evaluate(PROBLEM, np.array([level]), number)
        trials.append(Told(number, (level,), score, episode))
    used = ChargingTwin(PROBLEM)
    for n in (1, 2, 3, 4, 5, 6):
        condition(used, trials[:n])
    condition(used, trials[::-1])
    for known in (trials[:2], trials):
        remembered, fresh = (condition(loop, known) for loop in (used, ChargingTwin(PROBLEM)))
        np.testing.assert_array_equal(remembered.posterior.mode, fresh.posterior.mode)
        np.testing.assert_array_equal(remembered.posterior.root, fresh.posterior.root)
        assert (remembered.discrepancy.scale, remembered.standardised_error) == (fresh.discrepancy.scale, fresh.standardised_error)
        drawn, anew = (one.predict(np.array([1.55]), 4, 3).excess for one in (remembered, fresh))
        np.testing.assert_array_equal(drawn, anew)


class Told:
    """A trial that is told."""

    status = "done"

    def __init__(self, number, theta, score, episode):
        self.number, self.theta, self.score, self.episode = number, theta, score, lambda: episode
