"""The generated pages are those of today's classes, and a command prints the schemas."""

import json
from pathlib import Path

import pytest

from chargetune.battery.file_formats.formats import FORMATS
from chargetune.battery.file_formats.json_schema import json_schema
from chargetune.battery.file_formats.pages import reference
from chargetune.cli.schema import schema_command

FOLDER = Path(__file__).parents[2] / "docs" / "reference"
PAGES = reference()


@pytest.mark.parametrize("name", PAGES)
def test_the_page_is_up_to_date(name):
    assert (FOLDER / name).read_text(encoding="utf-8") == PAGES[name], "run `make reference`"


def test_no_key_is_left_out():
    for file in FORMATS.values():
        page = PAGES[f"{file.name}-file.md"]
        keys = [key.name for table in file.table().walk() for key in table.keys]
        assert len(keys) == page.count("\n| `")
        assert [key for key in keys if f"\n| `{key}` |" not in page] == []


@pytest.mark.parametrize("name", FORMATS)
def test_the_command_prints_the_schema(name, capsys):
    schema_command(name)
    assert json.loads(capsys.readouterr().out) == json.loads(json.dumps(json_schema(FORMATS[name])))
