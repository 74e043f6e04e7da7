"""The command in the process of the tests, which is quicker than a new one."""

import sys
from pathlib import Path

import pytest

from chargetune.cli import main

# So that the tests here find the module `commands`.
sys.path.insert(0, str(Path(__file__).parent))


@pytest.fixture
def chargetune_here(monkeypatch, capsys):
    """Run it: exit code, stdout, stderr."""

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["chargetune", *map(str, arguments)])
        try:
            main()
        except SystemExit as ended:
            code = ended.code or 0
        else:
            code = 0
        return code, *capsys.readouterr()

    return run


@pytest.fixture
def refused(chargetune_here):
    """Run what is to be refused with exit code 2: stderr."""

    def run(*arguments):
        code, _, err = chargetune_here(*arguments)
        assert code == 2
        return err

    return run
