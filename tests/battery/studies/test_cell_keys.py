"""Every key of cell and plant has a description with its unit, and stands in docs/cells.md."""

import json
import re
from dataclasses import fields
from pathlib import Path
from typing import get_type_hints

import pytest
from bpx_cell import CELL
from pydantic.fields import FieldInfo

from chargetune.battery.cell.cell import Cell
from chargetune.battery.cell.plating import Anode
from chargetune.battery.cell.thermal import Thermal
from chargetune.battery.plants.electrochemical import Electrochemical
from chargetune.battery.plants.parameter_sets import SETS
from chargetune.battery.studies.study_file import CellTable, PlantCellTable, load_config, problem_of_document

PAGE = (Path(__file__).parents[3] / "docs" / "cells.md").read_text(encoding="utf-8")
UNITS = {"Ah": "Ah", "A": " A", "V": " V", "ohm": "ohm", "F": " F", "K": " K", "J_K": "J/K", "W_K": "W/K", "J_mol": "J/mol", "V_K": "V/K"}
OF_FILE = {"ocv_soc": "[ocv] soc", "ocv_V": "[ocv] V", "thermal": "[thermal] ", "anode": "[anode] "}


@pytest.mark.parametrize("made", [Cell, Thermal, Anode, Electrochemical])
def test_each_field_has_a_description_with_its_unit(made):
    hints = get_type_hints(made, include_extras=True)
    for part in fields(made):
        told = next(note.description for note in hints[part.name].__metadata__ if isinstance(note, FieldInfo))
        assert told.endswith(".")
        unit = re.search(r"_(J_K|W_K|J_mol|V_K|Ah|A|V|ohm|F|K)$", part.name)
        assert unit is None or UNITS[unit[1]].strip() in told, part.name
        assert OF_FILE.get(part.name, part.name) in PAGE, part.name


@pytest.mark.parametrize("table", [CellTable, PlantCellTable])
def test_each_key_of_a_study_files_table_has_one(table):
    assert all(part.description for part in table.model_fields.values())


def test_the_page_names_the_sets_that_run():
    assert all(name in PAGE for name in SETS)


BPX_STUDY = '[plant]\nmodel = "SPM"\nparameters = "cell.json"\ncapacity_scale = 0.9\n'


def test_a_store_holds_the_content_of_a_bpx_file(tmp_path, monkeypatch):
    """So that a command may be given from anywhere, and one on the store later, when folder and file are gone."""
    folder = tmp_path / "first"
    folder.mkdir()
    (folder / "study.toml").write_text(BPX_STUDY)
    (folder / "cell.json").write_text(json.dumps(CELL))
    monkeypatch.chdir(tmp_path)
    config = load_config("first/study.toml")
    plant = config.problem(Path("first")).plant
    document = json.loads(json.dumps(config.document(Path("first"))))
    assert str(tmp_path) not in json.dumps(document)
    folder.rename(tmp_path / "second")
    assert config.document(Path("second")) == document
    (tmp_path / "second" / "cell.json").unlink()
    assert problem_of_document(document).plant == plant
    assert plant.bpx() == CELL
    assert "parameters cell.json" in plant.line
    # A plant without its content, of the same file and from the store are one model.
    (tmp_path / "cell.json").write_text(json.dumps(CELL))
    by_path = Electrochemical("SPM", "cell.json", capacity_scale=0.9)
    assert plant.capacity_Ah == by_path.capacity_Ah


def test_a_bpx_file_that_changes_is_another_plant_and_spaces_in_it_are_not(tmp_path):
    (tmp_path / "study.toml").write_text(BPX_STUDY)
    config, found = load_config(tmp_path / "study.toml"), []
    for text in (json.dumps(CELL), json.dumps(CELL, indent=1), json.dumps(CELL).replace("0.0125", "0.013")):
        (tmp_path / "cell.json").write_text(text)
        found.append(config.document(tmp_path))
    assert found[0] == found[1] != found[2]


def test_a_store_of_before_the_content_was_kept_reads_the_file_at_its_path(tmp_path):
    (tmp_path / "study.toml").write_text(BPX_STUDY)
    (tmp_path / "cell.json").write_text(json.dumps(CELL))
    document = load_config(tmp_path / "study.toml").document(tmp_path)
    del document["plant"]["content"]
    document["plant"]["parameters"] = str(tmp_path / "cell.json")
    assert problem_of_document(document).plant.bpx() == CELL


@pytest.mark.parametrize("text", ["", "{", "\udcff"])
def test_a_file_that_is_no_bpx_file_is_named(tmp_path, text):
    (tmp_path / "study.toml").write_text(BPX_STUDY)
    (tmp_path / "cell.json").write_bytes(text.encode("utf-8", "surrogateescape"))
    with pytest.raises(ValueError, match=r"cell\.json is no BPX file"):
        load_config(tmp_path / "study.toml").problem(tmp_path)
