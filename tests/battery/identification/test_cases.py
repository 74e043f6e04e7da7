"""Records of a known cell, each with one thing that cyclers' files have: read right, mended where that is safe, or refused by name."""

from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import PchipInterpolator

from chargetune.battery.identification.cycler_files import Reading, read_record
from chargetune.battery.identification.pulse_fit import identify

CASES = Path(__file__).parent / "cases"
# The nearly empty set is up to 1 mohm off in R1, as the OCV bends there between the rests.
LOW = 0.22


def case(name, reading=None):
    return read_record(next(CASES.glob(f"{name}_*")), reading)


def said(found, *parts):
    return any(all(part in remark for part in parts) for remark in found.remarks)


def is_the_known_cell(found, sets, *, R0=0.030, R1=0.020, capacity=3.0, R1_rel=0.02):
    assert len(found.fits) == sets
    assert found.cell.capacity_Ah == pytest.approx(capacity, rel=2e-3)
    for fit in found.fits:
        assert fit.values["R0_ohm"] == pytest.approx(R0, rel=0.01), fit.place
        assert fit.values["R1_ohm"] == pytest.approx(R1, rel=R1_rel if fit.soc > LOW else 0.08), fit.place
        assert fit.values["tau1_s"] == pytest.approx(30.0, rel=0.03 if fit.soc > LOW else 0.1), fit.place


@pytest.mark.parametrize("name", ["12", "13", "14", "15", "16", "17", "18", "23"])
def test_layouts_and_harmless_damage_give_the_known_cell(name):
    found = identify(case(name))
    is_the_known_cell(found, 9)
    assert {"12": said(found, "112 rows are equal"), "23": said(found, "sample 311", "time is 0 s")}.get(name, True)


def test_a_short_first_rest_does_not_move_the_soc():
    found = identify(case("01"))
    is_the_known_cell(found, 8)
    np.testing.assert_allclose([fit.soc for fit in found.fits][:3], [0.894, 0.794, 0.694], atol=2e-3)
    assert said(found, "2 pulses at SOC 1.00 left out", "240 s", "600 s")


def test_pulses_of_about_two_minutes_are_pulses():
    found = identify(case("02"))
    assert len(found.fits) == 8
    assert found.cell.capacity_Ah == pytest.approx(3.0, rel=2e-3)
    np.testing.assert_allclose([fit.values["R0_ohm"] for fit in found.fits], 0.03, rtol=0.01)


def test_a_current_without_a_sign_is_refused_and_read_when_asked():
    with pytest.raises(ValueError, match=r"voltage rises in 1 of 20 stretches \(first at 237\d\d s\).*--sign unsigned"):
        case("03")
    found = identify(case("03", Reading(sign="unsigned")))
    assert found.cell.capacity_Ah == pytest.approx(3.0, rel=2e-3)
    np.testing.assert_allclose([fit.values["R0_ohm"] for fit in found.fits], 0.03, rtol=0.015)


def test_a_current_in_every_rest_is_subtracted():
    found = identify(case("04"))
    is_the_known_cell(found, 9)
    assert said(found, "30 mA in each of its 11 rests", "subtracted")


def test_two_temperatures_are_two_cells():
    record = case("05")
    with pytest.raises(ValueError, match=r"pulses at 2 temperatures, 0, 25 degC; --temperature"):
        identify(record)
    with pytest.raises(ValueError, match=r"temperature_C = 40, allowed are those of its pulses, 0, 25 degC"):
        identify(record, temperature_C=40.0)
    is_the_known_cell(identify(record, temperature_C=25.0), 9)
    is_the_known_cell(identify(record, temperature_C=0.0), 9, R0=0.070, R1=0.050)


def test_hysteresis_is_told_and_its_branches_can_be_chosen():
    """The middle is known, and the branches are 15 mV above and below."""
    record, soc, middle = case("06"), np.array([0.15, 0.20, 0.25, 0.30]), np.array([3.2614, 3.2686, 3.2722, 3.2750])
    for branch, shift in (("middle", 0.0), ("charge", 0.015), ("discharge", -0.015)):
        found = identify(record, branch=branch)
        ocv = PchipInterpolator(found.cell.ocv_soc, found.cell.ocv_V)(soc)
        np.testing.assert_allclose(ocv, middle + shift, atol=1e-3)
        assert said(found, "hysteresis", "29.", "middle" if branch == "middle" else f"after {branch}")
    assert said(found, "set 1 at SOC 0.99", "R1_ohm", "--ocv")
    with pytest.raises(ValueError, match="do not show a hysteresis"):
        identify(case("16"), branch="charge")


def test_three_electrodes_are_one_cell():
    found = identify(case("07"))
    is_the_known_cell(found, 9)
    assert found.fits[0].ocv_V == pytest.approx(4.200, abs=5e-4)
    assert said(found, "Ewe-Ece/V", "not used: Ewe/V")


def test_a_spike_in_a_pulse_is_left_out():
    found = identify(case("08"))
    is_the_known_cell(found, 9)
    assert said(found, "set 5 at SOC 0.59", "-300 mV off", "left out")
    assert found.fits[4].rms_V < 3e-4


def test_one_unfit_set_does_not_refuse_the_others():
    found = identify(case("09"))
    assert len(found.fits) == 8
    np.testing.assert_allclose([fit.values["R0_ohm"] for fit in found.fits], 0.022, rtol=0.01)
    np.testing.assert_allclose([fit.values["R1_ohm"] for fit in found.fits], 0.015, rtol=0.11)
    assert said(found, "left out: set 1 at SOC 1.00", "R1_ohm", "--ocv")
    assert not said(found, "longer pulses")


def test_a_gap_before_a_rest_holds_no_charge():
    record = case("10")
    assert np.ptp(record.charge_Ah) == pytest.approx(3.8308, rel=2e-4)
    found = identify(record, capacity_Ah=3.831)
    # By the voltage 0.29 s after the start of each pulse, from full down.
    jump = np.array([11.02, 10.94, 10.84, 10.67, 10.51, 10.41, 10.31, 10.29, 10.24, 10.23, 10.28, 10.38, 10.51, 10.68, 10.86, 11.05, 11.24])
    np.testing.assert_allclose([1e3 * fit.values["R0_ohm"] for fit in found.fits][:17], jump, rtol=0.05)
    for fit in found.fits:
        assert fit.ocv_V == pytest.approx(fit.measured_V[0], abs=3e-3)


def test_a_clock_of_each_step_loses_nothing():
    found = identify(case("11"))
    is_the_known_cell(found, 9)
    assert case("11").time_s[-1] == pytest.approx(24217.5)
    assert said(found, "once a step")


def test_the_ocv_is_the_rest_and_not_what_the_circuit_makes_of_it():
    found = identify(case("19"), capacity_Ah=4.0)
    np.testing.assert_allclose([fit.ocv_V for fit in found.fits][:2], [4.2001, 4.1017], atol=2e-4)
    assert said(found, "all 10 sets", "mV off the rest", "--rc 2")


def damaged(tmp_path, change):
    """The known record, with what ``change`` does to time, current, voltage and the sample that a pulse begins after."""
    rows = np.genfromtxt(next(CASES.glob("16_*")), delimiter=",", skip_header=1)
    begins = np.flatnonzero((rows[:-1, 1] == 0) & (rows[1:, 1] == -3) & (np.diff(rows[:, 0], prepend=0)[:-1] > 50))
    change(rows, int(begins[3]))
    path = tmp_path / "damaged.csv"
    np.savetxt(path, rows, delimiter=",", header="Time_s,Current_A,Voltage_V", comments="", fmt=("%.3f", "%.5f", "%.5f"))
    return identify(read_record(path))


def put(column, offset, value, *, add=False):
    def change(rows, k):
        rows[k + offset, column] = value + add * rows[k + offset, column]

    return change


DAMAGE = {
    "a spike at the end of a rest": (put(2, 0, 0.1, add=True), ("set 4 at SOC 0.69", "100 mV off")),
    "a spike where a pulse begins": (put(2, 1, -0.2, add=True), ("set 4 at SOC 0.69", "-200 mV off")),
    "a spike of two samples": (lambda rows, k: put(2, 10, 0.15, add=True)(rows, k) or put(2, 11, 0.15, add=True)(rows, k), ("150 mV off",)),
    "a small spike": (put(2, 10, 0.02, add=True), ("set 4 at SOC 0.69", "20 mV off")),
    "a spike in the pause": (put(2, 45, 0.5, add=True), ("set 4 at SOC 0.69", "500 mV off")),
    "a spike of the current": (put(1, 12, -30.0), ("its current is -30 A between -3 A and -3 A",)),
    "a current that was missed": (put(1, 12, 0.0), ("its current is 0 A between -3 A and -3 A",)),
    "a time before the first": (put(0, -5, -5.0), ("its time is -5 s",)),
    "a time after the last": (put(0, -5, 99999.0), ("its time is 99999 s",)),
    "a time of 0 in a pulse": (put(0, 9, 0.0), ("its time is 0 s",)),
}


@pytest.mark.parametrize("kind", DAMAGE)
def test_single_samples_that_are_wrong_are_left_out_and_named(kind, tmp_path):
    change, parts = DAMAGE[kind]
    found = damaged(tmp_path, change)
    is_the_known_cell(found, 9)
    assert said(found, "left out", *parts)


@pytest.mark.parametrize("amperes", [-0.02, 0.1, 0.15])
def test_a_zero_of_the_current_of_some_per_cent_is_subtracted(amperes, tmp_path):
    def change(rows, k):
        rows[:, 1] += amperes

    is_the_known_cell(damaged(tmp_path, change), 9)


def test_a_zero_that_drifts_is_told(tmp_path):
    def change(rows, k):
        rows[:, 1] += 0.04 * rows[:, 0] / rows[-1, 0]

    assert said(damaged(tmp_path, change), "the current reads", "in its 11 rests", "the counted charge is wrong")
