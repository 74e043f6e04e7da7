"""The command in the process of the tests."""

import sys
from pathlib import Path

import pytest

# So that the tests here find the module `commands`.
sys.path.insert(0, str(Path(__file__).parent))


@pytest.fixture
def chargetune_here():
    """Run it: exit code, stdout, stderr."""
    from commands import run

    def three(*arguments):
        done = run(*arguments)
        return done.returncode, done.stdout, done.stderr

    return three


@pytest.fixture
def refused():
    """Run what is to be refused with exit code 2: stderr."""
    from commands import chargetune

    return lambda *arguments: chargetune(*arguments, code=2).stderr
