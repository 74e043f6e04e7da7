"""The pages of the reference in Markdown: a page for each kind of file, and one for the columns of a cycler's file."""

from __future__ import annotations

import json

from chargetune.battery.file_formats.formats import FORMATS, Format
from chargetune.battery.file_formats.json_schema import json_schema
from chargetune.battery.file_formats.keys import REQUIRED, Key, Table, in_words
from chargetune.battery.identification.layouts import NAMES, NEEDED, UNITS

__all__ = ["reference"]

MADE = "<!-- Made by `make reference` from the classes that read the file. Do not edit. -->"
CSV_ABOUT = (
    "`chargetune identify` finds the columns by name. Spaces, signs, underscores and case do not matter; a unit follows the name in "
    "parentheses, brackets or after a slash, as in `Current(mA)` or `Test Time / s`, and is converted. Current is positive when it "
    "charges; another sign is recognised, or has to be said (`--sign`)."
)
# What a record may hold, by quantity: its unit where none is named, and one sentence.
QUANTITIES = {
    "time": ("s", "Time of the sample since the start; needed, unless step_time or date is there."),
    "step": ("", "Number of the step, by which a clock that restarts is strung together."),
    "step_time": ("s", "Time since the step began."),
    "date": ("", "Date and time of day of the sample."),
    "current": ("A", "Current that has flowed since the sample before."),
    "voltage": ("V", "Voltage of the cell."),
    "charging": ("A", "Charging current, where the file has one column for either way instead of `current`."),
    "discharging": ("A", "Discharging current; it is subtracted from the charging one."),
    "counter": ("V", "Potential of the counter electrode, where three are measured."),
    "temperature": ("degree Celsius", "Temperature of the cell; a column with holes is left out."),
    "state": ("", "Rest, charge or discharge, where the current has no sign."),
}


def reference() -> dict[str, str]:
    """Every file of ``docs/reference`` that is generated, text by name."""
    found = {"csv-columns.md": _csv_page()}
    for file in FORMATS.values():
        found[f"{file.name}-file.md"] = _page(file)
        found[f"{file.name}.schema.json"] = json.dumps(json_schema(file), indent=1, ensure_ascii=False) + "\n"
    return found


def _page(file: Format) -> str:
    tables = [table for table in file.table().walk() if table.keys]
    editor = (
        f"In an editor: [`{file.name}.schema.json`]({file.name}.schema.json) completes, explains and checks keys "
        "([how](index.md#in-an-editor))."
    )
    legend = (
        'A range in brackets includes its ends, in parentheses it leaves them out. The unit 1 is a pure number. "the cell\'s" is a bound '
        "that follows from the cell."
    )
    parts = [f"# {file.title}", MADE, file.about, editor, legend]
    for table in tables:
        parts += [f"## `{table.heading}`" if table.path else f"## {table.heading}", _escaped(table.sentence), _table(file, table)]
    return "\n\n".join(parts) + "\n"


def _table(file: Format, table: Table) -> str:
    head = ["| key | unit | default | allowed | meaning |", "|---|---|---|---|---|"]
    return "\n".join(head + [_row(key, str(file.bounds(table, key))) for key in table.keys])


def _row(key: Key, bounds: str) -> str:
    allowed = " ".join(_code(in_words(key.type)).split() + bounds.split())
    return f"| `{key.name}` | {key.unit} | {_default(key)} | {allowed} | {_escaped(key.sentence)} |"


def _default(key: Key) -> str:
    if key.default is REQUIRED:
        return "required"
    if key.default is None or key.default in ((), {}, ""):
        return "none"
    if isinstance(key.default, (tuple, list)):
        return _escaped(json.dumps(list(key.default)))
    return f"`{json.dumps(key.default)}`" if isinstance(key.default, (str, bool)) else f"{key.default:g}"


def _code(words: str) -> str:
    """Values in quotes as code."""
    return " or ".join(f"`{part}`" if part.startswith('"') else part for part in words.split(" or "))


def _escaped(text: str) -> str:
    return text.replace("|", "\\|").replace("[", "\\[").replace("<", "&lt;")


def _csv_page() -> str:
    parts = [
        "# Columns of a cycler's file",
        MADE,
        CSV_ABOUT,
    ]
    head = ["| quantity | needed | unit where none is named | units | names | meaning |", "|---|---|---|---|---|---|"]
    rows = []
    for quantity, names in NAMES.items():
        unit, sentence = QUANTITIES[quantity]
        units = ", ".join(f"`{name}`" for name in UNITS.get(quantity, {}) if name)
        known = ", ".join(f"`{name}`" for name in names)
        rows.append(f"| {quantity} | {'yes' if quantity in NEEDED else 'no'} | {unit} | {units} | {known} | {sentence} |")
    return "\n\n".join([*parts, "\n".join(head + rows)]) + "\n"
