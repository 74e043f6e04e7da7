"""One store for each kind of outcome."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

from report_studies import charging, run_charging

from chargetune.report import save_figures


@pytest.fixture(scope="session")
def stores(tmp_path_factory):
    folder = tmp_path_factory.mktemp("stores")
    loose = charging(tolerance_V=0.035)
    return {
        "mixed": run_charging(folder / "mixed.sqlite", loose, cut=(3,), raising=(6,)),
        "violating": run_charging(folder / "violating.sqlite", charging(), reach=0.02),
        "ei": run_charging(folder / "ei.sqlite", charging("ei")),
        "failed": run_charging(folder / "failed.sqlite", loose, raising=range(10)),
    }


@pytest.fixture(scope="session")
def files(stores, tmp_path_factory):
    """All figures of one study in all formats, by file name."""
    folder = tmp_path_factory.mktemp("figures") / "new" / "folder"
    return {f.name: f for f in save_figures(stores["mixed"], "charge", folder, ("png", "pdf", "svg"))}
