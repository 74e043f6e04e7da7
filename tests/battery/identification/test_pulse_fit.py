"""Identification: known cells come back, real pulses are fitted as well as they can be, what data do not hold is refused."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import PchipInterpolator

from chargetune.battery.cell.cell import default_cell, load_cell
from chargetune.battery.cell.equivalent_circuit import ecm_model, start_state
from chargetune.battery.cell.plating import Anode
from chargetune.battery.cell.thermal import Thermal
from chargetune.battery.charging.evaluate import run_charge
from chargetune.battery.charging.verdict import score_episode
from chargetune.battery.identification.cycler_files import read_record
from chargetune.battery.identification.plausibility import checked
from chargetune.battery.identification.pulse_fit import cell_toml, identify, predicted_voltage
from chargetune.battery.identification.pulses import find_pulse_sets, groups
from chargetune.battery.identification.record import Record, segments
from chargetune.battery.identification.thermal import activation_energy, with_thermal
from chargetune.battery.identification.virtual_bench import pulse_test, record_csv, slow_cycle
from chargetune.battery.plants.steppable import as_steppable
from chargetune.plants.simulated import SimulatedPlant
from charging_problems import charging_problem

pytestmark = pytest.mark.usefixtures("virtual_machine")

# Tables so flat that splines between nodes do not matter; time constants that pulses of 60 s can tell.
TRUE = replace(
    default_cell(),
    soc=(0.2, 0.5, 0.8), R0_ohm=(0.03, 0.03, 0.03), R1_ohm=(0.02, 0.02, 0.02), C1_F=(1000.0, 1000.0, 1000.0),
)  # fmt: skip
TWO = replace(TRUE, C1_F=(200.0,) * 3, R2_ohm=(0.015,) * 3, C2_F=(2500.0,) * 3)


def measured(cell, *, pulse_s=60.0, points=6, voltage_min_V=2.6):
    def sampled(seconds):
        return as_steppable(SimulatedPlant(ecm_model(cell, seconds), start_state(cell, 1.0)))

    return pulse_test(sampled, capacity_Ah=cell.capacity_Ah, voltage_min_V=voltage_min_V, points=points, pulse_s=pulse_s)


@pytest.mark.parametrize(("cell", "rc"), [(TRUE, 1), (TWO, 2)])
def test_a_known_circuit_comes_back(cell, rc):
    found = identify(measured(cell, voltage_min_V=3.35), rc=rc, capacity_Ah=2.0)
    assert len(found.fits) == 5
    # Not at the full end, where the OCV between rests is bent most: the fit is that of the circuit itself.
    for fit in found.fits[1:]:
        assert fit.rms_V < 1e-3
        for name in cell.tables:
            assert fit.values[name] == pytest.approx(getattr(cell, name)[0], rel=0.25 if name[1] == "2" else 0.12), name
    assert found.cell.capacity_Ah == 2.0


def test_a_slow_cycle_tells_the_ocv_from_empty_to_full():
    """Against the table of the circuit it ran on; it ends as full as it began, because the current falls at the limit."""
    cell = default_cell()
    plant = as_steppable(SimulatedPlant(ecm_model(cell, 60.0), start_state(cell, 1.0)))
    slow = slow_cycle(plant, capacity_Ah=cell.capacity_Ah, voltage_min_V=cell.ocv_V[0], voltage_max_V=4.2)
    assert slow.charge_Ah[-1] == pytest.approx(0.0, abs=2e-3 * cell.capacity_Ah)
    found = identify(measured(cell), ocv=slow, capacity_Ah=cell.capacity_Ah).cell
    soc = np.linspace(0.1, 1.0, 200)
    true, rests = PchipInterpolator(cell.ocv_soc, cell.ocv_V)(soc), identify(measured(cell), capacity_Ah=cell.capacity_Ah).cell
    off, without = (np.max(np.abs(PchipInterpolator(c.ocv_soc, c.ocv_V)(soc) - true)) for c in (found, rests))
    assert off < 2e-3
    assert without > 5e-3


def test_the_stated_standard_deviation_is_that_of_repetitions():
    """White noise on one set of pulses, where the circuit is right: the spread over repetitions is the stated one."""
    exact = measured(TRUE)
    values, stated = [], []
    for seed in range(12):
        noise = 1e-3 * np.random.default_rng(seed).standard_normal(len(exact))
        fit = identify(replace(exact, voltage_V=exact.voltage_V + noise), capacity_Ah=2.0).fits[2]
        values.append([fit.values["R1_ohm"], fit.values["C1_F"], fit.ocv_V])
        stated.append([fit.sd["R1_ohm"], fit.sd["C1_F"], fit.sd["ocv_V"]])
    ratio = np.std(values, axis=0) / np.mean(stated, axis=0)
    assert np.all((ratio > 0.5) & (ratio < 2.0)), ratio


def test_capacity_is_the_charge_between_full_and_empty():
    found = identify(measured(TRUE))
    assert found.cell.capacity_Ah == pytest.approx(2.0, rel=0.02)
    assert any("capacity" in remark for remark in found.remarks)
    with pytest.raises(ValueError, match=r"capacity_Ah = 1, allowed is at least"):
        identify(measured(TRUE), capacity_Ah=1.0)


def test_pulses_and_rests_are_found():
    record = measured(TRUE, points=4)
    sets = find_pulse_sets(record)
    assert len(sets) == 4
    for part in sets:
        pulses = part.of(record)
        assert pulses.current_A[0] == 0.0
        assert pulses.time_s[-1] - pulses.time_s[0] == pytest.approx(110.0)
        assert [sign for *_, sign in segments(pulses)] == [0, -1, 0, 1]


def several_rates(cell, noise_V):
    """Three sets of pulses of three currents at each of six SOC, with 20 minutes of rest between them."""
    plants = {seconds: as_steppable(SimulatedPlant(ecm_model(cell, seconds), start_state(cell, 1.0))) for seconds in (0.5, 10.0, 60.0)}
    state, rows = plants[0.5].start, [(0.0, 0.0, 0.0)]
    for _ in range(6):
        pulses = [part for rate in (1, 2, 3) for part in ((0.5, -rate, 10), (0.5, 0, 40), (0.5, 0.75 * rate, 10), (60.0, 0, 1200))]
        for step, rate, seconds in ((60.0, 0, 3600), *pulses, (10.0, -1 / 3, 1500)):
            for _ in range(round(seconds / step)):
                _, end, state = plants[step].ahead(state, rate * cell.capacity_Ah)
                rows.append((rows[-1][0] + step, rate * cell.capacity_Ah, float(end[0])))
    time, current, voltage = np.array(rows[1:]).T
    noise = noise_V * np.random.default_rng(0).standard_normal(time.size)
    return Record("several rates", time, current, np.round(voltage + noise, 3))


def test_pulses_of_several_currents_make_one_node_at_each_soc():
    found = identify(several_rates(TRUE, 3e-4), capacity_Ah=2.0)
    assert len(found.fits) == 18
    assert len(found.cell.soc) == 6
    assert np.all(np.diff(found.cell.soc) > 0.1)
    np.testing.assert_allclose(found.cell.R0_ohm, 0.03, rtol=0.03)
    # Not at the full end, as above.
    np.testing.assert_allclose(found.cell.R1_ohm[:-1], 0.02, rtol=0.12)
    assert groups(np.array([0.1, 0.11, 0.121, 0.13, 0.5]))[1].tolist() == [2, 3]


def test_a_rest_logged_without_its_end_gives_the_same_cell():
    record = measured(TRUE)
    rest = np.abs(record.current_A) < record.rest_A
    last = np.append(rest[:-1] & ~rest[1:] & (np.diff(record.time_s, prepend=0.0)[:-1] > 30), False)
    sparse = Record("sparse", *(values[~last] for values in (record.time_s, record.current_A, record.voltage_V)))
    assert len(sparse) == len(record) - 6
    found, whole = identify(checked(sparse)), identify(record)
    for name in ("R0_ohm", "R1_ohm", "C1_F", "ocv_V"):
        np.testing.assert_allclose(getattr(found.cell, name), getattr(whole.cell, name), rtol=1e-6)


def test_pulses_that_do_not_reach_an_end_are_told():
    found = identify(measured(TRUE, points=6), capacity_Ah=2.3)
    assert any("the pulses reach from SOC 0.2" in remark for remark in found.remarks)


def test_any_name_makes_a_file(tmp_path):
    for name in ('line\nbreak = "1"', "tab\t\\ \x7f \u2028 Zelle µ"):
        path = tmp_path / "cell.toml"
        path.write_text(cell_toml(replace(TRUE, name=name, remark=name), notes=[name]), encoding="utf-8")
        assert (load_cell(path).name, load_cell(path).remark) == (name, name)


def test_a_file_there_and_back(tmp_path):
    path = tmp_path / "pulses.csv"
    path.write_text(record_csv(measured(TRUE, points=4)))
    cell = identify(read_record(path), name='a "cell"').cell
    full = replace(
        cell, thermal=Thermal(50.0, 0.1, factor_K=(280.0, 300.0), factor=(1.5, 1.0)), anode=Anode((0.0, 1.0), (0.2, 0.1), (0.01, 0.01))
    )
    for one in (cell, full):
        (tmp_path / "cell.toml").write_text(cell_toml(one))
        read = load_cell(tmp_path / "cell.toml")
        assert read.name == 'a "cell"'
        assert (read.thermal, read.anode) == (one.thermal, one.anode)
        for name in (*one.tables, "ocv_V"):
            np.testing.assert_allclose(getattr(read, name), getattr(one, name), rtol=1e-6)


@pytest.mark.parametrize(("rc", "allowed_mV"), [(1, 2.5), (2, 1.2)])
def test_real_pulses(rc, allowed_mV, shared):
    found = identify(read_record(shared / "data" / "nissanleaf_cell-low-current-hppc-25c-2.csv"), rc=rc)
    assert len(found.fits) == 10
    assert sum(1e3 * fit.rms_V <= allowed_mV for fit in found.fits) >= 9
    assert found.seconds < 10
    assert not any("the pulses reach" in remark for remark in found.remarks)
    # A controller takes the cell as it is, and charges with it.
    problem = charging_problem(found.cell, mismatch_seed=None, current_max_A=30.0, steps=30)
    assert score_episode(problem, run_charge(problem)).metrics["soc_end"] > 0.05


def test_the_identified_cell_predicts_measured_discharges(shared):
    cell = identify(read_record(shared / "data" / "nissanleaf_cell-low-current-hppc-25c-2.csv"), rc=2).cell
    rms = []
    for rate in (1, 2, 3):
        record = read_record(shared / "data" / f"nissanleaf_cell-discharge-bitrode-{rate}c.csv")
        first, last, _ = next(part for part in segments(record) if part[2] < 0)
        _, seen, predicted = predicted_voltage(cell, record.part(max(first - 1, 0), last), 1.0)
        rms.append(1e3 * np.sqrt(np.mean((predicted - seen) ** 2)))
    # Pulses of 30 s hold no slow diffusion: the faster the discharge, the more of it is missing near empty.
    assert rms[0] < 40
    assert rms[1] < 60
    assert rms[2] < 140
    assert rms == sorted(rms)


def test_ocv_from_a_slow_charge_and_discharge(shared):
    pulses = read_record(shared / "data" / "nissanleaf_cell-low-current-hppc-25c-2.csv")
    slow = read_record(shared / "data" / "nissanleaf_C15_discharge_charge_24C.csv")
    rested, between = identify(pulses), identify(pulses, ocv=slow)
    z = np.linspace(0.15, 0.95, 17)
    of = [np.interp(z, c.ocv_soc, c.ocv_V) for c in (rested.cell, between.cell)]
    np.testing.assert_allclose(of[1], of[0], atol=0.03)
    # This charge and discharge are half a volt apart where they end, and the person is told.
    assert any("mV apart (at SOC" in remark for remark in between.remarks)


def test_a_slow_ocv_by_hand():
    """OCV 3 + z, polarisation 0.1 ohm, charged with 1 A and discharged with 2 A."""
    passed = np.linspace(0, 1, 500)
    hours = 2 * 3600.0
    time = np.concatenate([[0.0], 1.0 + passed * hours, 1.0 + hours + passed * hours / 2 + 1.0])
    current = np.concatenate([[0.0], np.full(500, 1.0), np.full(500, -2.0)])
    voltage = np.concatenate([[3.0], 3 + passed + 0.1, 4 - passed - 0.2])
    slow = Record("slow", time, current, voltage)
    cell = identify(measured(TRUE), capacity_Ah=2.0, ocv=slow).cell
    np.testing.assert_allclose(cell.ocv_V, 3 + np.array(cell.ocv_soc), atol=5e-3)


def test_a_slow_ocv_gives_the_circuit_up_to_the_full_end():
    """Rests alone do not hold the slope of the OCV where the cell is full; a charge and discharge at C/50 do."""
    ocv, passed, seconds = PchipInterpolator(TRUE.ocv_soc, TRUE.ocv_V), np.linspace(0, 1, 2001), 50 * 3600.0
    slow = Record(
        "slow",
        np.concatenate([[0.0], 1 + passed * seconds, 2 + seconds + passed * seconds]),
        np.concatenate([[0.0], np.full(2001, 0.04), np.full(2001, -0.04)]),
        np.concatenate([[ocv(0.0)], ocv(passed) + 0.002, ocv(1 - passed) - 0.002]),
    )
    found = identify(measured(TRUE), ocv=slow)
    np.testing.assert_allclose([fit.values["R1_ohm"] for fit in found.fits], 0.02, rtol=0.03)
    assert not any("mV apart" in remark for remark in found.remarks)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: identify(Record("mine", np.arange(100.0), np.ones(100), np.full(100, 3.7))), "0 sets of pulses after a rest"),
        (lambda: identify(measured(TRUE), rc=2), "do not hold R1_ohm|do not hold R2_ohm|do not hold tau"),
        (lambda: identify(measured(TRUE), rc=3), r"rc = 3, allowed is 1 or 2"),
        (lambda: identify(measured(TRUE), ocv=measured(TRUE).part(0, 50)), "no charge with current"),
        (lambda: identify(measured(TRUE), ocv=measured(TRUE)), r"passes 0\.0\d+ Ah, allowed is within 10 % of the capacity of"),
        (lambda: identify(measured(TRUE), capacity_Ah=4.0), r"do not hold the OCV; they reach from SOC 0\.5\d to 1\.00"),
        (lambda: identify(measured(TRUE), capacity_Ah=math.nan), r"capacity_Ah = nan, allowed is \(0, 1500\] Ah"),
        (lambda: identify(measured(TRUE), capacity_Ah=True), r"capacity_Ah = True, allowed is \(0, 1500\] Ah"),
        (lambda: identify(measured(replace(TRUE, C1_F=(50_000.0,) * 3))), r"at SOC 1\.00: the data do not hold tau1_s; .* longer pulses"),
        (lambda: with_thermal(TRUE, measured(TRUE), 1.0), "no column for the temperature"),
        (lambda: activation_energy({298.15: TRUE}), "at least 2"),
    ],
)
def test_what_the_data_do_not_hold_is_refused(make, said):
    with pytest.raises(ValueError, match=said):
        make()


def test_temperature_comes_back():
    cell = replace(TRUE, thermal=Thermal(heat_capacity_J_K=40.0, cooling_W_K=0.1))
    plant = SimulatedPlant(ecm_model(cell, 10.0), start_state(cell, 0.1))
    plant.reset(0)
    rows = [(0.0, 0.0, float(plant.step(np.zeros(1)).end[0]), 298.15)]
    for k in range(240):
        current = 4.0 if k < 120 else 0.0
        out = plant.step(np.array([current]))
        rows.append((10.0 * (k + 1), current, float(out.end[0]), float(out.end[3])))
    record = Record("warm", *np.array(rows).T)
    thermal = with_thermal(cell, record, 0.1).thermal
    assert thermal.heat_capacity_J_K == pytest.approx(40.0, rel=0.05)
    assert thermal.cooling_W_K == pytest.approx(0.1, rel=0.1)
    cool = replace(record, temperature_K=np.full(len(record), 298.15))
    with pytest.raises(ValueError, match=r"warms by 0\.00 K"):
        with_thermal(cell, cool, 0.1)


def test_activation_energy_of_arrhenius():
    def at(temperature):
        factor = np.exp(20e3 / 8.314462618 * (1 / temperature - 1 / 298.15))
        return replace(TRUE, R0_ohm=tuple(factor * np.array(TRUE.R0_ohm)), R1_ohm=tuple(factor * np.array(TRUE.R1_ohm)))

    assert activation_energy({t: at(t) for t in (283.15, 298.15, 313.15)}) == pytest.approx(20e3, rel=1e-9)
