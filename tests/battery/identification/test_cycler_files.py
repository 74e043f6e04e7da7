"""One reader for what cyclers write; every bad file refused by name."""

import numpy as np
import pytest

from chargetune.battery.identification.cycler_files import read_record

# The same measurement in every dialect: 10 s rest, 20 s of 1.5 A, 10 s rest; a charge.
TIME = [0, 10, 20, 30, 40, 50]
CURRENT = [0, 0, 1.5, 1.5, 0, 0]
VOLTAGE = [3.6, 3.6, 3.7, 3.71, 3.65, 3.64]


def table(head, row, separator=",", before=()):
    lines = [*before, head, *(separator.join(row(t, i, v)) for t, i, v in zip(TIME, CURRENT, VOLTAGE, strict=True))]
    return "\n".join(lines) + "\n"


def comma(value):
    return str(value).replace(".", ",")


DIALECTS = {
    "Bitrode": table(
        "Exclude,Time(s),Cycle,Step,StepTime(s),Current(A),Voltage(V),Mode",
        lambda t, i, v: ["No", f"{t}", "1", "4", "1.0", f"{i}", f"{v}", "CHRG"],
    ),
    "Arbin": table(
        "Data_Point,Test_Time,Step_Time,Current,Voltage,Temperature", lambda t, i, v: ["1", f"{t}", "0", f"{i}", f"{v}", "25.0"]
    ),
    "Neware": table(
        "Record ID;Time;Current(mA);Voltage(V)", lambda t, i, v: ["1", f"{t % 20 if t else 0}", comma(1000.0 * i), comma(v)], ";"
    ),
    "Neware h:min:s.ms": table(
        "Record Index,Relative Time(h:min:s.ms),Cur(mA),Voltage(V)", lambda t, i, v: ["1", f"0:00:{t:02d}.000", f"{1000 * i}", f"{v}"]
    ),
    "decimal commas everywhere": table("Time(s);Current(A);Voltage(V)", lambda t, i, v: [comma(float(t)), comma(float(i)), comma(v)], ";"),
    "decimal commas, tabs, a long preamble": table(
        "time/s\tI/mA\tEwe/V",
        lambda t, i, v: [comma(float(t)), comma(1000.0 * i), comma(v)],
        "\t",
        ["EC-Lab ASCII FILE", "a remark, with, many, commas, in, it, , , , , , , , , , , , ,"],
    ),
    "quoted decimal commas": table('"Time(s)","Current(A)","Voltage(V)"', lambda t, i, v: [f'"{comma(float(x))}"' for x in (t, i, v)]),
    "BDF of machines": table("test_time_second,voltage_volt,current_ampere", lambda t, i, v: [f"{t}", f"{v}", f"{i}"]),
    "Neware clock": table("Total Time,Current(A),Voltage(V)", lambda t, i, v: [f"0:00:{t:02d}", f"{i}", f"{v}"]),
    "BioLogic": table(
        "mode\ttime/s\tEcell/V\tI/mA",
        lambda t, i, v: ["1", f"{t}", f"{v}", f"{1000 * i}"],
        "\t",
        ["EC-Lab ASCII FILE", "Nb header lines : 3"],
    ),
    "BDF": table("Test Time / s,Voltage / V,Current / A", lambda t, i, v: [f"{t}", f"{v}", f"{i}"]),
    "reversed sign": table("Test Time / s,Voltage / V,Current / A", lambda t, i, v: [f"{t}", f"{v}", f"{-i}"]),
    "hours and millivolts": table("Time(h),Voltage(mV),Current(A)", lambda t, i, v: [f"{t / 3600!r}", f"{1000 * v}", f"{i}"]),
}


@pytest.mark.parametrize("dialect", DIALECTS)
@pytest.mark.parametrize("mark", [b"", b"\xef\xbb\xbf"])
def test_every_dialect_reads_the_same(dialect, mark, tmp_path):
    path = tmp_path / "data.csv"
    path.write_bytes(mark + DIALECTS[dialect].encode())
    record = read_record(path)
    np.testing.assert_allclose(record.current_A, CURRENT, atol=1e-9)
    np.testing.assert_allclose(record.voltage_V, VOLTAGE, atol=1e-9)
    if dialect == "Neware":
        # The clock starts at 0 in each step, so what lies between two steps is not in the file.
        np.testing.assert_allclose(record.time_s, [0, 10, 10, 20, 20, 30], atol=1e-6)
        assert "restarts" in record.remarks[0]
    else:
        np.testing.assert_allclose(record.time_s, TIME, atol=1e-6)
    assert (record.temperature_K is not None) == (dialect == "Arbin")
    if dialect == "Arbin":
        np.testing.assert_allclose(record.temperature_K, 298.15)
    assert any("sign" in remark for remark in record.remarks) == (dialect == "reversed sign")


def test_a_temperature_with_holes_is_left_out(tmp_path):
    path = tmp_path / "data.csv"
    path.write_text(DIALECTS["Arbin"].replace("3.71,25.0", "3.71,"))
    record = read_record(path)
    assert record.temperature_K is None
    assert "row 5: Temperature = ''" in record.remarks[0]
    path.write_text(DIALECTS["Arbin"].replace("Temperature", "Temperature / K").replace("25.0", "300"))
    np.testing.assert_allclose(read_record(path).temperature_K, 300.0)


def test_charge_by_hand(tmp_path):
    path = tmp_path / "data.csv"
    path.write_text(DIALECTS["BDF"])
    record = read_record(path)
    np.testing.assert_allclose(record.charge_Ah, np.array([0, 0, 15, 30, 30, 30]) / 3600)
    assert len(record.part(1, 4)) == 3


BDF = DIALECTS["BDF"]
REFUSED = {
    "empty": ("", ("is empty",)),
    "only a header": ("Time(s),Current(A),Voltage(V)\n", ("0 rows of numbers", "at least 2")),
    "wrong columns": ("a,b,c\n1,2,3\n2,3,4\n", ("no column for time, current, voltage", "a, b, c")),
    "misspelt column": (BDF.replace("Voltage", "Volatge"), ("no column for voltage", "Volatge")),
    "not a number": (BDF.replace("3.71", "n/a"), ("row 5", "Voltage / V = 'n/a'", "a number")),
    "not finite": (BDF.replace("3.71", "nan"), ("row 5", "'nan'", "finite")),
    "time falls": (
        BDF.replace("\n40,", "\n250,").replace("\n50,", "\n400,").replace("\n30,", "\n300,"),
        ("sample 5", "after 300 s", "increasing"),
    ),
    "time falls a little": (BDF.replace("\n20,", "\n9,"), ("sample 3", "time = 9 s after 10 s", "increasing")),
    "time stands": ("Time(s),Current(A),Voltage(V)\n" + "".join(f"5,1,3.6{k}\n" for k in range(20)) + "6,0,3.5\n", ("time stands at 5 s",)),
    "a gap": (BDF.replace("\n30,", "\n900,").replace("\n40,", "\n910,").replace("\n50,", "\n920,"), ("sample 4", "gap of 880 s", "300 s")),
    "a gap before a current": (
        BDF.replace("\n20,", "\n820,").replace("\n30,", "\n830,").replace("\n40,", "\n840,").replace("\n50,", "\n850,"),
        ("sample 3", "gap of 810 s", "300 s"),
    ),
    "bare decimal commas": ("Time(s),Current(A),Voltage(V)\n0,0,1,5,3,7\n1,0,1,5,3,8\n", ("row 2 has 6 cells", "3 as in the header")),
    "two decimal marks": ("Time(s);Current(A);Voltage(V)\n0,0;1.5;3,7\n", ("row 2", "'1.5'", "other decimal mark")),
    "unknown unit": (BDF.replace("Voltage / V", "Voltage / kV"), ("no column for voltage", "Known names and units")),
    "a lost contact": (BDF.replace("3.71", "0.0"), ("sample 4", "voltage is 0 V")),
    "current without a sign": (
        "Time(s),Current(A),Voltage(V)\n0,0,3.6\n1,2,3.5\n2,2,3.49\n3,0,3.58\n4,2,3.7\n5,0,3.6\n",
        ("rises with the current in 2 jumps and falls in 2", "a current with a sign"),
    ),
    "millivolts": (BDF.replace(",3.", ",3"), ("allowed is 0 to 10 V", "mV?")),
    "milliamperes": (BDF.replace(",1.5", ",15000"), ("largest current is 15000 A", "mA?")),
    "no current": (BDF.replace(",1.5", ",0"), ("largest current is 0 A",)),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_a_bad_file_is_refused_by_name(kind, tmp_path):
    content, said = REFUSED[kind]
    path = tmp_path / "mine.csv"
    path.write_text(content)
    with pytest.raises(ValueError, match=r"mine\.csv") as caught:
        read_record(path)
    for part in said:
        assert part in str(caught.value)


def test_a_missing_file(tmp_path):
    with pytest.raises(FileNotFoundError):
        read_record(tmp_path / "nothing.csv")


def test_the_arbin_file_loads(shared):
    record = read_record(shared / "data" / "beep_2017-05-09_test-TC-contact_CH33.csv")
    assert len(record) == 287
    # 6C of a 1.1 Ah cell, charging, at 25 degree Celsius.
    assert record.current_A[0] == pytest.approx(6.6, abs=0.01)
    assert record.temperature_K[0] == pytest.approx(298.32, abs=0.01)
    assert record.charge_Ah[-1] > 0.5


def test_the_bitrode_files_load(shared):
    for rate, current in ((1, -30.6), (2, -61.2), (3, -91.8)):
        record = read_record(shared / "data" / f"nissanleaf_cell-discharge-bitrode-{rate}c.csv")
        assert record.current_A.min() == pytest.approx(current, abs=0.2)
        assert np.all(np.diff(record.time_s) >= 0)
