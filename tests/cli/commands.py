"""The command as a user runs it: in a process of its own."""

import subprocess
import sys


def chargetune(*arguments, cwd=None, code=0):
    done = subprocess.run([sys.executable, "-m", "chargetune", *map(str, arguments)], capture_output=True, text=True, cwd=cwd, check=False)
    assert done.returncode == code, done.stdout + done.stderr
    return done
