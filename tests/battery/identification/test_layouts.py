"""Files of every layout, as the benchmark of reading writes them, give the record that was simulated; what is known of layouts is whole."""

import sys
from pathlib import Path

import numpy as np
import pytest

from chargetune.battery.identification.cycler_files import Reading, read_record
from chargetune.battery.identification.headings import columns_of, missing, unit_of
from chargetune.battery.identification.layouts import CLOCKS, LAYOUTS, SHORT_UNITS, UNITS
from chargetune.battery.identification.open_circuit import ocv_from_slow
from chargetune.battery.identification.pulse_fit import identify
from chargetune.battery.identification.record import assumptions_told

sys.path.insert(0, str(Path(__file__).parents[3] / "benchmarks"))
from cycler_files import VARIANTS, pulse_test, write
from reading import results, verdict


@pytest.mark.parametrize("layout", LAYOUTS, ids=lambda layout: layout.name)
def test_every_layout_is_read_right(layout, tmp_path):
    test = pulse_test()
    assert verdict(write(tmp_path, layout, "as exported", test), layout, "as exported", test)[0] == "right"


def test_no_variant_is_read_wrong():
    """All variants of some layouts; benchmarks/reading.py has all."""
    chosen = [layout for layout in LAYOUTS if layout.name in {"Arbin", "Neware, nested", "BioLogic, dates", "Digatron", "XLSX, Arbin"}]
    found = results(chosen)
    assert len(found) == len(chosen) * len(VARIANTS)
    assert [row for row in found if row["verdict"] == "wrong"] == []
    assert {row["variant"] for row in found if row["verdict"] == "refused"} == {"bare decimal comma"}


def test_headings_of_every_layout_are_in_the_vocabulary():
    for layout in LAYOUTS:
        columns, _, odd = columns_of(layout.headings)
        assert not missing(columns), layout.name
        assert not odd
        assert (columns["current"].heading, columns["voltage"].heading) == (layout.current, layout.voltage), layout.name
        assert ("temperature" in columns) == bool(layout.temperature), layout.name
        assert ("step" in columns) == bool(layout.step), layout.name


def clock(form):
    def shown(t):
        parts = {"d": int(t // 86400), "h": int(t // 3600), "m": int(t % 3600 // 60), "mm": int(t // 60), "s": t % 60}
        return form.format(**parts)

    return shown


def plain(factor, digits=8):
    return lambda t: f"{factor * t:.{digits}f}"


def table(folder, heading, time, *, current=1.0, voltage=1.0, separator=",", encoding="utf-8", unsigned=False):
    """A file of the pulse test with these headings; ``time`` shows a time in s, the others are factors."""
    test, path = pulse_test(), folder / "odd.csv"
    amps = np.abs(test.current) if unsigned else test.current
    rows = [[time(t), f"{current * i:.5f}", f"{voltage * v:.5f}"] for t, i, v in zip(test.time, amps, test.voltage, strict=True)]
    path.write_bytes("\n".join([heading, *(separator.join(row) for row in rows)]).encode(encoding))
    return path


ODD = {
    "minutes, milli": ("Time (min),Current (mA),Voltage (mV)", plain(1 / 60), {"current": 1e3, "voltage": 1e3}, {}),
    "milliseconds": ("t [ms];I [mA];U [V]", plain(1e3, 0), {"current": 1e3, "separator": ";", "encoding": "cp1252"}, {}),
    "days": ("Test Time (d),Current in A,Voltage in V", plain(1 / 86400, 10), {}, {}),
    "epoch": ("Unix Time / s,Current / A,Voltage / V", lambda t: f"{1.7e9 + t:.3f}", {}, {}),
    "d hh:mm:ss": ("Time (d hh:mm:ss),Current_A,Voltage_V", clock("{d} {h:02d}:{m:02d}:{s:06.3f}"), {}, {}),
    "dd:hh:mm:ss": ("Time,Current(A),Voltage(V)", clock("{d:02d}:{h:02d}:{m:02d}:{s:06.3f}"), {}, {}),
    "mm:ss, said": ("Time,Current(A),Voltage(V)", clock("{mm}:{s:06.3f}"), {}, {"time_unit": "mm:ss"}),
    "a clock of the day": ("Time,Current(A),Voltage(V)", lambda t: clock("{h:02d}:{m:02d}:{s:06.3f}")((t + 80_000) % 86_400), {}, {}),
    "UTF-16 without its mark": ("Test Time(s)\tCurrent(A)\tVoltage(V)", plain(1, 3), {"separator": "\t", "encoding": "utf-16-le"}, {}),
    "Chinese": ("总时间,电流(A),电压(V)", clock("{h:02d}:{m:02d}:{s:06.3f}"), {"encoding": "gb18030"}, {}),
    "German": ("Zeit [h];Strom [mA];Spannung [V]", plain(1 / 3600), {"separator": ";", "current": 1e3}, {}),
    "spaces": ("time/s  I/A  Ewe/V", plain(1, 3), {"separator": "  "}, {}),
    "units below": ("Time,Current,Voltage\n(h),(mA),mV", plain(1 / 3600), {"current": 1e3, "voltage": 1e3}, {}),
    "mA, said": ("Time/s,Current,Voltage", plain(1, 3), {"current": 1e3, "voltage": 1e3}, {"current_unit": "mA"}),
    "without a sign, said": ("Time/s,Current/A,Voltage/V", plain(1, 3), {"unsigned": True}, {"sign": "unsigned"}),
    "discharge positive, said": ("Time/s,Current/A,Voltage/V", plain(1, 3), {"current": -1.0}, {"sign": "discharge"}),
}


@pytest.mark.parametrize("kind", ODD)
def test_odd_headings_and_units_are_read(kind, tmp_path):
    heading, time, how, said = ODD[kind]
    record, test = read_record(table(tmp_path, heading, time, **how), Reading(**said)), pulse_test()
    np.testing.assert_allclose(record.time_s - record.time_s[0], test.time - test.time[0], atol=2e-3)
    np.testing.assert_allclose(record.current_A, test.current, atol=1e-5)
    np.testing.assert_allclose(record.voltage_V, test.voltage, atol=1e-5)


TWO_WAYS = {
    "h:mm or mm:ss": ("Time,Current(A),Voltage(V)", clock("{mm}:{s:06.3f}"), {}, "two parts can be hh:mm or mm:ss .*--time-unit"),
    "days or ms": ("Time,Current(A),Voltage(V)", clock("{d}:{h}:{m}:{s:02.0f}"), {}, "four parts can be .*--time-unit"),
    "A or mA": ("Time/s,Current,Voltage/V", plain(1, 3), {"current": 1e3}, "Current has no unit and reaches 3000.*--current-unit"),
    "ms taken for s": (
        "Time,Current/A,Voltage/V",
        plain(1e3, 0),
        {},
        "gap of 1000 s.*no unit: s was assumed, up to .* s .--time-unit",
    ),
    "no sign": ("Time/s,Current/A,Voltage/V", plain(1, 3), {"unsigned": True}, "rises in 3 of 9 stretches.*--sign unsigned"),
    "another unit": (
        "Time/s,Current/A,Voltage/kV",
        plain(1, 3),
        {},
        r"no column for voltage in a known unit \(Voltage/kV; .* v, mv",
    ),
}


@pytest.mark.parametrize("kind", TWO_WAYS)
def test_what_can_be_read_two_ways_is_refused_with_the_option_that_decides(kind, tmp_path):
    heading, time, how, said = TWO_WAYS[kind]
    with pytest.raises(ValueError, match=said):
        read_record(table(tmp_path, heading, time, **how))


def test_what_was_assumed_is_among_the_remarks(tmp_path):
    record = read_record(table(tmp_path, "Time,Current,Voltage", plain(1, 3)))
    for assumed in ("Time has no unit: s was assumed", "Current has no unit: A was assumed", "Voltage has no unit: V was assumed"):
        assert any(assumed in remark for remark in record.remarks)


@pytest.mark.parametrize(
    ("option", "allowed"), [({"sign": "up"}, "charge"), ({"time_unit": "fortnight"}, "ms"), ({"current_unit": "V"}, "mA")]
)
def test_an_unknown_option_is_refused(option, allowed):
    with pytest.raises(ValueError, match=f"{next(iter(option))} = .*allowed are .*{allowed}"):
        Reading(**option)


@pytest.mark.parametrize(("name", "units"), [("time_unit", (*SHORT_UNITS["time"], *CLOCKS)), ("current_unit", SHORT_UNITS["current"])])
def test_every_unit_is_listed_where_one_is_refused_and_is_accepted(name, units):
    with pytest.raises(ValueError, match=f"allowed are {', '.join(units[:-1])} and {units[-1]}$"):
        Reading(**{name: "lightyear"})
    for unit in units:
        assert getattr(Reading(**{name: unit}), name) == unit
    # One short name for each factor.
    quantity = name.removesuffix("_unit")
    assert sorted(UNITS[quantity][unit_of(u)] for u in SHORT_UNITS[quantity]) == sorted({*UNITS[quantity].values()})


@pytest.mark.parametrize(("unit", "seconds"), [("h", 3600.0), ("min", 60.0), ("d", 86400.0)])
def test_hours_taken_for_seconds_are_refused_with_the_option_that_decides(unit, seconds, tmp_path):
    path = table(tmp_path, "Time,Current/A,Voltage/V", plain(1 / seconds, 10))
    with pytest.raises(ValueError, match=r"0 sets of pulses .*Time has no unit: s was assumed, up to .* s \(--time-unit decides\)$"):
        identify(read_record(path))
    assert read_record(path, Reading(time_unit=unit)).time_s[-1] == pytest.approx(np.ptp(pulse_test().time))
    slow = read_record(path)
    with pytest.raises(ValueError, match=r"passes .* Ah.*Time has no unit.*--time-unit decides"), assumptions_told(slow):
        ocv_from_slow(slow, 3.0, [])


def test_dates_that_disagree_with_a_clock_without_unit_are_refused(tmp_path):
    path = tmp_path / "minutes.csv"
    rows = [
        f"2024-05-06 {8 + k // 60:02d}:{k % 60:02d}:00,{k},{0 if k < 60 else 1},{3.6 + (k >= 60) * (0.1 + 1e-4 * k)}" for k in range(120)
    ]
    path.write_text("\n".join(["Date,Time,Current/A,Voltage/V", *rows]))
    with pytest.raises(ValueError, match=r"the clock Time spans 119 s, the dates in Date 7140 s; Time has no unit, --time-unit decides"):
        read_record(path)
    assert read_record(path, Reading(time_unit="min")).time_s[-1] == pytest.approx(7140.0)


def test_two_sheets_of_one_record_are_joined_and_of_two_refused(tmp_path):
    """By the tables themselves: what a workbook holds is text by then."""
    from chargetune.battery.identification import samples
    from chargetune.battery.identification.tables import Table

    def sheets(*starts):
        rows = [[[f"{t + k}", "1", f"{3 + 0.01 * k}"] for k in range(5)] for t in starts]
        return [Table([["Time/s", "Current/A", "Voltage/V"], *row], f"sheet S{t}") for t, row in zip(starts, rows, strict=True)]

    def read(monkey, *starts):
        monkey.setattr(samples, "tables", lambda path: [sheets(*starts)])
        return samples.read_samples(tmp_path / "book.xlsx")

    with pytest.MonkeyPatch.context() as monkey:
        assert len(read(monkey, 0, 5).numbers) == 10
        with pytest.raises(ValueError, match=r"book\.xlsx has samples in the sheets S0, S0, allowed is one record"):
            read(monkey, 0, 0)


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("cut.parquet", b"PAR1" + b"x" * 100, "no Parquet file that can be read"),
        ("cut.xlsx", b"PK\x03\x04" + b"x" * 100, "no workbook that can be read"),
        ("noise.csv", bytes(range(256)) * 4, "is not text; allowed are text"),
    ],
)
def test_a_damaged_container_is_refused(name, content, said, tmp_path):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=f"^{name} .*{said}"):
        read_record(tmp_path / name)


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("other", ["0", ""])
def test_a_column_for_either_way_is_one_current(sign, other, tmp_path):
    test, path = pulse_test(), tmp_path / "ways.csv"
    rows = [
        (f"{t:.3f}", f"{1e3 * i:.2f}" if i > 0 else other, f"{-sign * 1e3 * i:.2f}" if i < 0 else other, f"{v:.5f}")
        for t, i, v in zip(test.time, test.current, test.voltage, strict=True)
    ]
    heading = ("Time_s", "Charge Current (mA)", "Discharge_Current_mA", "Voltage_V")
    path.write_text("\n".join(",".join(row) for row in (heading, *rows)))
    record = read_record(path)
    np.testing.assert_allclose(record.current_A, test.current, atol=1e-5)
    assert "current is Charge Current (mA) minus Discharge_Current_mA" in record.remarks
    number = next(k for k, i in enumerate(test.current) if i > 0)
    rows[number] = (rows[number][0], "1500", "500", rows[number][3])
    path.write_text("\n".join(",".join(row) for row in (heading, *rows)))
    with pytest.raises(ValueError, match=rf"row {number + 2}: Charge Current \(mA\) = 1.5 A and Discharge_Current_mA = 0.5 A, allowed is"):
        read_record(path)
