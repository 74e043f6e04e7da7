"""A short run of benchmarks/learning.py and of its figures: the keys that it promises, and what must hold for any run."""

import json
import subprocess
import sys
from pathlib import Path

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
KEYS = {
    "method", "plant", "study", "noise_mV", "trials", "solved", "of", "t95_ratio_median", "t95_ratio_worst",
    "violating_trials", "all_trials", "worst_excess_mV", "ask_s_median",
}  # fmt: skip


def run(*arguments):
    return subprocess.run([sys.executable, *map(str, arguments)], capture_output=True, text=True, check=False)


def test_a_short_run_and_its_figure(tmp_path):
    cache = tmp_path / "attainable.json"
    done = run(
        BENCHMARKS / "learning.py",
        "--study",
        "r0",
        "--methods",
        "safe,sobol",
        "--seeds",
        "1:2",
        "--trials",
        "2",
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
    assert worst["safe", 2] < 1.0 < worst["sobol", 2]
    assert [row["all_trials"] for row in rows] == [1, 2, 1, 2]

    printed, figure = tmp_path / "rows.json", tmp_path / "learning.png"
    printed.write_text(done.stdout)
    done = run(BENCHMARKS / "learning_figures.py", printed, "--out", figure)
    assert done.returncode == 0, done.stderr
    assert figure.read_bytes().startswith(b"\x89PNG")
    printed.write_text("{}")
    done = run(BENCHMARKS / "learning_figures.py", printed, "--out", figure)
    assert done.returncode == 1
    assert "rows.json: expected is what learning.py --json prints" in done.stderr
    done = run(BENCHMARKS / "learning.py", "--methods", "guess")
    assert "unknown ['guess'], allowed are" in done.stderr
