"""identify on cyclers' files as a user runs it: one cell for each temperature, and the options that decide what a file leaves open."""

import json
from pathlib import Path

import pytest
from commands import chargetune

from chargetune.battery.cell.cell import load_cell

pytestmark = pytest.mark.usefixtures("virtual_machine")

CASES = Path(__file__).parents[1] / "battery" / "identification" / "cases"


def test_two_temperatures_give_two_cells(tmp_path):
    data, out = CASES / "05_two_temperatures.csv", tmp_path / "cell.toml"
    document = json.loads(chargetune("identify", data, "-o", out, "--json").stdout)
    assert [cell["temperature_C"] for cell in document["cells"]] == [0.0, 25.0]
    assert not out.exists()
    for name, ohm in (("cell_0degC.toml", 0.070), ("cell_25degC.toml", 0.030)):
        assert load_cell(tmp_path / name).R0_ohm == pytest.approx([ohm] * 9, rel=0.01)
    text = chargetune("identify", data, "-o", out, "--overwrite").stdout
    # (R0 + R1) at 0 and at 25 degree Celsius: 120 and 50 mohm; E = R ln(120 / 50) / (1 / 273.15 K - 1 / 298.15 K).
    assert "activation energy 23.7 kJ/mol" in text
    assert f"chargetune init --cell {tmp_path / 'cell_0degC.toml'}" in text
    one = json.loads(chargetune("identify", data, "-o", out, "--temperature", 25, "--json").stdout)
    assert (one["temperature_C"], len(one["points"])) == (25.0, 9)
    assert load_cell(out).R0_ohm == pytest.approx([0.03] * 9, rel=0.01)


def test_the_options_decide_what_the_file_leaves_open(tmp_path, refused):
    out = tmp_path / "cell.toml"
    unsigned = CASES / "03_unsigned_discharge_only.csv"
    assert "--sign unsigned takes it from the voltage" in refused("identify", unsigned, "-o", out)
    found = json.loads(chargetune("identify", unsigned, "-o", out, "--sign", "unsigned", "--json").stdout)
    assert found["capacity_Ah"] == pytest.approx(3.0, rel=2e-3)
    assert "hysteresis" in "".join(
        json.loads(
            chargetune("identify", CASES / "06_lfp_hysteresis.csv", "-o", out, "--overwrite", "--branch", "charge", "--json").stdout
        )["remarks"]
    )
    assert "--time-unit = 'week', allowed are s, ms, us, min, h, d, hh:mm" in refused(
        "identify", unsigned, "-o", out, "--time-unit", "week"
    )
    assert "allowed are those of its pulses, 0, 25 degC" in refused(
        "identify", CASES / "05_two_temperatures.csv", "-o", out, "--overwrite", "--temperature", 60
    )


def test_a_refusal_names_the_option(tmp_path, refused):
    file, out = CASES / "16_underscore_units.csv", ["-o", tmp_path / "cell.toml"]
    assert "--temperature = 25, but there is no column" in refused("identify", file, *out, "--temperature", 25)
    assert "--capacity-Ah = 1, allowed is at least" in refused("identify", file, *out, "--capacity-Ah", 1)
    assert "--current-unit = 'V', allowed are A" in refused("identify", file, *out, "--current-unit", "V")


def test_what_was_left_out_is_in_the_summary_and_in_the_cell_file(tmp_path):
    out = tmp_path / "cell.toml"
    text = chargetune("identify", CASES / "09_full_knee.csv", "-o", out).stdout
    for said in (text, out.read_text()):
        assert "left out: set 1 at SOC 1.00: the data do not hold R1_ohm" in said
