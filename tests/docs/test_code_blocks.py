"""Every block of code in README and docs: Python runs, commands and files are understood, the rest is marked as output."""

import re
import shlex
import shutil
import tomllib
from dataclasses import dataclass
from pathlib import Path

import pytest
import typer

from chargetune.battery.studies.campaign import CampaignFile
from chargetune.battery.studies.study_file import Config, read_tables
from chargetune.cli.app import app

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *(page for page in sorted(ROOT.glob("docs/**/*.md")) if page.parent.name != "decisions")]
# What a program printed, a formula, and the directives of the site.
NOT_CODE = ("text", "{toctree}", "{eval-rst}")
FENCED = re.compile(r"^```([\w{}-]*)\n(.*?)^```$", flags=re.MULTILINE | re.DOTALL)
# After a blank line or a heading; a continued item of a list is no code.
INDENTED = re.compile(r"(?:(?<=\n\n)|^#.*\n)((?: {4}.*\n)(?:(?: {4}.*)?\n)*)", flags=re.MULTILINE)
NOT_RUN = re.compile(r"<!-- not run: \S.+ -->\s*\Z")


@dataclass(frozen=True)
class Block:
    """A block of a page: its language, its text, whether a comment before it says why it is not run."""

    language: str
    text: str
    skipped: bool


def blocks(text):
    """The blocks of a page, those in backquotes first."""
    found = [Block(match[1], match[2], bool(NOT_RUN.search(text[: match.start()]))) for match in FENCED.finditer(text)]
    rest = FENCED.sub("", text)
    for match in INDENTED.finditer(rest):
        body = re.sub(r"^ {4}", "", match[1], flags=re.MULTILINE).strip("\n") + "\n"
        found.append(Block(language_of(body), body, bool(NOT_RUN.search(rest[: match.start(1)]))))
    return found


def language_of(body):
    """Of an indented block, which does not say it: a formula or output is text."""
    if re.match(r"(import|from) [\w.]+|with \w", body):
        return "python"
    if re.match(r"(chargetune|python|pip|make) ", body):
        return "sh"
    return "toml" if re.match(r"\[\[?[\w.]+\]", body) else "text"


def code(language):
    """(page, its blocks of a language that are run) for each page that has some."""
    found = {page: [b for b in blocks(page.read_text(encoding="utf-8")) if b.language == language and not b.skipped] for page in PAGES}
    return [pytest.param(page, parts, id=str(page.relative_to(ROOT))) for page, parts in found.items() if parts]


def faults_of_command(line):
    """What is wrong with a line of a shell: a command or option that is not there, a target or script that is not there."""
    words = shlex.split(line.partition(" > ")[0], comments=True)
    if not words or words[0] in ("pip", "python3"):
        return []
    if words[0] == "make":
        targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), flags=re.MULTILINE)
        return [word for word in words[1:] if "=" not in word and word not in targets]
    if words[0] == "python":
        return [] if (ROOT / words[1]).is_file() else [words[1]]
    if words[0] != "chargetune":
        return [words[0]]
    command = typer.main.get_command(app)
    words = words[1:]
    while hasattr(command, "commands"):
        if words[0] not in command.commands:
            return [words[0]]
        command, words = command.commands[words[0]], words[1:]
    try:
        command.make_context(command.name, list(words))
    except Exception as error:  # noqa: BLE001 - typer's own classes of errors have no public name
        return [f"{line}: {error}"]
    return []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_block_says_what_it_is(page):
    unknown = {block.language for block in blocks(page.read_text(encoding="utf-8"))} - {"python", "sh", "toml", *NOT_CODE}
    assert unknown == set(), f"allowed are python, sh, toml, and {', '.join(NOT_CODE)} for what is no code"


@pytest.mark.usefixtures("virtual_machine")
@pytest.mark.parametrize(("page", "parts"), [part for part in code("python") if part.id != "README.md"])
def test_python_runs(page, parts, monkeypatch, tmp_path):
    """From top to bottom of the page, in a folder with the study files of the examples."""
    monkeypatch.chdir(tmp_path)
    for file in (ROOT / "examples").glob("*.toml"):
        shutil.copy(file, tmp_path)
    names = {"__name__": "page"}
    for part in parts:
        exec(compile(part.text, str(page), "exec"), names)  # noqa: S102 - that the page runs is what is tested


@pytest.mark.parametrize(("page", "parts"), code("sh"))
def test_commands_are_understood(page, parts):
    assert [fault for part in parts for line in part.text.splitlines() for fault in faults_of_command(line)] == []


@pytest.mark.parametrize(("page", "parts"), code("toml"))
def test_files_are_read(page, parts, tmp_path):
    for part in parts:
        file = tmp_path / "part.toml"
        file.write_text(part.text, encoding="utf-8")
        read_tables(file, CampaignFile if "campaign" in tomllib.loads(part.text) else Config)


@pytest.mark.usefixtures("virtual_machine")
def test_the_readme_tunes_its_tank(monkeypatch, tmp_path):
    """What the page says of its example is so: without a margin the tank is filled beyond its limit, the result keeps it."""
    monkeypatch.chdir(tmp_path)
    names = {}
    for part in blocks((ROOT / "README.md").read_text(encoding="utf-8")):
        if part.language == "python":
            exec(compile(part.text, "README.md", "exec"), names)  # noqa: S102 - as above
    with names["ct"].Store("tank.sqlite") as store, names["ct"].Study.create_or_resume(store, "tank", **names["how"]) as study:
        result, trials = study.result(), study.trials()
    assert trials[0].score.excess["level"] > 1e-3
    assert result.kept.score.feasible


def test_blocks_are_found():
    page = (
        "Text\n\n    chargetune show a.sqlite\n\n- item\n  goes on\n\n```python\nimport a\n\n    b\n```\n\n"
        "<!-- not run: no net -->\n```sh\nls\n```\n"
    )
    assert blocks(page) == [
        Block("python", "import a\n\n    b\n", skipped=False),
        Block("sh", "ls\n", skipped=True),
        Block("sh", "chargetune show a.sqlite\n", skipped=False),
    ]


@pytest.mark.parametrize(
    ("line", "right"),
    [
        ("chargetune tune study.toml --trials 3 # text", True),
        ("chargetune store check a.sqlite", True),
        ("make test", True),
        ("chargetune tun study.toml", False),
        ("chargetune tune", False),
        ("chargetune tune study.toml --trails 3", False),
        ("make nothing", False),
        ("python benchmarks/nothing.py", False),
        ("rm -rf out", False),
    ],
)
def test_faults_of_a_command_are_found(line, right):
    assert (faults_of_command(line) == []) is right
