"""Every key of a file has a unit, a sentence and the bounds that its reader keeps; every key that the reader knows is among them."""

import re
from dataclasses import dataclass
from typing import Any

import pytest

from chargetune.battery.cell.cell import load_cell
from chargetune.battery.file_formats.bounds import Bounds
from chargetune.battery.file_formats.formats import FORMATS
from chargetune.battery.file_formats.keys import REQUIRED, in_words, part_of, table_of
from chargetune.battery.studies.study_file import load_config

TABLES = [pytest.param(file, table, id=f"{file.name} {table.heading}") for file in FORMATS.values() for table in file.table().walk()]


def bounds(file, path, name):
    table = next(table for table in FORMATS[file].table().walk() if ".".join(table.path) == path)
    return FORMATS[file].bounds(table, part_of(table.keys, name))


@pytest.mark.parametrize(("file", "table"), TABLES)
def test_every_key_has_a_sentence_and_every_number_a_unit(file, table):
    assert re.fullmatch(r"\S.+[.!]", table.sentence)
    for key in table.keys:
        assert re.fullmatch(r"\S.+[.!]", key.sentence), f"{table.heading} {key.name} has no sentence below its field"
        assert bool(key.unit) == key.is_number
        # A range says more than a type; only a key of the user's own choice has none.
        assert not key.is_number or str(file.bounds(table, key)), f"{table.heading} {key.name} has no bounds"


@pytest.mark.parametrize(
    ("file", "path", "name", "expected"),
    [
        ("study", "controller", "horizon", Bounds(1, 50)),
        ("study", "controller", "penalty_per_V", Bounds(0, 1e9, low_open=True)),
        ("study", "controller", "mismatch_seed", Bounds(0)),
        ("study", "study", "trials", Bounds(1)),
        ("study", "twin", "resistance_spread", Bounds(0, 2, low_open=True)),
        ("study", "safety", "probability", Bounds(0.5, 1, high_open=True)),
        ("study", "episode", "soc_target", Bounds("soc_start", 1, low_open=True)),
        ("study", "limits", "current_max_A", Bounds(0, "the cell's", low_open=True)),
        ("study", "theta.anode_backoff", "upper", Bounds(0, 0.5, low_open=True)),
        ("study", "theta.temperature_backoff", "upper", Bounds(0, 50, low_open=True)),
        ("study", "range", "ambient_K", Bounds(200, 400)),
        ("cell", "ecm", "soc", Bounds(0, 1)),
        ("cell", "thermal", "ambient_K", Bounds(200, 400, low_open=True)),
        ("campaign", "campaign", "trials", Bounds(1)),
    ],
)
def test_bounds_are_those_of_the_reader(file, path, name, expected):
    assert bounds(file, path, name) == expected


def test_a_bound_can_be_reached_and_not_exceeded(tmp_path):
    file = tmp_path / "study.toml"
    high = bounds("study", "sensors", "delay_steps").high
    file.write_text(f"[sensors]\ndelay_steps = {high:g}\n")
    assert load_config(file).sensors.delay_steps == high
    file.write_text(f"[sensors]\ndelay_steps = {high + 1:g}\n")
    with pytest.raises(ValueError, match="delay_steps"):
        load_config(file)


def test_a_cell_file_knows_the_same_keys(tmp_path):
    whole = FORMATS["cell"].table()
    file = tmp_path / "cell.toml"
    file.write_text("unknown = 1\n")
    with pytest.raises(ValueError, match="known keys are") as refused:
        load_cell(file)
    listed = set(re.findall(r"\w+", str(refused.value).rpartition("known keys are")[2]))
    assert listed == {key.name for key in whole.keys} | {table.path[-1] for table in whole.tables}


@dataclass(frozen=True)
class Small:
    """A table. With more to say.

    Of it.
    """

    length_V: float
    """its length; null: none"""
    way: tuple[float, float] | None = None


def test_keys_are_read_from_a_class():
    table = table_of(Small, ("a", "b"), texts={Small: {"way": "from, to"}})
    assert (table.heading, table.sentence) == ("[a.b]", "A table. With more to say.")
    length, way = table.keys
    assert (length.unit, length.default, way.unit, way.default) == ("V", REQUIRED, "1", None)
    assert way.sentence == "From, to."
    assert in_words(way.type) == "list of 2 numbers"


def test_a_type_that_no_file_has_is_refused():
    with pytest.raises(TypeError, match="has no words"):
        in_words(dict[str, Any])


@pytest.mark.parametrize(
    ("interval", "text"),
    [
        (Bounds(), ""),
        (Bounds(0.0), "at least 0"),
        (Bounds(high=1.0, high_open=True), "less than 1"),
        (Bounds(0.0, 1.0, low_open=True), "(0, 1]"),
        (Bounds("the cell's", "the cell's"), "within the cell's"),
    ],
)
def test_bounds_in_words(interval, text):
    assert str(interval) == text
