"""Settings for every test process."""

import os
from pathlib import Path

import pytest
from hypothesis import settings

# Before the first import of numpy or torch: each test process has one core, and more threads would only fight for it.
for library in ("OMP", "OPENBLAS", "MKL"):
    os.environ.setdefault(f"{library}_NUM_THREADS", "1")

# No deadline: the first call of an example may compile. Derandomised in CI: a run there depends on the commit alone.
settings.register_profile("here", deadline=None)
settings.register_profile("ci", deadline=None, derandomize=True)
settings.load_profile("ci" if os.environ.get("CI") else "here")


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of reference data beside the checkout; a test that needs it fails without it."""
    folder = Path(__file__).resolve().parents[2] / "shared"
    assert folder.is_dir(), f"{folder} is missing: the reference data belongs beside the checkout"
    return folder
