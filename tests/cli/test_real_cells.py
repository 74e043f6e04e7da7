"""identify and compare as a user runs them."""

import json
import re
from pathlib import Path

import pytest
from commands import chargetune

from chargetune.battery.cell.cell import load_cell
from chargetune.battery.studies.study_file import load_config
from study_text import study_text

pytestmark = pytest.mark.usefixtures("virtual_machine")

EXAMPLES = Path(__file__).parents[2] / "examples"
# A study of the black box on an electrochemical cell.
RELEASED = Path(__file__).parents[1] / "battery" / "studies" / "data" / "released"


def test_identify_writes_a_cell_that_a_study_takes(shared, tmp_path):
    pulses = shared / "data" / "nissanleaf_cell-low-current-hppc-25c-2.csv"
    discharge = shared / "data" / "nissanleaf_cell-discharge-bitrode-1c.csv"
    cell, figure = tmp_path / "leaf.toml", tmp_path / "leaf.png"
    done = chargetune("identify", pulses, "--rc", 2, "-o", cell, "--figure", figure, "--check", discharge, "--name", "Leaf", "--json")
    found = json.loads(done.stdout)
    assert len(found["points"]) == 10
    assert sum(point["rms_mV"] <= 1.2 for point in found["points"]) >= 9
    assert set(found["points"][0]) >= {"soc", "rms_mV"}
    assert found["seconds"] < 10
    assert found["checks"][0]["rms_mV"] < 40
    assert figure.stat().st_size > 10_000
    assert load_cell(cell).name == "Leaf"
    # The file says where its numbers come from.
    assert re.search(rf"{pulses.name}: 10 SOC points, 2-RC, rms at most 0\.\d\d mV\. Fitted 20\d\d-\d\d-\d\d\.", load_cell(cell).remark)
    assert "# 3 V to 4.203 V and 30 A are the extremes of the record" in cell.read_text()
    (tmp_path / "study.toml").write_text('[cell]\nfile = "leaf.toml"\n[limits]\ncurrent_max_A = 20.0\n[episode]\nsteps = 20\n')
    out = json.loads(chargetune("simulate", tmp_path / "study.toml", "--json").stdout)
    assert out["soc"][-1] > 0.05
    text = chargetune("identify", pulses, "-o", cell, "--overwrite").stdout
    assert "R0 mΩ" in text
    assert "capacity 30.5" in text


def test_identify_refuses_what_holds_no_circuit(shared, tmp_path, refused):
    said = refused("identify", shared / "data" / "beep_2017-05-09_test-TC-contact_CH33.csv", "-o", tmp_path / "cell.toml")
    assert "0 sets of pulses after a rest" in said
    assert not (tmp_path / "cell.toml").exists()
    assert "format 'bmp'" in refused("identify", tmp_path / "data.csv", "--figure", "fit.bmp")
    assert "nothing.csv" in refused("identify", tmp_path / "nothing.csv")
    # A check that cannot be made leaves no cell behind.
    pulses = shared / "data" / "nissanleaf_cell-low-current-hppc-25c-2.csv"
    assert "no discharge of at least half" in refused("identify", pulses, "-o", tmp_path / "cell.toml", "--check", pulses)
    assert not (tmp_path / "cell.toml").exists()


QUICK = study_text(study={"name": "quick", "trials": 5}, controller={"mismatch_seed": 1}, episode={"steps": 200})


def test_compare_prints_the_table_draws_and_takes_the_tuned_controller(tmp_path):
    (tmp_path / "quick.toml").write_text(QUICK)
    chargetune("tune", tmp_path / "quick.toml", "--store", tmp_path / "s.sqlite")
    figure = tmp_path / "compare.pdf"
    done = chargetune("compare", tmp_path / "quick.toml", "--store", tmp_path / "s.sqlite", "--figure", figure, "--json", "--workers", 1)
    rows = {row["name"]: row for row in json.loads(done.stdout)["rows"]}
    assert list(rows)[-1] == "tuned"
    assert set(rows["tuned"]) >= {"name", "t80_min", "t90_min", "worst_excess", "breaks_limit"}
    assert set(rows["tuned"]["worst_excess"]) == {"voltage_mV", "anode_mV", "temperature_K"}
    assert rows["nominal MPC"]["breaks_limit"]
    assert not rows["plant oracle"]["breaks_limit"]
    assert rows["plant oracle"]["t80_min"] == pytest.approx(23.4, abs=0.1)
    assert figure.stat().st_size > 5_000
    (tmp_path / "short.toml").write_text(QUICK.replace("steps = 200", "steps = 20"))
    text = chargetune("compare", tmp_path / "short.toml").stdout
    assert "plant oracle" in text
    assert "tuned" not in text.split("--store")[0]


def test_compare_refuses_before_it_charges(tmp_path, refused):
    (tmp_path / "quick.toml").write_text(QUICK)
    assert "format 'bmp'" in refused("compare", tmp_path / "quick.toml", "--figure", "fit.bmp")
    assert "nothing.sqlite" in refused("compare", tmp_path / "quick.toml", "--store", tmp_path / "nothing.sqlite")


def test_the_electrochemical_example_is_what_it_says():
    problem = load_config(EXAMPLES / "dfn_fast_charge.toml").problem(EXAMPLES)
    assert problem.plant.model == "DFN"
    assert {limit.name: limit.kind for limit in problem.limits_by_name.values()}["anode_min_V"] == "scored"
    assert problem.sensors.noise_sd == {"voltage_V": 0.002}
    assert problem.estimator.kind == "offset_free"
    assert problem.range is not None


def test_tuning_an_electrochemical_plant_resumes_and_draws(tmp_path):
    text = (RELEASED / "dfn_fast_charge.toml").read_text().replace('"DFN"\n', '"SPM"\n').replace("steps = 360", "steps = 40")
    (tmp_path / "okane2022.toml").write_text((EXAMPLES / "okane2022.toml").read_text())
    (tmp_path / "spm.toml").write_text(text)
    command = "tune", tmp_path / "spm.toml", "--store", tmp_path / "s.sqlite", "--json"
    chargetune(*command, "--trials", 1)
    done = chargetune(*command, "--trials", 2, "--out", tmp_path / "out")
    found = json.loads(done.stdout)
    assert (found["trials"], found["failed"]) == (2, 0)
    assert {"temperature_max_excess_K", "anode_min_excess_mV"} <= set(found["untuned"]["metrics"])
    assert {p.name for p in (tmp_path / "out").glob("*.png")} >= {"trajectories.png", "current_limit.png", "backoff.png"}
