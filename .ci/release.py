"""What a release consists of: the sdist, the wheel, and what they depend on. Shared by packages.py and bounds.py."""

import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]
# Extras for users; bench, dev and docs are for those who work on the project.
EXTRAS = ("dask", "excel", "export", "gym", "notebook", "postgres", "pybamm", "web")
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
PROJECT = PYPROJECT["project"]
(BUILD,) = PYPROJECT["build-system"]["requires"]
BACKEND = "import sys; from setuptools import build_meta; print(getattr(build_meta, 'build_' + sys.argv[1])(sys.argv[2]))"


def requirements(extras=()):
    """What the package needs, and what the extras add to it."""
    return [*PROJECT["dependencies"], *(line for extra in extras for line in PROJECT["optional-dependencies"][extra])]


def listed():
    """Files of the repository, those too that are not committed yet."""
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    names = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.split("\0")
    return [name for name in names if name and (ROOT / name).is_file()]


def copy_tree(target):
    """Copy the files of the repository, but not what earlier builds left in it, which setuptools would take up."""
    for name in listed():
        (target / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(ROOT / name, target / name)


def build(kind, tree, target, python=sys.executable):
    """Path of the ``kind`` ("sdist" or "wheel") that the setuptools of ``python`` makes of ``tree``, in the folder ``target``."""
    command = [str(python), "-I", "-c", BACKEND, kind, str(target)]
    done = subprocess.run(command, cwd=tree, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        sys.exit(f"the {kind} cannot be built:\n{done.stdout}{done.stderr}")
    return target / done.stdout.split()[-1]
