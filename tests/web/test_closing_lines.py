"""Where there is no browser, the closing lines of `make test` say so."""

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_tests_without_a_browser_are_named(tmp_path):
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-n", "0", "tests/web/test_browser_live.py", "-k", "going_away"]
    done = subprocess.run(
        command,
        cwd=ROOT,
        env={**os.environ, "PATH": str(tmp_path), "CHARGETUNE_CC": "none"},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    closing = done.stdout[done.stdout.index("1 tests did not run: no Chromium on this machine") :]
    assert "tests/web/test_browser_live.py::test_the_server_going_away_is_said_and_its_return_too" in closing
    assert "To run them: apt-get install --yes --no-install-recommends chromium && make test" in closing
