"""Cell: every bad number is refused by name; the default cell is the data of the case study."""

import json
import math
import tomllib
from dataclasses import asdict, replace

import numpy as np
import pytest

from chargetune.battery.cell.cell import Cell, default_cell, load_cell, mismatched
from chargetune.battery.cell.plating import Anode
from chargetune.battery.cell.thermal import Thermal

NINE = tuple(i / 10 for i in range(1, 10))
NAN, INF, YES = math.nan, math.inf, True


def changed(values, index, value):
    out = list(values)
    out[index] = value
    return tuple(out)


CELL = default_cell()
FULL = replace(
    CELL,
    R2_ohm=(0.01,) * 9,
    C2_F=(3e4,) * 9,
    thermal=Thermal(heat_capacity_J_K=45.0, cooling_W_K=0.1, factor_K=(273.15, 298.15, 323.15), factor=(2.0, 1.0, 0.6)),
    anode=Anode((0.0, 0.5, 1.0), (0.3, 0.12, 0.08), (0.01, 0.01, 0.012)),
)

# Field, its bad value -> what the message must say besides the field.
REFUSED = [
    # SOC
    ("soc", changed(NINE, 0, -0.1), ("soc[0] = -0.1", "0..1")),
    ("soc", changed(NINE, 8, 1.2), ("soc[8] = 1.2", "0..1")),
    ("soc", tuple(100 * z for z in NINE), ("soc[0] = 10", "0..1", "not per cent")),
    ("soc", changed(NINE, 3, 0.3), ("soc[3] = 0.3 must be more than soc[2] = 0.3",)),
    ("soc", NINE[::-1], ("soc[1] = 0.8 must be more than soc[0] = 0.9",)),
    ("soc", (0.5,), ("soc has 1 value", "at least 2")),
    ("soc", NINE[:8], ("R0_ohm has 9 values, expected 8",)),
    ("soc", changed(NINE, 2, NAN), ("soc[2] = nan", "finite")),
    ("soc", changed(NINE, 2, "0,3"), ("soc[2] = '0,3'", "finite number")),
    # Open-circuit voltage
    ("ocv_V", changed(CELL.ocv_V, 5, 3.0), ("ocv_V[5] = 3 must not be less than ocv_V[4] = 3.4193", "increases with SOC")),
    ("ocv_V", tuple(v - 0.25 for v in CELL.ocv_V), ("voltage_max_V = 4.2, allowed is at most 4.15 V, 0.2 V above",)),
    ("ocv_V", (3.7,) * 10, ("ocv_V[7] = 3.7 is the same from SOC 0 to 0.8392", "0.5 of the SOC")),
    ("ocv_V", (3.7,) * 5 + (3.75,) * 5, ("ocv_V[7] = 3.75 is the same from SOC 0.2915 to 0.8392",)),
    ("ocv_V", tuple(3.7 + 0.001 * i for i in range(10)), ("ocv_V[-1] = 3.709, allowed is at least 0.05 V above ocv_V[0] = 3.7",)),
    ("ocv_V", CELL.ocv_V[:9], ("ocv_V has 9 values, expected 10",)),
    ("ocv_V", changed(CELL.ocv_V, 1, INF), ("ocv_V[1] = inf", "finite")),
    ("ocv_V", changed(CELL.ocv_V, 1, YES), ("ocv_V[1] = True", "finite number")),
    ("ocv_V", tuple(1000 * v for v in CELL.ocv_V), ("ocv_V[0] = 2500", "at most 5 V", "mV?")),
    ("ocv_V", changed(CELL.ocv_V, 9, 6.0), ("ocv_V[-1] = 6", "at most 5 V")),
    ("ocv_soc", (0.0, 0.5, 1.0), ("ocv_soc has 3 values", "at least 4")),
    ("ocv_soc", changed(CELL.ocv_soc, 0, 0.001), ("ocv_soc = 0.001..1 must cover 0..1",)),
    ("ocv_soc", changed(CELL.ocv_soc, 9, 0.99), ("ocv_soc = 0..0.99 must cover 0..1",)),
    ("ocv_soc", changed(CELL.ocv_soc, 4, CELL.ocv_soc[3]), ("ocv_soc[4] = 0.0854 must be more than ocv_soc[3] = 0.0854",)),
    ("ocv_soc", tuple(100 * z for z in CELL.ocv_soc), ("ocv_soc[2] = 3.52", "not per cent")),
    # Capacity
    ("capacity_Ah", 0.0, ("capacity_Ah = 0", "more than 0")),
    ("capacity_Ah", -2.0, ("capacity_Ah = -2", "more than 0")),
    ("capacity_Ah", NAN, ("capacity_Ah = nan", "finite")),
    ("capacity_Ah", INF, ("capacity_Ah = inf", "finite")),
    ("capacity_Ah", "2,0", ("capacity_Ah = '2,0'", "finite number")),
    ("capacity_Ah", True, ("capacity_Ah = True", "finite number")),
    ("capacity_Ah", 2000.0, ("capacity_Ah = 2000", "at most 1500 Ah", "mAh?")),
    ("capacity_Ah", 800.0, ("current_max_A = 6", "capacity_Ah = 800", "mAh?")),
    ("coulombic_efficiency", 0.0, ("coulombic_efficiency = 0", "more than 0.5 and at most 1")),
    ("coulombic_efficiency", 99.9, ("coulombic_efficiency = 99.9", "at most 1")),
    # Resistances and capacitance
    ("R0_ohm", changed(CELL.R0_ohm, 2, 0.0), ("R0_ohm[2] = 0", "more than 0")),
    ("R0_ohm", changed(CELL.R0_ohm, 2, -0.06), ("R0_ohm[2] = -0.06", "more than 0")),
    ("R1_ohm", tuple(1000 * r for r in CELL.R1_ohm), ("R1_ohm[0] = 39.2", "at most 1 ohm, 2 V at 1C", "milliohm?")),
    ("R0_ohm", tuple(1000 * r for r in CELL.R0_ohm), ("R0_ohm[0] = 62.9", "at most 1 ohm, 2 V at 1C", "milliohm?")),
    ("R1_ohm", changed(CELL.R1_ohm, 0, NAN), ("R1_ohm[0] = nan", "finite")),
    ("R1_ohm", CELL.R1_ohm[:8], ("R1_ohm has 8 values, expected 9",)),
    ("C1_F", changed(CELL.C1_F, 8, 0.0), ("C1_F[8] = 0", "more than 0")),
    ("C1_F", changed(CELL.C1_F, 8, -1.0), ("C1_F[8] = -1", "more than 0")),
    ("C1_F", changed(CELL.C1_F, 8, 1e9), ("C1_F[8] = 1e+09", "R1_ohm[8] x C1_F[8] = 1.98e+07 s", "0.001 to 100000 s")),
    # Limits
    ("voltage_max_V", 2.5, ("voltage_max_V = 2.5 must be more than voltage_min_V = 2.5",)),
    ("voltage_max_V", 2.0, ("voltage_max_V = 2 must be more than voltage_min_V = 2.5",)),
    ("voltage_max_V", 4.45, ("voltage_max_V = 4.45", "at most 4.4 V, 0.2 V", "above the OCV of the full cell")),
    ("voltage_max_V", 4200.0, ("voltage_max_V = 4200", "at most 5 V", "mV?")),
    ("voltage_min_V", 2500.0, ("voltage_min_V = 2500", "at most 5 V", "mV?")),
    ("voltage_min_V", -2.5, ("voltage_min_V = -2.5", "more than 0.5")),
    ("voltage_max_V", NAN, ("voltage_max_V = nan", "finite")),
    ("current_max_A", 0.0, ("current_max_A = 0", "more than 0")),
    ("current_max_A", -6.0, ("current_max_A = -6", "more than 0")),
    ("current_max_A", 6000.0, ("current_max_A = 6000", "at most 200 A")),
    ("current_max_A", INF, ("current_max_A = inf", "finite")),
]


@pytest.mark.parametrize(("name", "value", "said"), REFUSED, ids=[f"{name}-{i}" for i, (name, *_) in enumerate(REFUSED)])
def test_refuses(cell, name, value, said):
    with pytest.raises(ValueError, match="cell: ") as refused:
        replace(cell, **{name: value})
    for part in said:
        assert part in str(refused.value)


def test_limits_at_the_edge_are_accepted(cell):
    assert replace(cell, voltage_max_V=4.4, current_max_A=200.0, coulombic_efficiency=0.99).voltage_max_V == 4.4
    assert replace(cell, current_max_A=0.02).current_max_A == 0.02


def test_lists_become_tuples_of_floats(cell):
    changed_cell = replace(cell, R0_ohm=[0.06] * 9, ocv_soc=[0, *cell.ocv_soc[1:9], 1])
    assert changed_cell.R0_ohm == (0.06,) * 9
    assert isinstance(changed_cell.ocv_soc[0], float)
    assert hash(changed_cell) == hash(replace(changed_cell))


def test_the_default_cell_is_the_data_number_for_number(shared, cell):
    path = shared / "data" / "inr18650-20s.toml"
    data = tomllib.loads(path.read_text(encoding="utf-8"))
    found = asdict(cell)
    for name in ("capacity_Ah", "coulombic_efficiency", "current_max_A", "voltage_min_V", "voltage_max_V"):
        assert found[name] == data[name], name
    assert found["name"] == data["name"]
    for field, (table, key) in {
        "soc": ("ecm", "soc"),
        "R0_ohm": ("ecm", "R0_ohm"),
        "R1_ohm": ("ecm", "R1_ohm"),
        "C1_F": ("ecm", "C1_F"),
        "ocv_soc": ("ocv", "soc"),
        "ocv_V": ("ocv", "V"),
    }.items():
        assert list(found[field]) == data[table][key], field
    assert "stand-in" in cell.remark
    assert load_cell(path) == replace(cell, remark=str(data.get("remark", "")))


def test_mismatch_is_drawn_in_the_stated_order(cell):
    for seed in range(4):
        draw = np.random.default_rng(seed)
        expected = {}
        for name in ("R0_ohm", "R1_ohm", "C1_F"):
            factors = 1 + draw.uniform(-0.5, 0.5, 9)
            expected[name] = [value * factor for value, factor in zip(getattr(cell, name), factors, strict=True)]
        wrong = mismatched(cell, seed)
        for name, values in expected.items():
            assert list(getattr(wrong, name)) == values
        untouched = {n: v for n, v in asdict(wrong).items() if n not in expected}
        assert untouched == {n: v for n, v in asdict(cell).items() if n not in expected}


@pytest.mark.parametrize("seed", range(6))
def test_mismatch_is_that_of_the_reference(cell, shared, seed):
    cases = {c["name"]: c for c in json.loads((shared / "reference" / "p0.json").read_text())["cases"]}
    wrong = mismatched(cell, seed)
    for name, values in cases[f"seed{seed}"]["controller"].items():
        np.testing.assert_allclose(getattr(wrong, name), values, rtol=1e-14)


def toml(cell, **changes):
    data = {k: v for k, v in asdict(cell).items() if v or k == "remark"}
    tables = {
        "ecm": {k: data.pop(k) for k in ("soc", *cell.tables)},
        "ocv": {"soc": data.pop("ocv_soc"), "V": data.pop("ocv_V")},
    }
    tables |= {k: data.pop(k) for k in ("thermal", "anode") if k in data}
    lines = [f"{k} = {json.dumps(v)}" for k, v in (data | changes).items() if v is not None]
    for table, values in tables.items():
        lines += [f"[{table}]", *(f"{k} = {json.dumps(v)}" for k, v in values.items())]
    return "\n".join(lines)


def test_a_file_with_all_its_tables_there_and_back(cell, tmp_path):
    path = tmp_path / "cell.toml"
    path.write_text(toml(FULL))
    assert load_cell(path) == FULL
    assert (cell.pairs, FULL.pairs) == ((1,), (1, 2))


def test_a_file_there_and_back(cell, tmp_path):
    path = tmp_path / "cell.toml"
    path.write_text(toml(cell))
    assert load_cell(path) == cell
    path.write_bytes(b"\xef\xbb\xbf" + toml(cell).encode())  # with a byte order mark
    assert load_cell(path) == cell


@pytest.mark.parametrize(
    ("edit", "said"),
    [
        (lambda text: text.replace("capacity_Ah = 2.0", "capacity_Ah = 2,0"), ("not valid TOML",)),
        (lambda text: text.replace("capacity_Ah", "capacity_mAh"), ("capacity_mAh is not a known key; did you mean capacity_Ah?",)),
        (lambda text: text.replace("R0_ohm", "R0_Ohm"), ("table [ecm]: R0_Ohm is not a known key; did you mean R0_ohm?", "are C1_F, ")),
        (lambda text: text + "\n[thermal]\ncooling_W_K = 1", ("table [thermal]: heat_capacity_J_K is not given, and needed",)),
        (lambda text: text + "\n[thermal]\ncooling_W_K = 1\nheat_capacity_J_K = 50\nambient_K = 25", ("ambient_K = 25", "degC")),
        (lambda text: text + "\n[anode]\nsoc = [0, 1]\npotential_V = [0.2]\nresistance_ohm = [0.1]", ("have 2, 1 and 1 values",)),
        (lambda text: text.replace("[ocv]", "R2_ohm = [0.01]\n[ocv]"), ("R2_ohm and C2_F are given together",)),
        (lambda text: text.replace("capacity_Ah = 2.0", "capacity_Ah = true"), ("capacity_Ah = True", "finite number")),
        (lambda text: text.replace("capacity_Ah = 2.0", 'capacity_Ah = "2.0"'), ("capacity_Ah = '2.0'", "finite number")),
        (lambda text: text.replace("capacity_Ah = 2.0", "capacity_Ah = nan"), ("capacity_Ah = nan", "finite number")),
        (lambda text: text.replace("[ecm]", "[[ecm]]"), ("ecm = [", "expected a table [ecm]")),
        (lambda text: text.replace("soc = [0.1,", 'soc = "0.1" #'), ("ecm.soc = '0.1'", "expected a list of numbers")),
        (lambda _text: "", ("capacity_Ah, ", "ecm", "ocv", " are not given, and needed")),
        (lambda text: text.replace("ocv", "OCV"), ("OCV is not a known key; did you mean ocv?",)),
    ],
)
def test_a_bad_file_is_named_with_the_field(cell, tmp_path, edit, said):
    path = tmp_path / "my-cell.toml"
    path.write_text(edit(toml(cell)))
    with pytest.raises(ValueError, match=r"my-cell\.toml") as refused:
        load_cell(path)
    for part in said:
        assert part in str(refused.value)


def test_a_file_that_is_not_text(tmp_path):
    path = tmp_path / "my-cell.toml"
    path.write_bytes(b"\xff\xfe\x00n")
    with pytest.raises(ValueError, match=r"my-cell\.toml is not valid TOML"):
        load_cell(path)


def test_a_missing_file(tmp_path):
    with pytest.raises(FileNotFoundError, match="nowhere"):
        load_cell(tmp_path / "nowhere.toml")


def test_construction_refuses_missing_numbers():
    with pytest.raises(TypeError, match="voltage_max_V"):
        Cell(name="x", capacity_Ah=1.0)
