"""The pages in Markdown: decision records keep their form, and no link leads nowhere."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
DECISIONS = ROOT / "docs" / "decisions"
RECORDS = sorted(DECISIONS.glob("[0-9]*.md"))
PAGES = sorted([ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "benchmarks" / "README.md", *ROOT.glob("docs/**/*.md")])
LINES_MAX, CHARACTERS_MAX = 30, 140
SECTIONS = ["Context", "Decision", "Alternatives", "Consequences"]


def local_links(page: Path) -> list[str]:
    """Targets of the page's links and images that are files, without their anchors."""
    targets = re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8"))
    return [target.partition("#")[0] for target in targets if not re.match(r"[a-z]+:|#", target)]


def broken_links(page: Path) -> list[str]:
    return [target for target in local_links(page) if not (page.parent / target).is_file()]


def faults_of_record(name: str, text: str) -> list[str]:
    """What is wrong with the form of a record: its size, its number, its sections."""
    lines = text.splitlines()
    faults = [f"line {k} has {len(line)} characters" for k, line in enumerate(lines, 1) if len(line) > CHARACTERS_MAX]
    if len(lines) > LINES_MAX:
        faults.append(f"{len(lines)} lines")
    if not lines or not lines[0].startswith(f"# {name[:4]} "):
        faults.append("the title does not begin with the number of the file")
    if re.findall(r"^## (\w+)", text, flags=re.MULTILINE) != SECTIONS:
        faults.append(f"the sections are not {SECTIONS}")
    return faults


def test_records_are_numbered_without_a_gap():
    assert RECORDS
    assert [int(record.name[:4]) for record in RECORDS] == list(range(1, len(RECORDS) + 1))


@pytest.mark.parametrize("record", RECORDS, ids=lambda record: record.name)
def test_record_keeps_its_form(record):
    assert faults_of_record(record.name, record.read_text(encoding="utf-8")) == []


def test_faults_of_a_record_are_found():
    good = "# 0007 Title\n\n" + "".join(f"## {section}\nText.\n\n" for section in SECTIONS)
    assert faults_of_record("0007-title.md", good) == []
    assert faults_of_record("0008-title.md", good) == ["the title does not begin with the number of the file"]
    assert faults_of_record("0007-title.md", good + "x" * 141) == ["line 15 has 141 characters"]
    assert faults_of_record("0007-title.md", good + "x\n" * 17) == ["31 lines"]
    assert len(faults_of_record("0007-title.md", good.replace("## Alternatives", "## Others"))) == 1


def test_rules_link_every_record():
    assert {record.name for record in RECORDS} <= set(local_links(DECISIONS / "README.md"))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_to_files(page):
    assert broken_links(page) == []


def test_pages_have_local_links():
    assert sum(len(local_links(page)) for page in PAGES) > len(RECORDS)


def test_broken_links_are_found(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(
        "[a](page.md) [b](page.md#part) [c](#part) [d](https://example.org/x.md) [e](missing.md#part) ![f](missing.png)\n", encoding="utf-8"
    )
    assert broken_links(page) == ["missing.md", "missing.png"]
