import ast
import re
import subprocess
import sys
import tomllib
from importlib.metadata import packages_distributions, version
from pathlib import Path

import pytest
import yaml  # pre-commit brings it
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import chargetune

ROOT = Path(__file__).parents[1]
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
PROJECT = PYPROJECT["project"]
EXTRAS = PROJECT["optional-dependencies"]
# Those of who works on the project, not of users.
DEVELOPERS = {"bench", "dev", "docs"}
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


@pytest.mark.parametrize("line", sorted({*PROJECT["dependencies"], *(line for lines in EXTRAS.values() for line in lines)}))
def test_a_dependency_has_a_lowest_version_and_an_upper_bound(line):
    signs = sorted(specifier.operator for specifier in Requirement(line).specifier)
    assert signs in (["<", ">="], ["=="])


def test_one_dependency_has_one_range_and_the_locked_version_lies_in_it():
    lock = (ROOT / "requirements.lock").read_text(encoding="utf-8")
    locked = {canonicalize_name(name): pinned for name, pinned in re.findall(r"^([\w.-]+)==(\S+)$", lock, re.MULTILINE)}
    found = {}
    for line in [*PROJECT["dependencies"], *(line for lines in EXTRAS.values() for line in lines)]:
        requirement = Requirement(line)
        found.setdefault(canonicalize_name(requirement.name), set()).add(requirement.specifier)
    assert {name: ranges for name, ranges in found.items() if len(ranges) > 1} == {}
    assert [name for name, (only,) in found.items() if not only.contains(locked[name])] == []


def test_what_is_imported_is_declared():
    """At the head of a module or only for type checkers: a dependency; inside a function also what an extra brings."""
    known = packages_distributions()
    core, extra = (
        {canonicalize_name(Requirement(line).name) for line in lines}
        for lines in (PROJECT["dependencies"], [line for name, lines in EXTRAS.items() if name not in DEVELOPERS for line in lines])
    )
    undeclared = set()
    for path in (ROOT / "src").rglob("*.py"):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        allowed = core | extra if path.parent.name == "web" else core
        for node in ast.walk(tree):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            names += [node.module] if isinstance(node, ast.ImportFrom) and node.module and not node.level else []
            for top in {name.partition(".")[0] for name in names} - sys.stdlib_module_names - {"chargetune"}:
                brought = {canonicalize_name(name) for name in known[top]}
                if not brought & (allowed if node in tree.body else core | extra):
                    undeclared.add((path.name, top))
    assert undeclared == set()


def test_classifiers_name_the_pythons_from_the_lowest_on():
    lines = PROJECT["classifiers"]
    assert lines == sorted(set(lines), key=lambda line: [part.strip() for part in line.split("::")])
    assert not [line for line in lines if line.startswith("License ::")]  # `license` is an SPDX expression
    minors = [int(match[1]) for line in lines if (match := re.fullmatch(r"Programming Language :: Python :: 3\.(\d+)", line))]
    assert minors == list(range(minors[0], minors[-1] + 1))
    assert PROJECT["requires-python"] == f">=3.{minors[0]}"
    assert sys.version_info.minor in minors


def test_recipe_agrees_with_pyproject():
    recipe = yaml.safe_load((ROOT / "recipe" / "recipe.yaml").read_text(encoding="utf-8"))
    conda_names = {"matplotlib": "matplotlib-base", "torch": "pytorch"}

    def as_conda(lines):
        found = [re.fullmatch(r"([\w.-]+)(?:\[\w+\])?(.*)", line).groups() for line in lines]
        return sorted({f"{conda_names.get(name, name)} {versions}" for name, versions in found})

    assert recipe["context"]["version"] == chargetune.__version__
    assert PROJECT["requires-python"] == f">={recipe['context']['python_min']}"
    assert recipe["about"]["summary"] == PROJECT["description"]
    assert recipe["about"]["license"] == PROJECT["license"]
    assert recipe["build"]["python"]["entry_points"] == [f"{name} = {where}" for name, where in PROJECT["scripts"].items()]
    needs = recipe["requirements"]
    assert needs["host"][0] == "python ${{ python_min }}.*"
    assert needs["host"][2:] == as_conda(PYPROJECT["build-system"]["requires"])
    assert needs["run"][0] == "python >=${{ python_min }}"
    assert sorted(needs["run"][1:]) == as_conda(PROJECT["dependencies"])
    assert needs["run_constraints"] == as_conda(line for name, lines in EXTRAS.items() if name not in DEVELOPERS for line in lines)


def test_paper_cites_what_its_bibliography_has():
    paper = (ROOT / "paper" / "paper.md").read_text(encoding="utf-8")
    bibliography = (ROOT / "paper" / "paper.bib").read_text(encoding="utf-8")
    entries = dict(re.findall(r"^@\w+\{(\w+),\n(.*?)^\}", bibliography, re.MULTILINE | re.DOTALL))
    assert set(re.findall(r"@(\w+)", paper)) == set(entries)
    dois = [match[1] for text in entries.values() if (match := re.search(r"doi = \{(.*)\}", text))]
    assert all(re.fullmatch(r"10\.\d{4,5}/\S+", doi) for doi in dois)
    figures = re.findall(r"\]\((\S+\.png)\)", paper)
    assert figures
    assert all((ROOT / "paper" / name).is_file() for name in figures)
    assert {"Summary", "Statement of need", "State of the field", "References"} <= set(re.findall(r"^# (.*)$", paper, re.MULTILINE))
