"""What the tests of this folder share: the default cell, and a short charge with round numbers."""

import sys
from pathlib import Path

import numpy as np
import pytest

from chargetune.battery.cell.cell import default_cell
from chargetune.episode.episode import Ending, Episode

# The BPX cell of these tests is importable by name.
sys.path.insert(0, str(Path(__file__).parent))


@pytest.fixture(scope="session")
def cell():
    return default_cell()


@pytest.fixture
def by_hand():
    """Four intervals of 10 s; 4 A, then 3.97 A (more than 99 %), then 3.9 A, 2 A."""
    start = np.array([[4.200, 0.70], [4.220, 0.75], [4.100, 0.85], [4.195, 0.90]])
    end = np.array([[4.210, 0.75], [4.240, 0.85], [4.150, 0.90], [4.205, 0.98]])
    return Episode(
        sampling_time_s=10.0,
        input_names=("current_A",),
        output_names=("voltage_V", "soc"),
        input_units=("A",),
        output_units=("V", "1"),
        estimate_names=("soc", "overpotential_V"),
        time_s=10.0 * np.arange(4),
        input=np.array([[4.0], [3.97], [3.9], [2.0]]),
        output_start=start,
        output_end=end,
        estimate=np.zeros((4, 2)),
        status=np.array([0, 1, 0, 0]),
        kkt=np.zeros(4),
        iterations=np.ones(4, dtype=np.int64),
        ending=Ending.DONE,
    )
