import re
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest

import chargetune

ROOT = Path(__file__).parents[1]
HEAVY = {"botorch", "casadi", "gpytorch", "matplotlib", "pandas", "scipy", "sqlalchemy", "torch"}


def test_version_is_the_installed_one():
    assert chargetune.__version__ == version("chargetune")


def test_citation_names_this_version():
    cited = re.search(r"^version: (\S+)$", (ROOT / "CITATION.cff").read_text(encoding="utf-8"), flags=re.MULTILINE)
    assert cited is not None
    assert cited.group(1) == chargetune.__version__


@pytest.mark.parametrize("module", ["chargetune", "chargetune.cli"])
def test_import_is_light(module):
    code = f"import sys, {module}; print(*sorted({{name.partition('.')[0] for name in sys.modules}}))"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    loaded = set(run.stdout.split())
    assert "chargetune" in loaded
    assert not loaded & HEAVY


def test_lock_is_exact_and_free_of_addresses():
    lines = (ROOT / "requirements.lock").read_text(encoding="utf-8").splitlines()
    pins = [line for line in lines if not line.startswith("#")]
    loose = [pin for pin in pins if not re.fullmatch(r"[A-Za-z0-9._-]+==[0-9][0-9a-z.]*", pin)]
    assert len(pins) > 30
    assert not loose
