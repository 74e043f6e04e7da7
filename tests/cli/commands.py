"""The command as a user runs it: in a process of its own; and what it has stored so far."""

import subprocess
import sys

from chargetune.study.store import Store, StoreError


def chargetune(*arguments, cwd=None, code=0):
    done = subprocess.run([sys.executable, "-m", "chargetune", *map(str, arguments)], capture_output=True, text=True, cwd=cwd, check=False)
    assert done.returncode == code, done.stdout + done.stderr
    return done


def told(path):
    try:
        with Store(path, read_only=True) as store:
            return sum(t.status == "done" for r in store.studies() for t in store.trials(r.id))
    except StoreError:
        return 0
