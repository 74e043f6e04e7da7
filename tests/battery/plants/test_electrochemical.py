"""The electrochemical plant against PyBaMM's own simulation, charge counting and itself."""

import json
import os
import pickle
import signal
from dataclasses import replace

import numpy as np
import pytest
from bpx_cell import CELL

from chargetune.battery.cell.cell import default_cell
from chargetune.battery.charging.evaluate import evaluate
from chargetune.battery.plants.electrochemical import CellState, Electrochemical, _built, _discretised, _signals_after
from chargetune.battery.plants.parameter_sets import OTHER_SETS, SETS
from chargetune.episode.episode import Ending
from chargetune.plants.plant import PlantError, SetUpError
from chargetune.plants.sensors import Sensors
from charging_problems import charging_problem

pytestmark = pytest.mark.usefixtures("virtual_machine")

SPM = Electrochemical(model="SPM")
NAMES = ("voltage_V", "soc", "temperature_K", "anode_potential_V")


def charged(settings, currents, soc=0.3, step=10.0, sensors=None, seed=0):
    """[(start, end)] of each interval."""
    plant = settings.plant(soc, step, sensors or Sensors())
    plant.reset(seed)
    return [plant.step(np.array([current])) for current in currents]


@pytest.mark.parametrize("model", ["SPM", "SPMe", "DFN"])
def test_it_is_pybamms_own_simulation(model):
    import pybamm

    settings = Electrochemical(model=model)
    found = charged(settings, [5.0] * 60)
    options = {"thermal": "lumped", "SEI": "solvent-diffusion limited", "lithium plating": "partially reversible"}
    values = pybamm.ParameterValues("OKane2022")
    values.update({"Current function [A]": -5.0, "Total heat transfer coefficient [W.m-2.K-1]": 10.0})
    simulation = pybamm.Simulation(
        getattr(pybamm.lithium_ion, model)(options),
        parameter_values=values,
        var_pts={"x_n": 10, "x_s": 6, "x_p": 10, "r_n": 10, "r_p": 10},
        solver=pybamm.IDAKLUSolver(rtol=1e-6, atol=1e-8),
    )
    whole = simulation.solve([0, 600], t_interp=np.arange(0.0, 601.0, 10.0), initial_soc=0.3)
    reference = {
        "voltage_V": whole["Voltage [V]"].entries,
        "temperature_K": whole["Volume-averaged cell temperature [K]"].entries,
        "anode_potential_V": whole["Negative electrode surface potential difference at separator interface [V]"].entries,
    }
    for name, tolerance in (("voltage_V", 5e-4), ("temperature_K", 0.02), ("anode_potential_V", 5e-4)):
        ends = [m.end[NAMES.index(name)] for m in found]
        np.testing.assert_allclose(ends, np.ravel(reference[name])[1:], atol=tolerance)


def test_charge_is_counted_and_a_positive_current_charges():
    found = charged(SPM, [4.0, 4.0, -2.0, 0.0])
    soc = [m.end[1] for m in found]
    expected = 0.3 + np.cumsum([4, 4, -2, 0]) * 10 / 3600 / SPM.capacity_Ah
    np.testing.assert_allclose(soc, expected, rtol=0, atol=1e-12)
    assert SPM.capacity_Ah == pytest.approx(5.110, abs=1e-3)
    rest = charged(SPM, [0.0])[0].end[0]
    assert found[0].start[0] > rest > found[2].start[0]
    # The charge that came in is found again in the open-circuit voltage.
    assert charged(SPM, [0.0], soc=float(expected[1]))[0].end[0] > rest


def test_the_start_is_just_after_the_jump():
    first, second = charged(SPM, [5.0, 0.0])
    assert first.start[0] > charged(SPM, [0.0])[0].end[0] + 0.01
    # The ohmic part is gone at once when the current stops.
    assert second.start[0] < first.end[0] - 0.01
    np.testing.assert_allclose(second.start[1:3], first.end[1:3], atol=1e-6)


def test_currents_are_tried_from_one_state_which_stays():
    plant = SPM.plant(0.3, 10.0, Sensors())
    plant.reset(0)
    plant.step(np.array([5.0]))
    at = plant.state
    tried = [plant.ahead(at, current)[1] for current in (10.0, 0.0, 5.0)]
    assert tried[0][0] > tried[2][0] > tried[1][0]
    np.testing.assert_allclose(plant.step(np.array([5.0])).end, tried[2], rtol=1e-12)
    assert plant.state is not at


def test_two_episodes_are_the_same_and_noise_is_the_seeds():
    noisy = Sensors(noise_sd={"voltage_V": 0.002}, bias={"temperature_K": 1.0}, delay_steps=1)
    plant = SPM.plant(0.3, 10.0, noisy)
    runs = []
    for seed in (1, 1, 2):
        plant.reset(seed)
        runs.append([plant.step(np.array([5.0])) for _ in range(4)])
    for a, b in zip(*runs[:2], strict=True):
        np.testing.assert_array_equal(a.end, b.end)
    assert runs[0][0].end[0] != runs[2][0].end[0]
    np.testing.assert_allclose(runs[0][3].true_end, runs[2][3].true_end)
    np.testing.assert_array_equal(runs[0][3].received, runs[0][2].end)
    assert runs[0][0].end[2] - runs[0][0].true_end[2] == pytest.approx(1.0)


def test_it_crosses_to_a_worker_as_data():
    plant = SPM.plant(0.3, 10.0, Sensors())
    plant.reset(0)
    plant.step(np.array([5.0]))
    content = pickle.dumps(plant)
    assert len(content) < 2000
    again = pickle.loads(content)  # noqa: S301 - made here
    assert again == plant
    again.reset(0)
    with pytest.raises(PlantError, match="not reset"):
        pickle.loads(content).step(np.array([5.0]))  # noqa: S301 - made here


@pytest.mark.parametrize(
    ("current", "intervals", "said"),
    [
        (15.0, 300, "stoichiometry|solver failed|voltage"),
        (-15.0, 300, "stoichiometry|solver failed|voltage"),
        (5000.0, 3, "allowed is|solver failed"),
    ],
)
def test_beyond_its_range_the_model_ends_with_a_reason(current, intervals, said):
    with pytest.raises(PlantError, match=said):
        charged(SPM, [current] * intervals, soc=0.5)


def test_an_episode_ends_with_the_plants_reason_and_is_kept():
    cell = replace(default_cell(), capacity_Ah=5.1, current_max_A=100.0)
    problem = charging_problem(
        cell, mismatch_seed=None, plant=SPM, current_max_A=100.0, current_min_A=50.0, soc_start=0.6, steps=200, voltage_max_V=4.2
    )
    score, episode, ending = evaluate(problem, problem.space.default, 0)
    assert score is None
    assert episode.ending is Ending.PLANT
    assert 0 < len(episode) < 200
    assert ending.startswith("plant: ")


def test_ageing_acts_as_it_says():
    half = replace(SPM, capacity_scale=0.8)
    assert half.capacity_Ah == pytest.approx(0.8 * SPM.capacity_Ah, rel=1e-6)

    def ohmic(settings):
        plant = settings.plant(0.5, 1.0, Sensors())
        jumps = [plant.ahead(CellState(None, 0.0), current)[0][0] for current in (0.0, 1.0)]
        return jumps[1] - jumps[0]

    dfn = Electrochemical()
    assert ohmic(replace(dfn, resistance_scale=1.5)) == pytest.approx(1.5 * ohmic(dfn), rel=1e-3)


def test_ambient_and_cooling_act():
    cold, warm = (charged(replace(SPM, ambient_K=t), [10.0] * 20)[-1] for t in (283.15, 298.15))
    assert cold.end[0] > warm.end[0]
    assert cold.end[2] - 283.15 > warm.end[2] - 298.15 > 1.0
    still = charged(replace(SPM, cooling_W_m2K=0.0), [10.0] * 20)[-1]
    assert still.end[2] > warm.end[2]


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"model": "P2D"}, "model = 'P2D', allowed is SPM or SPMe or DFN"),
        ({"mesh": "fine"}, "mesh = 'fine'"),
        ({"ambient_K": 25.0}, "ambient_K = 25.0, allowed is [230, 350] K (was it given in degC?)"),
        ({"cooling_W_m2K": -1.0}, "cooling_W_m2K = -1.0"),
        ({"capacity_scale": 80.0}, "capacity_scale = 80.0"),
        ({"resistance_scale": True}, "resistance_scale = True"),
        ({"parameters": ""}, "parameters = ''"),
    ],
)
def test_nonsense_is_refused_by_name(changes, said):
    with pytest.raises(ValueError, match="electrochemical plant") as caught:
        replace(SPM, **changes)
    assert said in str(caught.value)


def test_unknown_parameters_are_refused_with_those_there_are(tmp_path):
    with pytest.raises(ValueError, match=r"parameters = 'Okane', allowed are .*OKane2022"):
        _ = replace(SPM, parameters="Okane").capacity_Ah
    with pytest.raises(ValueError, match="no such file"):
        _ = replace(SPM, parameters=str(tmp_path / "cell.json")).capacity_Ah


def test_the_model_is_built_once():
    charged(SPM, [1.0])
    built = _built.cache_info().misses
    replace(SPM).plant(0.3, 10.0, Sensors()).reset(1)
    assert _built.cache_info().misses == built


def test_a_bpx_file(tmp_path):
    path = tmp_path / "cell.json"
    path.write_text(json.dumps(CELL))
    settings = Electrochemical(parameters=str(path))
    found = charged(settings, [5.0] * 3, soc=0.5)
    rest = charged(settings, [0.0], soc=0.5)[0].end
    # The negative electrode holds 0.15 m2 x 60 um x 2/3 x 30000 mol/m3 x F = 4.83 Ah, of which 79 % and more are used.
    assert 0.79 * 4.83 < settings.capacity_Ah < 4.83
    assert 3.5 < rest[0] < found[0].end[0] < found[2].end[0] < 4.2
    assert rest[3] > found[2].end[3]
    assert found[2].end[2] > 298.15
    path.write_text(json.dumps({**CELL, "Header": {}}))
    with pytest.raises(ValueError, match=r"cell\.json is no BPX file"):
        _ = Electrochemical(parameters=str(path), model="SPM").capacity_Ah


def test_a_signal_inside_the_solver_is_handled_after_it():
    """Compiled code drops what a handler raises inside of it; a failure of the solver does not hide the signal either."""
    handler, done = signal.getsignal(signal.SIGINT), []

    def interrupted(*, failing):
        with _signals_after():
            os.kill(os.getpid(), signal.SIGINT)
            done.append("went on")
            if failing:
                raise PlantError("the solver failed")

    for failing in (False, True):
        with pytest.raises(KeyboardInterrupt):
            interrupted(failing=failing)
    assert done == ["went on", "went on"]
    assert signal.getsignal(signal.SIGINT) is handler


def charges_at_1C(settings):
    """At 1C the charge that was counted in is the current times the time; the voltage rises and the anode potential falls."""
    # The capacity is read of the model at half charge, which is built for it: so one model serves both.
    plant, current = settings.plant(0.5, 60.0, Sensors()), np.array([settings.capacity_Ah])
    rest = plant.reset(0)
    first, second = plant.step(current), plant.step(current)
    outputs = [s.name for s in plant.outputs]
    voltage, soc, temperature, anode = (outputs.index(n) for n in ("voltage_V", "soc", "temperature_K", "anode_potential_V"))
    assert second.end[soc] == pytest.approx(0.5 + 2 / 60, abs=1e-6)
    assert rest.end[voltage] < first.end[voltage] < second.end[voltage] < 4.4
    assert second.end[anode] < rest.end[anode]
    # The reversible heat of some sets cools at first.
    assert abs(second.end[temperature] - 298.15) < 5


@pytest.mark.parametrize("model", ["SPM", "SPMe", "DFN"])
@pytest.mark.parametrize("name", ["Chen2020", "Prada2013", "ORegan2022", "Mohtat2020", "Marquis2019", "Ai2020"])
def test_a_set_runs_every_model_at_1C(name, model):
    charges_at_1C(Electrochemical(model=model, parameters=name))


# The table of the potential of hard carbon ends before the electrode is empty.
@pytest.mark.filterwarnings("ignore:While solving ElectrodeSOH model extrapolation")
@pytest.mark.parametrize(
    "name", sorted({*SETS} - {"OKane2022", "Chen2020", "Prada2013", "ORegan2022", "Mohtat2020", "Marquis2019", "Ai2020"})
)
def test_every_other_set_that_the_message_names_runs(name):
    charges_at_1C(Electrochemical(model="SPM", parameters=name))


@pytest.mark.parametrize("model", ["SPM", "SPMe", "DFN"])
def test_a_bpx_file_runs_every_model_at_1C(model, tmp_path):
    path = tmp_path / "cell.json"
    path.write_text(json.dumps(CELL))
    charges_at_1C(Electrochemical(model=model, parameters=str(path)))


def test_no_set_of_pybamm_is_unknown_here():
    """One that a new version brings is tried and put into one of the two lists."""
    import pybamm

    assert set(pybamm.parameter_sets.keys()) == {*SETS, *OTHER_SETS}


@pytest.mark.parametrize("name", sorted(OTHER_SETS))
def test_a_set_that_cannot_run_is_refused_with_the_reason_and_what_can(name):
    with pytest.raises(SetUpError) as caught:
        _ = Electrochemical(parameters=name).capacity_Ah
    assert f"parameters = {name!r} ({OTHER_SETS[name]}), allowed are a BPX file (.json) and Ai2020" in str(caught.value)
    # Not for want of trying: without the list it fails in PyBaMM too.
    with pytest.raises(Exception, match=r".") as tried:
        _discretised(SPM, 0.5, pybamm_values(name))
    assert not isinstance(tried.value, AssertionError)


def pybamm_values(name):
    import pybamm

    return pybamm.ParameterValues(name)


def test_what_a_model_lacks_of_a_file_is_said(monkeypatch):
    import pybamm

    whole = pybamm.ParameterValues("OKane2022")
    del whole["Negative electrode OCP [V]"]
    monkeypatch.setattr("chargetune.battery.plants.electrochemical._parameters", lambda _: whole)
    with pytest.raises(SetUpError, match=r"parameters = 'OKane2022' lacks what this model needs: .*Negative electrode OCP"):
        Electrochemical(mesh="default").plant(0.51, 10.0, Sensors()).reset(0)
