"""Baselines on plants where they are known: the circuit by closed form, and the DFN by the figures of an independent study."""

from dataclasses import replace

import numpy as np
import pytest

from chargetune.battery.baselines.charging_protocols import ATTIA_RATES, attia_fourth_rate, charge, constant_current, four_step, multi_step
from chargetune.battery.baselines.comparison import CCCV, compare, row_names
from chargetune.battery.cell.cell import default_cell
from chargetune.battery.cell.equivalent_circuit import ecm_model, start_state
from chargetune.battery.cell.thermal import Thermal
from chargetune.battery.charging.evaluate import plant_of, run_charge
from chargetune.battery.charging.limits import Limit
from chargetune.battery.charging.metrics import crossing_minutes
from chargetune.battery.charging.tunables import ResistanceRatio
from chargetune.battery.plants.electrochemical import Electrochemical
from chargetune.battery.plants.steppable import as_steppable
from chargetune.episode.episode import Ending
from chargetune.plants.sensors import Sensors
from chargetune.plants.simulated import SimulatedPlant
from charging_problems import charging_problem

pytestmark = pytest.mark.usefixtures("virtual_machine")

CELL = default_cell()
VOLTAGE = Limit("voltage_max_V", 4.2, 5e-4)


def circuit(soc=0.05, cell=CELL):
    return as_steppable(SimulatedPlant(ecm_model(cell, 10.0), start_state(cell, soc)))


def minutes(episode, mark, soc_start=0.05):
    soc = np.concatenate([[soc_start], episode.signal("soc")[1]])
    return crossing_minutes(np.append(0.0, episode.time_s + episode.sampling_time_s), soc, mark)


def test_without_a_limit_it_is_the_current():
    episode = charge(circuit(), constant_current(2.0), [], steps=60, soc_target=1.0, current_max_A=6.0)
    np.testing.assert_array_equal(episode.input, 2.0)
    np.testing.assert_allclose(episode.signal("soc")[1], 0.05 + np.arange(1, 61) * 2.0 / 720, atol=1e-12)
    assert episode.ending is Ending.DONE


def test_cccv_holds_the_voltage_exactly_and_ends_at_the_target():
    episode = charge(circuit(), constant_current(6.0), [VOLTAGE], steps=360, soc_target=0.9, current_max_A=6.0)
    highest = np.maximum(*episode.signal("voltage_V"))
    current = episode.input[:, 0]
    reached = int(np.argmax(current < 5.999))
    assert highest.max() <= 4.2 + 1e-9
    holding = slice(reached, int(np.argmax(episode.signal("soc")[1] > 0.899)))
    np.testing.assert_allclose(highest[holding], 4.2, atol=1e-4)
    assert episode.signal("soc")[1].max() == pytest.approx(0.9, abs=1e-9)
    assert current[-1] == 0.0


def test_the_oracle_of_the_circuit_is_what_a_perfect_controller_does():
    """t95 of the case study's oracle, 36.24 min, found without any MPC."""
    episode = charge(circuit(), constant_current(6.0), [VOLTAGE], steps=360, soc_target=1.0, current_max_A=6.0)
    assert minutes(episode, 0.95) == pytest.approx(36.24, abs=0.02)
    own = run_charge(charging_problem(CELL, mismatch_seed=None))
    np.testing.assert_allclose(episode.input, own.input, atol=0.02)


def test_where_nothing_keeps_the_limit_the_current_is_zero():
    full = charge(circuit(0.5), constant_current(6.0), [replace(VOLTAGE, bound=3.0)], steps=3, soc_target=1.0, current_max_A=6.0)
    np.testing.assert_array_equal(full.input, 0.0)


def test_step_laws_by_hand():
    steps = multi_step([5.0, 4.0, 3.0, 2.0, 1.0])
    assert [steps(z) for z in (0.0, 0.19, 0.2, 0.5, 0.99, 1.0)] == [5.0, 5.0, 4.0, 3.0, 1.0, 1.0]
    four = four_step([4.0, 3.0, 2.0, 1.0], 0.5)
    assert [four(z) for z in (0.0, 0.25, 0.5, 0.79, 0.8, 1.0)] == [4.0, 3.0, 2.0, 1.0, 0.5, 0.5]
    # Attia et al. 2020: 80 % in ten minutes; 4.8C-5.2C-5.2C needs 4.160C as the fourth.
    assert attia_fourth_rate([4.8, 5.2, 5.2], 1 / 6) == pytest.approx(4.16, abs=0.005)
    assert ATTIA_RATES[3] == pytest.approx(attia_fourth_rate([4.8, 5.2, 5.2], 1 / 6) / 5.2, abs=1e-3)
    with pytest.raises(ValueError, match="first three windows alone"):
        attia_fourth_rate([1.0, 1.0, 1.0], 0.5)


def test_a_law_below_zero_charges_nothing():
    plant = as_steppable(Electrochemical(model="SPM").plant(0.9, 10.0, Sensors()))
    episode = charge(plant, constant_current(-15.0), [], steps=2, soc_target=1.0, current_max_A=15.0)
    assert episode.ending is Ending.DONE
    np.testing.assert_array_equal(episode.input, 0.0)


# t80 and t90 in minutes, least anode potential in mV and highest temperature in K on the DFN at 298 K: from an
# independent study with the same limits, held by bisection.
def test_cccv_on_the_dfn():
    current, t80, t90, anode_mV, highest_K = 10.0, 24.3, 31.7, -7.2, 327.0
    plant = as_steppable(Electrochemical().plant(0.05, 10.0, Sensors()))
    steps = round(6 * t90) + 12
    episode = charge(plant, constant_current(current), [VOLTAGE], steps=steps, soc_target=1.0, current_max_A=current)
    assert minutes(episode, 0.8) == pytest.approx(t80, rel=0.03)
    assert minutes(episode, 0.9) == pytest.approx(t90, rel=0.03)
    assert 1e3 * min(values.min() for values in episode.signal("anode_potential_V")) == pytest.approx(anode_mV, abs=1.0)
    assert max(values.max() for values in episode.signal("temperature_K")) == pytest.approx(highest_K, abs=1.0)


def test_the_table_of_the_circuit():
    problem = charging_problem(CELL, mismatch_seed=1, R1=ResistanceRatio())
    theta = problem.space.default
    rows = {row.name: row for row in compare(problem, theta)}
    assert list(rows) == row_names(problem, theta)
    oracle, true = rows["plant oracle"], rows["MPC with the true model"]
    assert oracle.score.metrics["t95_min"] == pytest.approx(true.score.metrics["t95_min"], abs=0.05)
    assert rows["nominal MPC"].breaks_limit
    assert rows["nominal MPC"].worst_excess == {"voltage_mV": pytest.approx(62, abs=1), "anode_mV": None, "temperature_K": None}
    best = rows["best constant backoff"]
    assert not best.breaks_limit
    # A smaller one would break the limit: it lies within the search's tolerance of it.
    assert -0.6 <= best.worst_excess["voltage_mV"] <= 0.5
    assert best.score.metrics["t80_min"] > true.score.metrics["t80_min"]
    for name in ("CC-CV 1.5 A", "CC-CV 3 A", "CC-CV 6 A", "multi-step CC", "four-step CC (Attia)"):
        assert not rows[name].breaks_limit, name
    assert rows["CC-CV 6 A"].score.metrics["t80_min"] == pytest.approx(oracle.score.metrics["t80_min"], abs=1e-6)
    # With the voltage as the only limit the fastest rate is the largest.
    assert rows[CCCV].setting == "6 A"
    assert rows[CCCV].score.metrics == rows["CC-CV 6 A"].score.metrics


def test_the_fastest_rate_that_keeps_the_temperature_is_found():
    warm = replace(CELL, thermal=Thermal(heat_capacity_J_K=40.0, cooling_W_K=0.05))
    problem = charging_problem(warm, mismatch_seed=None, horizon=3, steps=240, temperature_max_K=306.0)
    (row,) = compare(problem, rows=[CCCV])
    rate = float(row.setting.removesuffix(" A"))
    assert not row.breaks_limit
    # A step of the search faster and it is too hot.
    stepped, largest = as_steppable(plant_of(problem)), problem.current_max_A
    law = constant_current(rate + largest / 64)
    faster = charge(stepped, law, [VOLTAGE], steps=240, soc_target=problem.episode.soc_target, current_max_A=largest)
    assert max(values.max() for values in faster.signal("temperature_K")) > 306.0 + problem.limits.tolerance_K


def test_a_row_that_does_not_exist_is_refused():
    problem = charging_problem(CELL)
    with pytest.raises(ValueError, match=r"--row 'CC-CV 7 A', allowed are 'CC-CV 1\.5 A', "):
        list(compare(problem, rows=["CC-CV 7 A"]))
