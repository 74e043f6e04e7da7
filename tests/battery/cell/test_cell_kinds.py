"""Cells of every kind on sale go from a cell file to a judged charge; none of the bounds is of one size of cell."""

from dataclasses import replace

import numpy as np
import pytest
from cell_kinds import KINDS, LFP_V

from chargetune.battery.cell.cell import load_cell
from chargetune.battery.cell.equivalent_circuit import ecm_model, start_state
from chargetune.battery.charging.checks import check_charging
from chargetune.battery.charging.evaluate import evaluate
from chargetune.battery.charging.observers import _soc_at_rest
from chargetune.battery.charging.tunables import Backoff
from chargetune.battery.identification.pulse_fit import cell_toml, identify
from chargetune.battery.identification.virtual_bench import pulse_test
from chargetune.battery.plants.steppable import as_steppable
from chargetune.plants.sensors import Sensors
from chargetune.plants.simulated import SimulatedPlant
from charging_problems import charging_problem

pytestmark = pytest.mark.usefixtures("virtual_machine")
NAMES = list(KINDS)


@pytest.mark.parametrize("name", NAMES)
def test_a_cell_file_there_and_back(name, tmp_path):
    path = tmp_path / "cell.toml"
    path.write_text(cell_toml(KINDS[name]))
    again = load_cell(path)
    assert (again.voltage_max_V, again.ocv_V, again.thermal) == (KINDS[name].voltage_max_V, KINDS[name].ocv_V, KINDS[name].thermal)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(("entry", "factor"), [("R0_ohm", 1e3), ("capacity_Ah", 1e3), ("ocv_V", 1e3), ("C1_F", 1e6)])
def test_a_mistaken_unit_is_found_whatever_the_size(name, entry, factor):
    """Milliohm, mAh, mV, uF: 0.2 milliohm of 280 Ah, and 1.2 ohm of 45 mAh."""
    cell = KINDS[name]
    value = getattr(cell, entry)
    wrong = tuple(factor * v for v in value) if isinstance(value, tuple) else factor * value
    with pytest.raises(ValueError, match=rf"cell: (current_max_A|R0_ohm|{entry})"):
        replace(cell, **{entry: wrong})


@pytest.mark.parametrize("name", NAMES)
def test_it_is_checked_and_charged(name):
    """A limit below that of the data sheet, where the largest current reaches it: the untuned controller keeps it, and a backoff acts."""
    cell = KINDS[name]
    step = 0.15 / cell.current_max_A * cell.capacity_Ah * 3600 / 40
    problem = charging_problem(
        cell,
        mismatch_seed=None,
        kind="offset_free",
        sampling_time_s=round(step, 2),
        steps=40,
        soc_start=0.8,
        soc_target=0.9,
        voltage_max_V=cell.ocv_V[-2] + 0.02,
        backoff=Backoff(nodes=2, lower_V=0.0, upper_V=0.02),
    )
    assert not [finding for finding in check_charging(problem, quick=True) if finding.severity == "error"]
    score, run, ending = evaluate(problem, None, 0)
    assert ending == "done"
    assert score.feasible
    assert score.metrics["solver_failures"] == 0
    current = run.input[:, 0]
    assert np.all((current >= 0) & (current <= cell.current_max_A * (1 + 1e-6)))
    assert run.signal("soc")[1][-1] > 0.81


@pytest.mark.parametrize("name", NAMES)
def test_its_pulses_are_identified(name):
    cell = replace(KINDS[name], thermal=None)

    def sampled(seconds):
        return as_steppable(SimulatedPlant(ecm_model(cell, seconds), start_state(cell, 1.0), Sensors()))

    record = pulse_test(sampled, capacity_Ah=cell.capacity_Ah, voltage_min_V=cell.voltage_min_V, points=3, rate=0.5)
    found = identify(record, capacity_Ah=1.1 * cell.capacity_Ah).cell
    middle = float(np.interp(0.6, found.soc, found.R0_ohm))
    assert middle == pytest.approx(np.interp(0.6, cell.soc, cell.R0_ohm), rel=0.1)
    # The limits of the data sheet can take the place of the record's extremes.
    assert replace(found, voltage_max_V=cell.voltage_max_V, voltage_min_V=cell.voltage_min_V).voltage_max_V == cell.voltage_max_V


def test_half_a_second_of_sampling():
    problem = charging_problem(KINDS["NMC 5 Ah"], mismatch_seed=None, sampling_time_s=0.5, steps=60, soc_start=0.9)
    score, _, ending = evaluate(problem, None, 0)
    assert (ending, score.feasible) == ("done", True)


@pytest.mark.parametrize(("voltage", "soc"), [(3.11, 0.05), (3.29, 0.45), (3.33, 0.75), (3.36, 1.0), (2.0, 0.0), (4.0, 1.0), (3.2902, 0.5)])
def test_the_soc_at_rest_of_a_flat_ocv_is_within_the_flat_part(voltage, soc):
    """Two equal neighbours of the table have one voltage: the first reading gives the middle between them, not a division by zero."""
    cell = KINDS["LFP 2.5 Ah"]
    assert sorted(LFP_V)[5] == sorted(LFP_V)[6]
    found = float(_soc_at_rest({"voltage_V": voltage}, cell)["soc"])
    assert found == pytest.approx(soc, abs=0.06)
