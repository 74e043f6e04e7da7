"""The command as a user runs it, in the process of the tests, which is quicker than a new one; and what it has stored so far."""

import contextlib
import io
import os
import sys
from pathlib import Path
from types import SimpleNamespace
from unittest import mock

from chargetune.cli import main
from chargetune.study.store.store import Store, StoreError


def run(*arguments, cwd=None):
    """Its returncode, stdout and stderr."""
    out, err, code = io.StringIO(), io.StringIO(), 0
    with (
        mock.patch.object(sys, "argv", ["chargetune", *map(str, arguments)]),
        contextlib.chdir(cwd or Path.cwd()),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
    ):
        try:
            main()
        except SystemExit as ended:
            code = ended.code or 0
    return SimpleNamespace(returncode=code, stdout=out.getvalue(), stderr=err.getvalue())


def chargetune(*arguments, cwd=None, code=0):
    done = run(*arguments, cwd=cwd)
    assert done.returncode == code, done.stdout + done.stderr
    return done


def tuned(folder, text):
    """The content of the store of this study, run to its end, as tests of one module can share it: each writes its own copy."""
    (folder / "study.toml").write_text(text)
    # It has few charges, which are not worth a compilation; a fixture of a single test is of no use here.
    with mock.patch.dict(os.environ, CHARGETUNE_CC="none"):
        chargetune("tune", folder / "study.toml", "--store", folder / "s.sqlite")
    return (folder / "s.sqlite").read_bytes()


def told(path):
    try:
        with Store(path, read_only=True) as store:
            return sum(t.status == "done" for r in store.studies() for t in store.trials(r.id))
    except StoreError:
        return 0
