"""The site: every public name has a page, every page is in the menu, links lead where they should. `make docs` builds it."""

import re
import runpy
from pathlib import Path

import pytest

import chargetune as ct

DOCS = Path(__file__).parents[2] / "docs"
SCRIPTS = sorted((DOCS.parent / "examples" / "gallery").glob("*.py"))
SITE = runpy.run_path(str(DOCS / "site_pages.py"))
MADE = runpy.run_path(str(DOCS / "make_reference.py"))
GENERATED = {**MADE["python_pages"](), **MADE["command_page"]()}


@pytest.mark.parametrize("name", GENERATED)
def test_the_page_is_up_to_date(name):
    assert (DOCS / "reference" / name).read_text(encoding="utf-8") == GENERATED[name], "run `make reference`"


def test_every_public_name_is_documented():
    pages = "\n".join(GENERATED.values())
    public = [name for name in ct.__all__ if name != "__version__"]
    assert [
        name for name in public if not any(f"auto{kind}:: chargetune.{name}\n" in pages for kind in ("class", "function", "exception"))
    ] == []
    assert [name for name in public if not (getattr(ct, name).__doc__ or "").strip()] == []


def test_every_command_is_documented():
    from chargetune.cli.app import app

    commands = [command.name or command.callback.__name__ for command in app.registered_commands]
    page = GENERATED["command-line.md"]
    assert [name for name in commands if f"\n## {name}\n" not in page] == []
    assert "\n## store check\n" in page


def test_the_ways_to_a_real_cycler_are_found_from_the_menu():
    """A bench joins the loop as a plant, stepwise or by its CSV: the first page says so, and the page shows each in code that runs."""
    index = (DOCS / "index.md").read_text(encoding="utf-8")
    assert all(word in index for word in ("cycler", "stepwise", "CSV", "how-to/device-in-the-loop"))
    page = (DOCS / "how-to" / "device-in-the-loop.md").read_text(encoding="utf-8")
    assert all(f"{name}(" in page for name in ("run_episode", "act", "recorded_episode"))
    assert "not run" not in page


def test_every_page_is_in_the_menu():
    text = (DOCS / "index.md").read_text(encoding="utf-8")
    menu = text + SITE["hidden"]("index", text)
    pages = [
        page.relative_to(DOCS).with_suffix("").as_posix()
        for page in DOCS.glob("**/*.md")
        if page.parent.name not in ("decisions", "gallery")
    ]
    assert [page for page in pages if page != "index" and f"\n{page}\n" not in menu] == []
    assert "tutorials/certify" in pages
    records = SITE["hidden"]("decisions/README", "")
    assert all(f"\n{record.stem}\n" in records for record in DOCS.glob("decisions/[0-9]*.md"))


@pytest.mark.parametrize(
    ("text", "page", "expected"),
    [
        ("[a](range.md#x)", "docs/learning.md", "[a](range.md#x)"),
        ("[a](../README.md)", "docs/learning.md", "[a](index.md)"),
        ("[a](../CHANGELOG.md)", "docs/learning.md", "[a](changes.md)"),
        ("[`a`](../examples/custom_system.py)", "docs/learning.md", "{download}`a <../examples/custom_system.py>`"),
        ("[a](../../examples/gallery/crane.py)", "docs/how-to/own-system.md", "[a](../gallery/crane.rst)"),
        ("[a](../examples/gallery/README.rst)", "docs/learning.md", "[a](gallery/index.rst)"),
        ("![a](learning.png)", "docs/learning.md", "![a](learning.png)"),
        ("[a](https://example.org/a.md)", "docs/learning.md", "[a](https://example.org/a.md)"),
        ("[a](#b)", "docs/learning.md", "[a](#b)"),
        ("[a](../changes/README.md)", "docs/learning.md", "a (`changes/README.md`)"),
    ],
)
def test_links_are_led(text, page, expected):
    assert SITE["led"](text, page, page) == expected


def test_links_of_a_file_elsewhere_are_led():
    assert SITE["led"]("[a](docs/range.md) ![b](docs/learning.png)", "README.md", "docs/index.md") == "[a](range.md) ![b](learning.png)"
    assert SITE["led"]("[a](../docs/range.md)", "benchmarks/README.md", "docs/benchmarks.md") == "[a](range.md)"


def test_what_is_not_released_yet_is_listed():
    assert "## Unreleased: added" in SITE["unreleased"]()
    assert len(SITE["unreleased"]().splitlines()) > len(list((DOCS.parent / "changes").glob("*.added.md")))


@pytest.mark.parametrize(
    ("lines", "shown"),
    [
        (["G = |e|^2"], ["G = \\|e\\|^2"]),
        (["| a | b |", "|---|---|"], ["::", "", "    | a | b |", "    |---|---|"]),
        (["Text:", "", "    |x|", "    y", "", "so |z|"], ["Text:", "", "::", "", "    |x|", "    y", "", "so \\|z\\|"]),
        (["term", "    Its text.", "", "    More of it."], ["term", "    Its text.", "", "    More of it."]),
        (["term", "    Text:", "", "        x", "", "    so."], ["term", "    Text:", "", "    ::", "", "        x", "", "    so."]),
    ],
)
def test_formulas_tables_and_bars_of_docstrings_are_shown(lines, shown):
    SITE["shown_docstring"](None, "class", "Name", None, None, lines)
    assert lines == shown


def test_a_default_that_is_made_anew_can_be_parsed():
    assert SITE["shown_signature"](None, "class", "Name", None, None, "(a = <factory>)", "None") == ("(a = ...)", "None")


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.name)
def test_a_script_of_the_gallery_is_short_has_a_title_and_draws(script):
    """`make gallery` runs them, and stops at the first error."""
    text = script.read_text(encoding="utf-8")
    lines = text.splitlines()
    assert len(lines) <= 60
    assert lines[0] == '"""'
    assert lines[2] == "=" * len(lines[1])
    # The picture of its page: drawn by pyplot, which sphinx-gallery collects, with what is on both axes.
    assert re.search(r"plt\.(subplots|figure|plot)\(", text)
    assert re.search(r"xlabel=.*ylabel=|ylabel=(.|\n)*xlabel=", text)


def test_every_script_of_the_gallery_has_its_place():
    assert sorted(SITE["GALLERY"]) == [script.stem for script in SCRIPTS]
    assert len(SCRIPTS) >= 14
    order = SITE["GalleryOrder"](str(SCRIPTS[0].parent))
    assert min(SCRIPTS, key=order).stem == SITE["GALLERY"][0]


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.name)
def test_a_script_of_the_gallery_opens_as_a_notebook(script):
    """As sphinx-gallery makes it for its page: every line of code is in a cell, and the title is a heading."""
    pytest.importorskip("sphinx_gallery", reason="in the extra docs")
    from sphinx_gallery.gen_gallery import DEFAULT_GALLERY_CONF
    from sphinx_gallery.notebook import jupyter_notebook
    from sphinx_gallery.py_source_parser import split_code_and_text_blocks

    blocks = split_code_and_text_blocks(str(script))[1]
    cells = jupyter_notebook(blocks, DEFAULT_GALLERY_CONF, str(script.parent))["cells"]
    title = script.read_text(encoding="utf-8").splitlines()[1]
    text = "".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "markdown")
    assert text.startswith(f"\n# {title}\n")
    assert ":download:" not in text
    code = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
    assert code
    for cell in code:
        compile(cell, script.name, "exec")
