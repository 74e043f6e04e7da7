"""A short run of benchmarks/learning.py and of its figures: the keys that it promises, and what must hold for any run."""

import json
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

from chargetune.learning.twin.settings import TwinSettings

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
FEW = TwinSettings(plants=16, judges=32, rounds=3)
KEYS = {
    "method", "plant", "study", "noise_mV", "trials", "solved", "of", "t95_ratio_median", "t95_ratio_worst",
    "violating_trials", "all_trials", "worst_excess_mV", "ask_s_median",
}  # fmt: skip


def run(script, *arguments):
    """As a user runs it."""
    return subprocess.run([sys.executable, BENCHMARKS / script, *map(str, arguments)], capture_output=True, text=True, check=False)


@pytest.fixture
def run_here(monkeypatch, capsys):
    """The same in this process, which has imported everything: what a script exits with and what it says on stderr."""

    def runs(script, *arguments):
        monkeypatch.setattr(sys, "argv", [script, *map(str, arguments)])
        code = None
        try:
            runpy.run_path(str(BENCHMARKS / script), run_name="__main__")
        except SystemExit as ended:
            code = ended.code
        return code, capsys.readouterr().err

    monkeypatch.syspath_prepend(BENCHMARKS)
    return runs


def test_a_short_run_and_its_figure(tmp_path, run_here):
    cache = tmp_path / "attainable.json"
    done = run(
        "learning.py",
        "--study",
        "r0",
        "--methods",
        "ilc,sobol",
        "--seeds",
        "1:2",
        "--trials",
        2,
        "--workers",
        1,
        "--json",
        "--cache",
        cache,
    )
    assert done.returncode == 0, done.stderr
    rows = json.loads(done.stdout)["rows"]
    assert len(rows) == 4
    assert all(set(row) >= KEYS for row in rows)
    # 36.7 min is what 4000 evaluations of CMA-ES reach on this plant.
    assert abs(json.loads(cache.read_text())["ecm r0 1"] - 36.7) < 0.2
    worst = {(row["method"], row["trials"]): row["worst_excess_mV"] for row in rows}
    assert [row["all_trials"] for row in rows] == [1, 2, 1, 2]
    # A learner that promises the limit keeps it; few plants are enough to see it.
    learnt = runpy.run_path(str(BENCHMARKS / "learning.py"))["run"]("ecm", "r0", 0.002, 2, ("safe", 1), FEW)
    assert max(learnt["excess_mV"]) < 1.0 < worst["sobol", 2]

    printed, figure = tmp_path / "rows.json", tmp_path / "learning.png"
    printed.write_text(done.stdout)
    assert run_here("learning_figures.py", printed, "--out", figure) == (None, "")
    assert figure.read_bytes().startswith(b"\x89PNG")
    printed.write_text("{}")
    said, _ = run_here("learning_figures.py", printed, "--out", figure)
    assert "rows.json: expected is what learning.py --json prints" in said
    said, _ = run_here("learning.py", "--methods", "guess")
    assert "unknown ['guess'], allowed are" in said


def test_every_part_that_is_taken_away_is_a_setting(run_here):
    parts = runpy.run_path(str(BENCHMARKS / "ablation.py"))["PARTS"]
    usual = TwinSettings()
    assert parts["nothing"] == {}
    for name, changes in parts.items():
        assert name == "nothing" or TwinSettings(**changes) != usual
    said, _ = run_here("ablation.py", "--methods", "guess")
    assert "unknown ['guess'], allowed are nothing, its scale" in said
