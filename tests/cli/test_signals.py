"""SIGINT and SIGTERM: the command stops in order, nothing counts as failed, and the same command resumes."""

import itertools
import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from commands import chargetune, told

from chargetune.battery.cell.cell import load_cell
from chargetune.battery.charging.evaluate import Evaluation
from chargetune.battery.charging.tunables import Backoff
from chargetune.battery.plants.electrochemical import Electrochemical
from chargetune.learning import Sobol
from chargetune.study.store.store import Store
from chargetune.study.study import Study
from charging_problems import charging_problem
from study_text import study_text

CONFIG = study_text(study={"name": "stopped", "trials": 100_000}, episode={"steps": 120})


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_command_stops_and_resumes(tmp_path, number):
    (tmp_path / "s.toml").write_text(CONFIG)
    command = [sys.executable, "-m", "chargetune", "tune", str(tmp_path / "s.toml"), "--store", str(tmp_path / "s.db")]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    try:
        until = time.monotonic() + 60
        while told(tmp_path / "s.db") < 3:
            assert process.poll() is None
            assert time.monotonic() < until
            time.sleep(0.05)
        process.send_signal(number)
        _, err = process.communicate(timeout=30)
    finally:
        # Whatever went wrong, it does not go on beside the tests that follow.
        process.kill()
    assert process.returncode == 130
    assert "trials that are told are kept; a second Ctrl-C ends at once" in err
    assert "interrupted; the same command resumes" in err
    with Store(tmp_path / "s.db") as store:
        trials = store.trials(1)
    assert {t.status for t in trials} <= {"done", "running"}
    again = chargetune(*command[3:], "--trials", len(trials) + 1, "--json")
    found = json.loads(again.stdout)
    assert (found["trials"], found["failed"]) == (len(trials) + 1, 0)


def test_a_campaign_with_workers_stops_in_the_midst_of_its_turns_and_resumes(tmp_path):
    (tmp_path / "s.toml").write_text(CONFIG)
    (tmp_path / "c.toml").write_text('[campaign]\nconfigs = ["s.toml"]\nseeds = "0:4"\ntrials = 100000\n')
    command = [sys.executable, "-m", "chargetune", "campaign", "c.toml", "--workers", "2", "--store", "s.db", "--json"]
    process = subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    try:
        until = time.monotonic() + 120
        while told(tmp_path / "s.db") < 3:
            assert process.poll() is None
            assert time.monotonic() < until
            time.sleep(0.05)
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=30)
    finally:
        process.kill()
    assert process.returncode == 130
    assert "interrupted; the same command resumes" in err
    assert "Traceback" not in err
    with Store(tmp_path / "s.db") as store:
        trials = [t for record in store.studies() for t in store.trials(record.id)]
    # Nothing that was told is lost, and nothing counts as failed.
    assert {t.status for t in trials} <= {"done", "running"}
    assert {t.losses for t in trials} == {0}


def catches(process, number):
    """Whether a process has a handler for a signal."""
    status = dict(line.split(":", 1) for line in Path(f"/proc/{process}/status").read_text().splitlines())
    return bool(int(status["SigCgt"], 16) >> (number - 1) & 1)


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="the system does not tell which signals a process handles")
def test_a_command_that_keeps_nothing_does_not_say_that_it_resumes(tmp_path):
    (tmp_path / "s.toml").write_text(CONFIG)
    command = [sys.executable, "-m", "chargetune", "check", "s.toml"]
    process = subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    try:
        until = time.monotonic() + 60
        while not catches(process.pid, signal.SIGTERM):
            assert process.poll() is None
            assert time.monotonic() < until
            time.sleep(0.02)
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=30)
    finally:
        process.kill()
    # Python ends itself by the signal where that came while a dataclass was made; a shell says 130 then, too.
    assert process.returncode in (130, -signal.SIGINT)
    assert "what runs is given up; a second Ctrl-C ends at once" in err
    assert "resumes" not in err


def test_an_episode_step_by_step_that_is_interrupted_is_no_failed_trial(tmp_path):
    okane = load_cell(Path(__file__).parents[2] / "examples" / "okane2022.toml")
    problem = charging_problem(okane, mismatch_seed=None, plant=Electrochemical(model="SPM"), backoff=Backoff(3), current_max_A=10.0)
    # The first one also builds the plant.
    for _ in range(2):
        began = time.monotonic()
        Evaluation(problem)(problem.space.default, 0)
    long, calls = time.monotonic() - began, itertools.count()
    timer = threading.Timer(long / 4, os.kill, (os.getpid(), signal.SIGINT))

    def evaluate(theta, seed):
        # From a time after the start of the study on, it might come between two episodes.
        if next(calls) == 2:
            timer.start()
        return Evaluation(problem)(theta, seed)

    with Store(tmp_path / "s.db") as store, Study.create_or_resume(store, "s", config={}, space=problem.space, tuner=Sobol()) as study:
        with pytest.raises(KeyboardInterrupt):
            study.run(evaluate, 40)
        timer.join()
        trials = study.trials()
        assert [t.status for t in trials] == ["done", "done", "running"]
        study.run(Evaluation(problem), len(trials))
        assert {t.status for t in study.trials()} == {"done"}
