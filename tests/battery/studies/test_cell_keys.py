"""Every key of cell and plant has a description with its unit, and stands in docs/cells.md."""

import re
from dataclasses import fields
from pathlib import Path
from typing import get_type_hints

import pytest
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


def test_a_bpx_file_lies_beside_the_study_file(tmp_path, monkeypatch):
    """So that a command may be given from anywhere, and one on the store later."""
    (tmp_path / "study.toml").write_text('[plant]\nmodel = "SPM"\nparameters = "cell.json"\n')
    config = load_config(tmp_path / "study.toml")
    monkeypatch.chdir(tmp_path.parent)
    plant = config.problem(Path(tmp_path.name)).plant
    assert plant.parameters == str(tmp_path / "cell.json")
    assert problem_of_document(config.document(tmp_path)).plant == plant
