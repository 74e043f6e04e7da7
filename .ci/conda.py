"""Does recipe/recipe.yaml build, and do its tests pass? Run: make conda.

rattler-build, in an environment of its own, builds the recipe and runs its tests against a channel on this machine: its packages are this
Python and the locked distributions in .venv, under the names that conda gives them. So no channel is downloaded. What it shows: names and
ranges of the recipe can be solved with the locked versions, and the package works in the environment that is made from it. What it cannot
show: that conda-forge has all of them.
"""

import sys
import sysconfig
import tempfile
from importlib.metadata import distributions
from pathlib import Path

import rattler_build as conda
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from rattler_build.progress import SimpleProgressCallback

ROOT = Path(__file__).parents[1]
# Of what the recipe and its dependencies name, that which conda-forge calls otherwise than PyPI.
CONDA_NAMES = {"torch": "pytorch", "matplotlib": "matplotlib-base", "linear-operator": "linear_operator"}
PLATFORM = "linux-64"
VERSION = f"{sys.version_info.major}.{sys.version_info.minor}"
# By default the script of a recipe sees the packages of its host environment alone; these two it is built with.
HOST = ("pip", "setuptools")


class Log(SimpleProgressCallback):
    """What rattler-build says, kept until it is known whether it failed."""

    def __init__(self):
        self.lines = []

    def on_log(self, event):
        self.lines.append(event.message)


def add_python(channel):
    """Put this Python into the channel: executable, library, standard library."""
    stdlib, library = Path(sysconfig.get_path("stdlib")), sysconfig.get_config_var("INSTSONAME") or ""
    files = {f"bin/python{VERSION}": Path(sys.executable).resolve()}
    files |= {f"bin/{name}": files[f"bin/python{VERSION}"] for name in ("python", "python3")}
    if ".so" in library:
        files[f"lib/{library}"] = Path(sysconfig.get_config_var("LIBDIR")) / library
    for path in stdlib.rglob("*"):
        inside = path.relative_to(stdlib)
        if path.is_file() and not {"site-packages", "dist-packages", "__pycache__", "test"} & set(inside.parts):
            files[f"lib/python{VERSION}/{inside}"] = path
    add(channel, "python", sys.version.split()[0], files, ())


def add(channel, name, version, files, depends):
    """Put a package into the channel: ``files`` by their place in an environment."""
    entries = [conda.FileEntry.from_paths(str(path), place) for place, path in files.items()]
    folder = channel / PLATFORM
    conda.assemble_package(name, version, PLATFORM, "0", folder, files=entries, depends=list(depends), compression_level=1)


def asked(distribution):
    """Names of the distributions that one needs without any extra."""
    lines = map(Requirement, distribution.requires or ())
    return [canonicalize_name(line.name) for line in lines if line.marker is None or line.marker.evaluate({"extra": ""})]


def add_locked(channel, site, names):
    """Put the distributions ``names`` in the folder ``site``, and all that they need, into the channel; how many they are."""
    locked = {canonicalize_name(one.name): one for one in distributions(path=[str(site)])}
    waiting, done = list(names), set()
    while waiting:
        name = waiting.pop()
        # What another platform or a GPU needs is not locked.
        if name in done or name not in locked:
            continue
        done.add(name)
        one, needs = locked[name], [below for below in asked(locked[name]) if below in locked]
        waiting += needs
        files = {
            f"lib/python{VERSION}/site-packages/{file}": Path(one.locate_file(file))
            for file in map(str, one.files or ())
            if not file.startswith("..") and "__pycache__" not in file and Path(one.locate_file(file)).is_file()
        }
        depends = [f"python {VERSION}.*", *(CONDA_NAMES.get(below, below) for below in needs)]
        add(channel, CONDA_NAMES.get(name, name), one.version, files, depends)
    return len(done)


def main(site):
    """Make the channel, build, test."""
    path = ROOT / "recipe" / "recipe.yaml"
    pypi_names = {name: pypi for pypi, name in CONDA_NAMES.items()}
    run = [line.split()[0] for line in yaml.safe_load(path.read_text(encoding="utf-8"))["requirements"]["run"]]
    with tempfile.TemporaryDirectory() as made:
        channel = Path(made)
        (channel / PLATFORM).mkdir()
        add_python(channel)
        count = add_locked(channel, site, [canonicalize_name(pypi_names.get(name, name)) for name in (*run, *HOST)])
        print(f"channel: Python {VERSION} and {count} locked distributions", flush=True)
        log = Log()
        try:
            # The folder of the output is a channel too, the only one.
            (result,) = conda.Stage0Recipe.from_file(str(path)).run_build(
                tool_config=conda.ToolConfiguration(test_strategy="native"), output_dir=made, channels=[], progress_callback=log
            )
        except conda.RattlerBuildError as error:
            sys.exit("\n".join([*log.lines[-80:], f"recipe/recipe.yaml: {error}"]))
        (package,) = result.packages
        print(f"{package.name}: built; its tests pass with rattler-build {conda.rattler_build_version()}")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
