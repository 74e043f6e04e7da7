"""A short run of benchmarks/store_kill.py: three writers, killed at random, on a file and on a server."""

import json
import subprocess
import sys
from pathlib import Path

SCRIPT = Path(__file__).parents[3] / "benchmarks" / "store_kill.py"
# Three of ten kills hit a running trial: with so many at least one does, but for one run in a thousand on a busy machine.
KILLS = 30


def test_three_writers_killed_at_random(location):
    done = subprocess.run(
        [sys.executable, str(SCRIPT), "--json", "--kills", str(KILLS), "--store", location, "--seed", "1"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    found = json.loads(done.stdout)
    assert found["broken"] == []
    assert found["kills"] == KILLS + 3  # at the end the three that are left
    assert found["acknowledged"] >= 10
    assert found["told"] >= found["acknowledged"]
    assert found["kills_with_a_running_trial"] >= 2  # the kills hit a study at work
    assert found["begun_again"] <= found["kills"]
