"""Interrupted is uninterrupted: what another process proposes from the store is what this one would have, bit for bit."""

import subprocess
import sys
from pathlib import Path

from toy_loop import SPACE as TOY
from toy_loop import Plant, ToyLoop

from chargetune.battery.cell.cell import default_cell
from chargetune.battery.charging.evaluate import Evaluation
from chargetune.battery.charging.soc_windows import ChargingWindows
from chargetune.battery.charging.tunables import ResistanceRatio
from chargetune.battery.charging.twin_loop import ChargingTwin
from chargetune.learning import Composite, ConstrainedLogEI, ExpectedImprovement, IterativeLearning, Safety, TwinTuner
from chargetune.learning.twin.settings import TwinSettings
from chargetune.study.store.store import Store
from chargetune.study.study import Study
from charging_problems import charging_problem

# 24 intervals near full, where the voltage limit is met.
PROBLEM = charging_problem(
    default_cell(), mismatch_seed=1, R0=ResistanceRatio(0.1, 4.0, scale=True), voltage_noise_sd_V=0.002,
    soc_start=0.7, steps=24, verdict_samples=3,
)  # fmt: skip
FEW = TwinSettings(plants=16, judges=32, rounds=3)


def filled(theta, seed):
    """A trial of the toy."""
    episode = Plant().episode(theta, seed)
    return ToyLoop().score(episode), episode, episode.ending.value


# By tuner the trials of the whole study, and how many there are when it is interrupted: enough that it has learnt.
TUNERS = {
    "twin": (lambda: TwinTuner(ToyLoop(), seed=2, settings=FEW), 4, 2),
    "safe": (lambda: TwinTuner(ToyLoop(), seed=2, safety=Safety(), settings=FEW), 4, 2),
    "default": (lambda: ConstrainedLogEI(seed=2, n_initial=2), 5, 4),
    "expected_improvement": (lambda: ExpectedImprovement(seed=2, n_initial=2), 5, 4),
    "composite": (lambda: Composite(ChargingWindows(PROBLEM), seed=2, n_initial=2), 6, 4),
    "iterative_learning": (lambda: IterativeLearning(ChargingTwin(PROBLEM)), 5, 2),
}


def go_on(path, name, count):
    """Run the study ``name`` up to ``count`` trials with a tuner of its own; its thetas and traces."""
    toy = name not in ("composite", "iterative_learning")
    with (
        Store(path) as store,
        Study.create_or_resume(store, name, config={}, space=TOY if toy else PROBLEM.space, tuner=TUNERS[name][0](), seed=5) as study,
    ):
        study.run(filled if toy else Evaluation(PROBLEM), count)
        return [(t.theta, t.trace_sha256) for t in study.trials()]


def test_a_study_that_was_interrupted_ends_as_one_that_was_not(tmp_path, monkeypatch):
    """Of every tuner, all in one other process: it takes longer to start than to learn."""
    monkeypatch.setenv("CHARGETUNE_CC", "none")
    uninterrupted = {name: go_on(tmp_path / "whole.db", name, whole) for name, (_, whole, _) in TUNERS.items()}
    for name, (_, _, part) in TUNERS.items():
        assert go_on(tmp_path / "part.db", name, part) == uninterrupted[name][:part]
    code = "import sys; sys.path[:0] = sys.argv[1:3]; from test_resume import *; [go_on(sys.argv[3], n, t[1]) for n, t in TUNERS.items()]"
    subprocess.run(
        [sys.executable, "-c", code, str(Path(__file__).parent), str(Path(__file__).parents[1]), str(tmp_path / "part.db")], check=True
    )
    for name, (_, whole, _) in TUNERS.items():
        assert go_on(tmp_path / "part.db", name, whole) == uninterrupted[name]
        # It learns: not all trials are one.
        assert len({theta for theta, _ in uninterrupted[name]}) > 1
