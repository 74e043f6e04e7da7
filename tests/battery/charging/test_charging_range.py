"""The table [range] of a study file, and the plants that it draws."""

from dataclasses import fields, replace

import numpy as np
import pytest

from chargetune.battery.cell.cell import default_cell
from chargetune.battery.cell.thermal import Thermal
from chargetune.battery.charging.charging_range import ChargingRange
from chargetune.battery.charging.range_settings import MEANING, ChargingRangeSettings, range_line
from chargetune.battery.charging.tunables import Backoff
from chargetune.battery.plants.electrochemical import Electrochemical
from chargetune.battery.studies.open_study import evaluation_of, make_tuner
from chargetune.battery.studies.study_file import load_config, problem_of_document
from chargetune.study.executors import process_executor
from charging_problems import charging_problem

CELL = default_cell()
WARM = replace(CELL, thermal=Thermal(heat_capacity_J_K=40.0, cooling_W_K=0.05))
# Most, as the table may have it.
MOST = dict.fromkeys(("resistance", "resistance_by_node", "capacitance", "capacitance_by_node"), 0.9)
MOST |= {"capacity": 0.5, "fade": 0.5, "growth": 2.0, "voltage_bias_V": 0.1}
PAIRS = {"soc_start": (0.0, 1.0), "ambient_K": (200.0, 400.0)}


def drawn(settings, cell=CELL, count=64, **entries):
    problem = replace(charging_problem(cell, backoff=Backoff(nodes=2), **entries), range=settings)
    use = ChargingRange(problem)
    return use, use.draw(count, 5)


def test_every_entry_has_a_bound_and_a_meaning():
    # What says nothing of the plants.
    own = ("draws", "drop_idle", "cell", "objective_quantile")
    assert {*MOST, *PAIRS, "cells", "node_correlation", *own} == {part.name for part in fields(ChargingRangeSettings)} == {*MEANING, *own}


@pytest.mark.parametrize(("name", "most"), MOST.items())
def test_bounds_of_the_numbers(name, most, tmp_path):
    path = tmp_path / "s.toml"
    for value in (0.0, most):
        path.write_text(f"[range]\n{name} = {value}\n")
        assert getattr(load_config(path).range, name) == value
    for value in (-1e-6, 1.001 * most, "nan", "inf", "true", '"a"', "[0.1]"):
        path.write_text(f"[range]\n{name} = {value}\n")
        with pytest.raises(ValueError, match=name):
            load_config(path)


@pytest.mark.parametrize(("name", "bounds"), PAIRS.items())
def test_bounds_of_the_intervals(name, bounds, tmp_path):
    path, (low, high) = tmp_path / "s.toml", bounds
    path.write_text(f"[range]\n{name} = [{low}, {high}]\n")
    assert getattr(load_config(path).range, name) == bounds
    for pair in (
        f"[{low - 1}, {high}]",
        f"[{low}, {high + 1}]",
        f"[{high}, {low}]",
        f"[{low}]",
        f"[{low}, {high}, {high}]",
        "[nan, nan]",
        "0.3",
    ):
        path.write_text(f"[range]\n{name} = {pair}\n")
        with pytest.raises(ValueError, match=name):
            load_config(path)


@pytest.mark.parametrize("value", ["0", "-1", "1.5", "true", "200000"])
def test_draws_are_a_count(value, tmp_path):
    path = tmp_path / "s.toml"
    path.write_text(f"[range]\ndraws = {value}\n")
    with pytest.raises(ValueError, match="draws"):
        load_config(path)


def test_a_misspelt_entry_is_no_default(tmp_path):
    path = tmp_path / "s.toml"
    path.write_text("[range]\nresistence = 0.1\n")
    with pytest.raises(ValueError, match=r"range\.resistence is not a known key"):
        load_config(path)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (ChargingRangeSettings(ambient_K=(280.0, 300.0)), "ambient_K = .*, allowed only for a cell with a .thermal. table"),
        (ChargingRangeSettings(soc_start=(0.1, 0.95)), "soc_start = .*, allowed is less than the SOC that is charged to, 0.9"),
    ],
)
def test_what_does_not_fit_the_problem_is_refused(settings, words):
    with pytest.raises(ValueError, match=words):
        drawn(settings, soc_target=0.9)


def test_the_table_survives_the_store_and_says_how_many_plants_a_trial_has(tmp_path):
    path = tmp_path / "s.toml"
    path.write_text('[study]\ntuner = "range"\n[range]\nsoc_start = [0.1, 0.4]\ngrowth = 0.5\ndraws = 17\n[theta.backoff]\n')
    config = load_config(path)
    problem = problem_of_document(config.document())
    assert problem == config.problem()
    assert problem.range.soc_start == (0.1, 0.4)
    assert evaluation_of("range", problem).plants == 17
    assert evaluation_of("range", replace(problem, range=ChargingRangeSettings())).plants == 1000


def test_what_is_drawn_by_entry():
    settings = ChargingRangeSettings(
        soc_start=(0.1, 0.5), ambient_K=(280.0, 310.0), resistance=0.2, resistance_by_node=0.1, capacitance=0.3, capacity=0.02, fade=0.2,
        growth=0.5, voltage_bias_V=0.004,
    )  # fmt: skip
    use, plants = drawn(settings, WARM)
    for one in plants:
        p = {name: np.array(values) for name, values in one.plant.model.parameters}
        v = {name: np.array(values) for name, values in use.values(one).items()}
        nodes = v["resistance_by_node"].reshape(2, -1)
        for name, own in zip(("R0_ohm", "R1_ohm"), nodes, strict=True):
            expected = np.array(getattr(CELL, name)) * (1 + v["resistance"]) * (1 + own) * (1 + 0.5 * v["age"])
            np.testing.assert_allclose(p[name].ravel(), expected)
        np.testing.assert_allclose(p["C1_F"].ravel(), np.array(CELL.C1_F) * (1 + v["capacitance"]))
        np.testing.assert_allclose(p["capacity_Ah"], CELL.capacity_Ah * (1 + v["capacity"]) * (1 - 0.2 * v["age"]))
        # The cell begins at its ambient, which is that of the whole charge.
        assert p["ambient_K"] == pytest.approx(one.plant.start["temperature_K"]) == v["ambient_K"]
        assert one.plant.sensors.bias["voltage_V"] == v["voltage_bias_V"]
    spans = {
        name: [float(np.min([use.values(d)[name] for d in plants])), float(np.max([use.values(d)[name] for d in plants]))] for name in v
    }
    for name, low, high in (("soc_start", 0.1, 0.5), ("ambient_K", 280.0, 310.0), ("age", 0.0, 1.0), ("voltage_bias_V", -0.004, 0.004)):
        assert low <= spans[name][0] < low + 0.1 * (high - low)
        assert high - 0.1 * (high - low) < spans[name][1] <= high


def test_the_line_of_a_range():
    settings = ChargingRangeSettings(soc_start=(0.05, 0.5), resistance=0.2, growth=0.5)
    assert settings.line == "soc_start 0.05 to 0.5, resistance +-0.2, growth 0.5"
    assert settings.names == ("soc_start", "resistance", "growth")
    assert range_line(ChargingRangeSettings().entries) == "nothing differs but the noise"


def test_charges_of_an_electrochemical_plant_are_the_same_in_other_processes():
    problem = charging_problem(CELL, plant=Electrochemical("SPM"), steps=4, backoff=Backoff(nodes=2))
    problem = replace(problem, range=ChargingRangeSettings(soc_start=(0.3, 0.5), capacity=0.1, growth=0.5))
    use, theta = ChargingRange(problem), problem.space.default
    plants = use.draw(2, 5)
    here = use.run([theta] * 2, plants)
    with process_executor(2) as executor:
        there = replace(use, executor=executor).run([theta] * 2, plants)
        assert replace(use, executor=executor).run([], []) == []
    for one, other in zip(here, there, strict=True):
        # A worker has one thread of linear algebra, this process may have more, so sums may be rounded otherwise.
        np.testing.assert_allclose(one.output_end, other.output_end, rtol=0, atol=1e-6)
        np.testing.assert_allclose(one.input, other.input, rtol=0, atol=1e-4)
    assert np.max(np.abs(here[0].output_end - here[1].output_end)) > 1e-2


def test_the_search_over_an_electrochemical_plant_leaves_all_of_the_tolerance_to_plants_that_it_did_not_draw():
    circuit = replace(charging_problem(CELL, backoff=Backoff(nodes=2)), range=ChargingRangeSettings(soc_start=(0.3, 0.5), drop_idle=True))
    many, few = (make_tuner("range", 0, replace(circuit, plant=plant)).settings for plant in (None, Electrochemical("SPM")))
    assert few.plants < many.plants
    assert few.aim == 0.0 < many.aim
    assert few.drop_idle
    assert many.drop_idle
