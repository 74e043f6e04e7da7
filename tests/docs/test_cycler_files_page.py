"""The tables of docs/cycler-files.md are those of `layouts`. Written anew by: python tests/docs/test_cycler_files_page.py."""

import re
from pathlib import Path

from chargetune.battery.identification.layouts import LAYOUTS, NAMES, UNITS

PAGE = Path(__file__).parents[2] / "docs" / "cycler-files.md"
BEGIN, END = "<!-- begin: from layouts.py -->\n", "<!-- end: from layouts.py -->"
MEANINGS = {
    "time": "time of the test: number, clock or date",
    "step_time": "time in the step, used where there is no other",
    "date": "moment, used where there is no clock; otherwise compared with it",
    "current": "current",
    "voltage": "voltage of the cell",
    "charging": "charging current, where the file has one column for either way",
    "discharging": "discharging current, subtracted from the charging one",
    "counter": "voltage of the counter electrode, subtracted from Ewe where Ewe-Ece is missing",
    "temperature": "temperature",
    "state": "state: its words for charge and discharge give a current its sign",
    "step": "number of the step",
}
SHOWN = ("time", "current", "voltage", "temperature")
CLOCKS = {"seconds": "number", "clock": "h:mm:ss", "days": "0d hh:mm:ss", "step": "h:mm:ss in the step", "date": "date"}


def cell(text: str) -> str:
    return f"`{text}`".replace("|", "\\|") if text else ""


def tables() -> str:
    lines = ["## Layouts", "", "Each is tested on a made file. Others are read by their names and units, below.", ""]
    lines += ["| layout | time | its form | current | voltage | temperature | sign from |", "|---|---|---|---|---|---|---|"]
    for layout in LAYOUTS:
        sign = "the current" if layout.signed else f"`{layout.state}`"
        quantities = (cell(layout.current), cell(layout.voltage), cell(layout.temperature))
        lines.append(f"| {layout.name} | {cell(layout.time)} | {CLOCKS[layout.clock]} | {' | '.join(quantities)} | {sign} |")
    lines += [
        "",
        "## Names",
        "",
        "Case, spaces, underscores, dots and words such as *measured* do not matter; of several the first is taken.",
        "",
    ]
    lines += ["| column | names |", "|---|---|"]
    lines += [f"| {MEANINGS[quantity]} | {', '.join(names)} |" for quantity, names in NAMES.items()]
    lines += [
        "",
        "## Units",
        "",
        "In brackets, after a slash, an underscore or a space: `Current(mA)`, `I/mA`, `current_mA`, `Current / mA`.",
        "",
    ]
    lines += ["| column | units |", "|---|---|"]
    lines += [
        f"| {quantity} | {', '.join(unit for unit in units if unit)} |"
        for quantity, units in UNITS.items()
        if quantity in {"time", "current", "voltage", "temperature"}
    ]
    return "\n".join(lines) + "\n\n"


def with_tables(page: str) -> str:
    return re.sub(f"{BEGIN}.*{END}", lambda _: f"{BEGIN}\n{tables()}{END}", page, flags=re.DOTALL)


def test_every_quantity_has_its_meaning():
    assert set(MEANINGS) == set(NAMES)


def test_the_page_has_the_tables_of_the_reader():
    page = PAGE.read_text(encoding="utf-8")
    assert tables() in page, f"python {Path(__file__).name} writes them anew"
    assert with_tables(page) == page


if __name__ == "__main__":
    PAGE.write_text(with_tables(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
