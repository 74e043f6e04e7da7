"""A pack of identical cells: every number stays that of one cell, and every place says so."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from chargetune.battery.cell.cell import default_cell, load_cell
from chargetune.battery.identification.cycler_files import Reading, read_record
from chargetune.battery.identification.pulse_fit import cell_toml
from chargetune.battery.studies.study_file import load_config, problem_of_document

CELL = default_cell()


def study(folder: Path, text: str):
    path = folder / "study.toml"
    path.write_text(text)
    return load_config(path)


def test_the_study_file_says_of_how_many_cells(tmp_path):
    config = study(tmp_path, "[cell]\nseries = 96\nparallel = 3\n[limits]\ncurrent_max_A = 5.0\n")
    problem = config.problem(tmp_path)
    assert (problem.cell.series, problem.cell.parallel) == (96, 3)
    # The same charge as that of one cell: current and voltage are per cell.
    assert replace(problem, cell=CELL) == study(tmp_path, "[limits]\ncurrent_max_A = 5.0\n").problem(tmp_path)
    assert problem.cell.title == "Samsung INR18650-20S, 96s3p pack, values per cell"
    assert "at most 403.2 V" in problem.cell.pack_line
    assert "at most 18 A" in problem.cell.pack_line
    assert problem_of_document(config.document(tmp_path)) == problem


def test_one_cell_leaves_no_entry_in_the_store(tmp_path):
    """So studies of before there were packs resume."""
    for text in ("", "[cell]\nseries = 1\n"):
        config = study(tmp_path, text)
        assert not {"series", "parallel"} & set(config.document(tmp_path)["cell"])
        assert config.problem(tmp_path).cell.pack_line == ""


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[cell]\nseries = 0", "cell.series = 0"),
        ("[cell]\nparallel = 2.5", "cell.parallel = 2.5"),
        ("[cell]\nseries = 96\n[limits]\nvoltage_max_V = 403.2", "voltage_max_V = 403.2, allowed is (2.5, 4.2] V per cell of the pack"),
        ("[cell]\nparallel = 3\n[limits]\ncurrent_max_A = 18.0", "current_max_A = 18.0, allowed is (0, 6] A per cell of the pack"),
    ],
)
def test_what_is_of_the_pack_is_refused_by_name(tmp_path, text, said):
    with pytest.raises(ValueError, match=r".") as caught:
        study(tmp_path, text).problem(tmp_path)
    assert said in str(caught.value)


def test_a_cell_file_may_say_it_and_the_study_file_goes_before(tmp_path):
    path = tmp_path / "cell.toml"
    path.write_text(cell_toml(replace(CELL, series=4, parallel=2)))
    assert load_cell(path).title.endswith("4s2p pack, values per cell")
    problem = study(tmp_path, '[cell]\nfile = "cell.toml"\nseries = 8\n').problem(tmp_path)
    assert (problem.cell.series, problem.cell.parallel) == (8, 2)


def test_a_record_of_a_pack_is_that_of_one_cell(tmp_path):
    time = np.arange(0.0, 400.0, 10.0)
    current = np.where((time > 100) & (time < 200), 2.0, 0.0)
    voltage = 3.7 + 0.05 * current
    paths = []
    # Without a unit, 360 V would be taken for millivolt if it were not divided first.
    for name, series, parallel in (("cell.csv", 1, 1), ("pack.csv", 96, 3)):
        rows = [f"{t},{i * parallel},{v * series}" for t, i, v in zip(time, current, voltage, strict=True)]
        paths.append(tmp_path / name)
        paths[-1].write_text("\n".join(["Test Time / s,Current / A,Voltage", *rows]) + "\n")
    one, other = read_record(paths[0]), read_record(paths[1], Reading(series=96, parallel=3))
    np.testing.assert_allclose(other.current_A, one.current_A, rtol=1e-12)
    np.testing.assert_allclose(other.voltage_V, one.voltage_V, rtol=1e-12)
    assert any("divided by 96 in series, current by 3 in parallel" in remark for remark in other.remarks)
    with pytest.raises(ValueError, match=r"series = 0, allowed is an integer in \[1, 1000\]"):
        Reading(series=0)
