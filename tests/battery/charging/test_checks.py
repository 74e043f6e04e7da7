"""The formulation check of charging problems: one test for each planted error, silence on every example."""

import runpy
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from chargetune.battery.cell.cell import default_cell
from chargetune.battery.cell.equivalent_circuit import ecm_model, start_state
from chargetune.battery.cell.thermal import Thermal
from chargetune.battery.charging.checks import check_charging
from chargetune.battery.charging.evaluate import run_charge
from chargetune.battery.charging.problem import stand_in
from chargetune.battery.charging.settings import SensorSettings
from chargetune.battery.charging.tunables import Backoff, CurrentLimit, ResistanceRatio
from chargetune.battery.plants.electrochemical import Electrochemical
from chargetune.battery.studies.study_file import load_config
from chargetune.checks.nominal_loop import check_formulation
from chargetune.plants.simulated import SimulatedPlant
from charging_problems import changed, charging_problem

pytestmark = pytest.mark.usefixtures("virtual_machine")

CELL = default_cell()
EXAMPLES = Path(__file__).parents[3] / "examples"
STUDIES = sorted(path for path in EXAMPLES.glob("*.toml") if not {"[ecm]", "[campaign]"} & set(path.read_text().split()))
R1 = ResistanceRatio()


def problem(**changes):
    return charging_problem(CELL, **({"mismatch_seed": 1, "R1": R1} | changes))


def short(**changes):
    """A charge that meets the voltage limit soon."""
    return problem(**({"steps": 120, "soc_start": 0.4, "soc_target": 0.8} | changes))


def test_there_are_examples():
    assert len(STUDIES) >= 5


# What is true of an example and belongs to it: a stage cost that is learnt need not be convex; what theta has at full is hardly met.
TOLD = {"rbf_charge": ["non-convex"], "dfn_fast_charge": ["no-influence"]}


@pytest.mark.parametrize("path", STUDIES, ids=lambda path: path.stem)
def test_nothing_is_found_in_an_example(path, monkeypatch):
    # Hundreds of charges of circuits with a temperature are worth a compilation, where the whole run has a compiler.
    monkeypatch.undo()
    found = load_config(path).problem(path.parent)
    findings = check_charging(found, quick=found.plant is not None)
    assert [f.code for f in findings] == TOLD.get(path.stem, [])


def test_a_limit_far_above_the_full_cell_is_told():
    full = CELL.ocv_V[-1]
    high = replace(CELL, voltage_max_V=full + 0.19)
    found = check_charging(charging_problem(high, mismatch_seed=1, R1=R1), quick=True)
    message = next(f.message for f in found if f.code == "limit-above-full")
    assert f"190 mV above the OCV of the full cell, {full:.4g} V" in message
    flat = replace(CELL, ocv_V=tuple(np.linspace(2.9, 3.4, len(CELL.ocv_V))), voltage_max_V=3.65)
    assert "limit-above-full" not in {f.code for f in check_charging(charging_problem(flat, mismatch_seed=1, R1=R1), quick=True)}


def test_nothing_is_found_in_the_example_that_is_no_battery():
    example = runpy.run_path(str(EXAMPLES / "custom_system.py"))
    plant = SimulatedPlant(example["crane"](1.0), {})
    signs = {("position", "acceleration"): 1}
    assert check_formulation(example["CONTROLLER"], steps=example["STEPS"], plant=plant, signs=signs, quick=True) == ()


@pytest.mark.parametrize("seed", range(2))
def test_nothing_is_found_in_the_case_studies(seed):
    assert check_charging(problem(mismatch_seed=seed), quick=True) == ()


PLANTED = {
    "R1 with a measured U1": ({"kind": "exact"}, "no-influence", "warning", "overpotential is measured"),
    "current too small for the limit": ({"current_max_A": 0.5}, "no-influence", "error", "nothing to tune"),
    "a node that the charge does not visit": (
        {"R1": None, "current_limit": CurrentLimit()}, "no-influence", "warning", "current_limit[0]",
    ),
    "inexact slack weight": ({"penalty_per_V": 0.01}, "inexact-penalty", "error", "penalty of voltage_V"),
    "target above the voltage limit": ({"voltage_max_V": 4.0}, "unreachable-target", "warning", "at rest it has 4.029 V"),
    "episode too short": ({"steps": 20}, "unreachable-target", "warning", "largest current charges to 0.567"),
    "limits too narrow for the time": ({"soc_target": 1.0}, "unreachable-target", "warning", "knows the cell only gets to"),
    "horizon too short": ({"horizon": 1}, "short-horizon", "warning", "10 s"),
    "sampling too fast for the horizon": ({"sampling_time_s": 1.0}, "short-horizon", "warning", "5 s"),
    "least current breaks the limit at the start": (
        {"soc_start": 0.98, "soc_target": 1.0, "current_min_A": 3.0}, "unsafe-start", "error", "voltage_V",
    ),
    "least voltage above the start": (
        {"voltage_min_V": 3.9, "soc_start": 0.0, "current_max_A": 1.0}, "unsafe-start", "error", "voltage_V",
    ),
    "limit that cannot be kept": (
        {"current_min_A": 4.0, "soc_start": 0.5, "steps": 30}, "limit-not-kept", "warning", "1000 times the penalty",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", PLANTED)
def test_a_planted_error_is_found(name):
    changes, code, severity, words = PLANTED[name]
    found = check_charging(short(**changes), quick=True)
    mine = [f for f in found if f.code == code and words in f.message]
    assert [f.severity for f in mine] == [severity], found
    assert mine[0].remedy
    assert all(isinstance(v, float) for v in mine[0].numbers.values())
    assert mine[0].evidence is not None
    # Errors come first.
    assert [f.severity for f in found] == sorted(f.severity for f in found)


def test_a_cell_warmer_than_its_limit_is_an_unsafe_start():
    warm = replace(CELL, thermal=Thermal(heat_capacity_J_K=45.0, cooling_W_K=0.1, ambient_K=320.0))
    found = check_charging(changed(problem(), cell=warm, temperature_max_K=315.0), quick=True)
    unsafe = [f for f in found if f.code == "unsafe-start"]
    assert [f.numbers["least_excess"] for f in unsafe] == [pytest.approx(5.0)]


def test_the_numbers_behind_r1_with_a_measured_overpotential():
    (found,) = check_charging(problem(kind="exact"), quick=True)
    # A uniform factor from 0.1 to 6 on R1: with U1 propagated the worst voltage goes from 289 mV over the limit to 122 mV below.
    assert found.numbers["range_propagated_mV"] == pytest.approx(289 + 122, abs=5)
    assert found.numbers["range_measured_mV"] < 60
    factors, excess = found.evidence.lines["measured"]
    episode = run_charge(problem(kind="exact"), np.full(9, factors[-1]))
    assert excess[-1] == pytest.approx(1e3 * (max(map(np.max, episode.signal("voltage_V"))) - 4.2), abs=0.01)


def test_a_theta_declared_safe_has_to_be_safe():
    study = problem(R1=None, backoff=Backoff(nodes=3, lower_V=0.0, upper_V=0.2))
    assert check_charging(study, start=[0.2, 0.2, 0.2], quick=True) == ()
    (found,) = check_charging(study, start=[0.0, 0.0, 0.0], quick=True)
    assert (found.code, found.severity) == ("unsafe-start", "error")
    # Member study, section 4: untuned this controller is 62 mV over the limit; told in tolerances.
    assert study.limits.tolerance_V * (1 + found.numbers["excess"]) == pytest.approx(0.062, abs=1e-3)


@dataclass(frozen=True)
class Discharging:
    """A cell at which somebody counts discharging as positive."""

    def plant(self, soc_start, sampling_time_s, sensors):
        model = ecm_model(CELL, sampling_time_s)
        x, u, p = model.f.sx_in()
        turned = replace(
            model,
            f=type(model.f)("f", [x, u, p], [model.f(x, -u, p)], ["x", "u", "p"], ["x_next"]),
            h=type(model.h)("h", [x, u, p], [model.h(x, -u, p)], ["x", "u", "p"], ["y"]),
        )
        return SimulatedPlant(turned, start_state(CELL, soc_start), sensors)


def test_a_plant_with_the_other_sign_convention_is_found_by_the_whole_check():
    turned = short(plant=Discharging())
    found = [f for f in check_charging(turned) if f.code == "wrong-sign"]
    assert {f.message.split(" of the plant")[0] for f in found} >= {"voltage_V", "soc"}
    assert all(f.severity == "error" for f in found)
    # The quick check leaves plants alone.
    assert not [f for f in check_charging(turned, quick=True) if f.code == "wrong-sign"]


def test_an_electrochemical_plant_is_not_touched_by_the_stand_in():
    study = charging_problem(
        CELL, None, plant=Electrochemical(), temperature_max_K=310.0, anode_min_V=0.0, hard=("anode_min_V",),
        scored_only=("temperature_max_K",), voltage_noise_sd_V=0.002, temperature_noise_sd_K=0.1, verdict_samples=5,
    )  # fmt: skip
    circuit = stand_in(study)
    assert list(circuit.limits_by_name) == ["voltage_max_V", "voltage_min_V"]
    assert circuit.plant is None
    assert circuit.sensors == SensorSettings()
