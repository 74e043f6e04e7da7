"""kill -9 during `tune` at random moments: the same command again ends as if nothing had happened."""

import json
import random
import signal
import subprocess
import sys
import time

from commands import told

KILLS = 20
CONFIG = """
[study]
name = "killed"
tuner = "sobol"
trials = 60
[controller]
mismatch_seed = 2
[episode]
steps = 120
[theta.backoff]
nodes = 3
lower_V = 0.0
upper_V = 0.2
"""


def command(config, store):
    return [sys.executable, "-m", "chargetune", "tune", str(config), "--store", str(store), "--json"]


def trials(config, store):
    done = subprocess.run(
        [sys.executable, "-m", "chargetune", "show", str(store), "--study", "killed", "--json"], capture_output=True, text=True, check=True
    )
    return json.loads(done.stdout)["trials"]


def test_twenty_kills_change_nothing(tmp_path):
    config = tmp_path / "killed.toml"
    config.write_text(CONFIG)
    whole = subprocess.run(command(config, tmp_path / "whole.sqlite"), capture_output=True, text=True, check=True)
    rng = random.Random(0)  # noqa: S311 - moments of a test, no secret
    kills = 0
    while kills < KILLS:
        before = told(tmp_path / "killed.sqlite")
        process = subprocess.Popen(command(config, tmp_path / "killed.sqlite"), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        if kills % 2:
            # While trials are written, however long starting took.
            while process.poll() is None and told(tmp_path / "killed.sqlite") == before:
                time.sleep(0.01)
            time.sleep(rng.uniform(0.0, 0.1))
        else:
            # While it starts, so that some kills meet the first writes.
            time.sleep(rng.uniform(0.3, 2.0))
        if process.poll() is not None:
            # It came to its end: go on with a fresh study.
            for file in tmp_path.glob("killed.sqlite*"):
                file.unlink()
            continue
        process.send_signal(signal.SIGKILL)
        process.wait()
        kills += 1
    again = subprocess.run(command(config, tmp_path / "killed.sqlite"), capture_output=True, text=True, check=True)
    assert json.loads(again.stdout) == json.loads(whole.stdout)
    assert trials(config, tmp_path / "killed.sqlite") == trials(config, tmp_path / "whole.sqlite")
