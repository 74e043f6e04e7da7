"""The toy problem must be importable by its name, here and in worker processes."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

from chargetune.study.store.store import Store


@pytest.fixture
def store(tmp_path):
    with Store(tmp_path / "s.db") as opened:
        yield opened


@pytest.fixture(params=["sqlite", "postgres"])
def location(request, tmp_path):
    """Where a store can be: what holds for one kind must hold for the other."""
    return str(tmp_path / "s.db") if request.param == "sqlite" else request.getfixturevalue("postgres")
