"""Another cell as plant: the controller's cell stays, its limits hold, and what the plant lacks is refused by name."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from chargetune.battery.baselines.comparison import compare, row_names
from chargetune.battery.baselines.range_comparison import range_row_names
from chargetune.battery.cell.cell import default_cell, load_cell
from chargetune.battery.cell.plating import Anode
from chargetune.battery.cell.thermal import Thermal
from chargetune.battery.charging.charging_range import ChargingRange
from chargetune.battery.charging.checks import check_charging
from chargetune.battery.charging.evaluate import evaluate, run_charge
from chargetune.battery.charging.problem import knowing_the_plant
from chargetune.battery.charging.range_settings import ChargingRangeSettings
from chargetune.battery.plants.circuit import Circuit
from chargetune.battery.studies.study_file import Config, load_config, problem_of_document
from chargetune.episode.episode import Ending
from charging_problems import charging_problem

pytestmark = pytest.mark.usefixtures("virtual_machine")

FRESH = default_cell()
EXAMPLES = Path(__file__).resolve().parents[3] / "examples"
THERMAL = Thermal(heat_capacity_J_K=45.0, cooling_W_K=0.1)
ANODE = Anode((0.0, 1.0), (0.3, 0.08), (0.01, 0.01))


@pytest.fixture(scope="module")
def aged():
    return load_cell(EXAMPLES / "inr18650-20s_aged.toml")


def test_the_plant_has_its_own_capacity_ocv_and_pairs(aged):
    problem = charging_problem(FRESH, mismatch_seed=None, plant=Circuit(aged), steps=30, soc_start=0.3)
    run = run_charge(problem)
    own = run_charge(charging_problem(FRESH, mismatch_seed=None, steps=30, soc_start=0.3))
    assert run.ending is Ending.DONE
    # The charge is counted with the plant's capacity and efficiency, from the currents that the fresh model asked for.
    soc = 0.3 + np.cumsum(run.input[:, 0]) * aged.coulombic_efficiency * 10 / 3600 / aged.capacity_Ah
    np.testing.assert_allclose(run.signal("soc")[1], soc, atol=1e-9)
    assert "overpotential2_V" in run.output_names
    assert np.max(run.signal("voltage_V")) > np.max(own.signal("voltage_V")) + 0.05
    # What the fresh cell's controller asks for first depends on nothing of the plant.
    assert run.input[0, 0] == own.input[0, 0]


def test_the_same_cell_as_plant_changes_nothing():
    base = {"mismatch_seed": 1, "steps": 20, "soc_start": 0.3}
    one, other = (run_charge(charging_problem(FRESH, plant=plant, **base)) for plant in (None, Circuit(FRESH)))
    np.testing.assert_array_equal(one.input, other.input)
    np.testing.assert_array_equal(one.output_end, other.output_end)


def test_it_can_be_checked_compared_and_drawn(aged):
    problem = charging_problem(FRESH, mismatch_seed=None, plant=Circuit(aged), steps=40, soc_start=0.5, voltage_max_V=4.2)
    assert not [finding for finding in check_charging(problem, quick=True) if finding.severity == "error"]
    assert "MPC with the true model" in row_names(problem, None)
    assert "MPC that knows each plant" in range_row_names(problem, None)
    rows = {row.name: row for row in compare(problem) if row.name in ("nominal MPC", "MPC with the true model", "plant oracle")}
    over = {name: row.worst_excess["voltage_mV"] for name, row in rows.items()}
    assert over["nominal MPC"] > 10.0 > over["MPC with the true model"]
    known = knowing_the_plant(problem)
    assert (known.cell.R2_ohm, known.voltage_max_V, known.current_max_A) == (aged.R2_ohm, problem.voltage_max_V, problem.current_max_A)
    use = ChargingRange(replace(problem, range=ChargingRangeSettings(capacity=0.05, resistance=0.1)))
    drawn = use.draw(3, 1)
    for one in drawn:
        ratio = dict(one.plant.model.parameters)["capacity_Ah"][0] / aged.capacity_Ah
        assert 0.95 <= ratio <= 1.05
    score = use.score(use.run([problem.space.default] * 3, drawn)[0].noise_free())
    assert score is not None


def test_a_study_file_names_it_and_its_document_holds_it(aged):
    config = load_config(EXAMPLES / "aged_cell.toml")
    problem = config.problem(EXAMPLES)
    assert (problem.plant, problem.cell) == (Circuit(aged), FRESH)
    document = config.document(EXAMPLES)
    assert document["plant"]["cell"]["capacity_Ah"] == 1.76
    assert problem_of_document(document) == problem
    score, _, ending = evaluate(problem, None, 0)
    assert (ending, score is not None) == ("done", True)


@pytest.mark.parametrize(
    ("own", "plant", "more", "said"),
    [
        ({"thermal": THERMAL}, {}, {"temperature_max_K": 318.15}, r"no table \[thermal\], and limits.temperature_max_K = 318.15"),
        ({"thermal": THERMAL}, {}, {}, r"no table \[thermal\], and the controller's cell has one"),
        ({"anode": ANODE}, {}, {"anode_min_V": 0.0}, r"no table \[anode\], and limits.anode_min_V = 0"),
        ({}, {"series": 4}, {}, "pack of 4s1p, allowed is that of the controller's cell, 1s1p"),
        ({"R2_ohm": (0.01,) * 9, "C2_F": (3e4,) * 9}, {}, {"kind": "exact"}, "1 R-C pairs; .* at least the 2"),
        ({}, {"ocv_V": tuple(v + 0.2 for v in FRESH.ocv_V)}, {"voltage_max_V": 3.4, "soc_start": 0.1}, "rests at 3.548 V"),
    ],
)
def test_what_the_plant_lacks_is_refused_by_name(own, plant, more, said):
    cell, other = replace(FRESH, **own), replace(FRESH, name="aged", **plant)
    with pytest.raises(ValueError, match=f"plant: the cell 'aged' .*{said}"):
        charging_problem(cell, mismatch_seed=None, plant=Circuit(other), **more)


def test_a_plant_with_more_than_the_controller_knows_is_fine():
    richer = replace(FRESH, R2_ohm=(0.01,) * 9, C2_F=(3e4,) * 9, thermal=THERMAL, anode=ANODE)
    problem = charging_problem(FRESH, mismatch_seed=None, plant=Circuit(richer), temperature_max_K=318.15, anode_min_V=0.0, steps=5)
    score, _, _ = evaluate(problem, None, 0)
    assert {"temperature_max_K", "anode_min_V"} <= set(score.excess)


@pytest.mark.parametrize(
    ("plant", "said"),
    [
        ({"cell": 5}, "plant.cell = 5"),
        ({"cell": "aged.toml", "model": "SPM"}, "plant.model is not a known key"),
        ({"model": "P2D"}, "P2D"),
        ({"modell": "SPM"}, "plant.modell is not a known key"),
    ],
)
def test_a_bad_table_is_named_without_its_kind(tmp_path, plant, said):
    lines = [f"{key} = {value!r}" for key, value in plant.items()]
    path = tmp_path / "study.toml"
    path.write_text("\n".join(["[plant]", *lines]))
    with pytest.raises(ValueError, match=r"study\.toml: plant") as caught:
        load_config(path)
    assert said in str(caught.value)
    assert "<" not in str(caught.value)


def test_a_missing_cell_file_is_named():
    with pytest.raises(FileNotFoundError, match=r"nowhere\.toml"):
        Config.model_validate({"plant": {"cell": "nowhere.toml"}}).problem()
