"""Cells of one make as a range of use: closed forms, and a folder of cell files from the study to its certificate."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import kstest, norm, t

from chargetune.battery.cell.cell import default_cell
from chargetune.battery.certification.certificate import run_charges, write_certificate
from chargetune.battery.charging.charging_range import ChargingRange
from chargetune.battery.charging.population import population
from chargetune.battery.charging.range_settings import ChargingRangeSettings
from chargetune.battery.charging.range_twin import ChargingRangeTwin, RangeCharge
from chargetune.battery.identification.pulse_fit import cell_toml
from chargetune.battery.plants.electrochemical import Electrochemical
from chargetune.battery.studies.study_file import load_config, problem_of_document
from chargetune.learning.range_of_use.range_twin import parameters_of
from chargetune.learning.twin.ensemble import learn
from chargetune.verify import verify
from charging_problems import charging_problem

CELL = default_cell()
TABLES = ("R0_ohm", "R1_ohm", "C1_F")


def made(factor, nodes=None, capacity=1.0):
    """The cell with R0 and R1 times this, and those of R0 times these."""
    own = np.ones(len(CELL.soc)) if nodes is None else np.asarray(nodes)
    return replace(
        CELL, name=f"cell {factor:g}", capacity_Ah=CELL.capacity_Ah * capacity, R0_ohm=tuple(factor * own * CELL.R0_ohm),
        R1_ohm=tuple(factor * np.array(CELL.R1_ohm)),
    )  # fmt: skip


@pytest.fixture
def folder(tmp_path):
    cells = tmp_path / "make" / "cells"
    cells.mkdir(parents=True)
    for i, (factor, capacity) in enumerate(((0.8, 1.02), (1.0, 1.0), (1.1, 0.99), (1.25, 0.97))):
        (cells / f"{i}.toml").write_text(cell_toml(made(factor, capacity=capacity)))
    (tmp_path / "s.toml").write_text(
        '[controller]\nhorizon = 3\n[episode]\nsteps = 60\nsoc_start = 0.4\n[range]\ncells = "make/cells"\nsoc_start = [0.3, 0.5]\n'
        "[theta.backoff]\nnodes = 2\n[sensors]\nvoltage_noise_sd_V = 0.001\n"
    )
    return tmp_path


def test_it_is_the_predictive_distribution_of_the_next_cell():
    """Mean of the logarithms, and Student's t with n - 1 degrees of freedom times s sqrt(1 + 1/n)."""
    factors = np.array([0.8, 1.0, 1.1, 1.25])
    middle, differ = population(CELL, [made(f) for f in factors])
    logs = np.log(factors)
    np.testing.assert_allclose(middle.R0_ohm, np.exp(logs.mean()) * np.array(CELL.R0_ohm), rtol=1e-12)
    np.testing.assert_allclose(middle.C1_F, CELL.C1_F, rtol=1e-12)
    assert differ.distribution.degrees == 3.0
    spread = logs.std(ddof=1) * np.sqrt(1 + 1 / 4)
    np.testing.assert_allclose(differ.parameters["R0_ohm"], spread, rtol=1e-12)
    np.testing.assert_allclose(differ.parameters["C1_F"], 0.0, atol=1e-12)


def test_draws_differ_as_the_cells_do():
    """R0 and R1 have one factor in these cells, so they have in each draw; the median of many is the mean cell, its quantiles Student's."""
    factors = np.array([0.8, 1.0, 1.1, 1.25])
    problem = replace(
        charging_problem(CELL), range=ChargingRangeSettings(cells="x"), range_cells=tuple(made(f, capacity=f**-0.1) for f in factors)
    )
    logs, found = np.log(factors), []
    for one in ChargingRange(problem).draw(1024, 3):
        p = {name: np.array(values).ravel() for name, values in one.plant.model.parameters}
        ratio = np.log(p["R0_ohm"] / CELL.R0_ohm)
        np.testing.assert_allclose(ratio, ratio[0], atol=1e-6)
        np.testing.assert_allclose(np.log(p["R1_ohm"] / CELL.R1_ohm), ratio[0], atol=1e-6)
        np.testing.assert_allclose(np.log(p["capacity_Ah"] / CELL.capacity_Ah), -0.1 * ratio[0], atol=1e-6)
        np.testing.assert_allclose(p["C1_F"], CELL.C1_F, rtol=1e-9)
        found.append(ratio[0])
    standard = (np.array(found) - logs.mean()) / (logs.std(ddof=1) * np.sqrt(1.25))
    # 0.05 is the 99 % quantile of the statistic for so many draws.
    assert kstest(standard, t(3).cdf).statistic < 0.05
    assert kstest(standard, norm.cdf).statistic > 0.05


def test_tables_of_other_nodes_are_read_at_those_of_the_study():
    fine = np.linspace(0.0, 1.0, 41)
    other = replace(
        CELL, soc=tuple(fine), **{name: tuple(np.exp(np.interp(fine, CELL.soc, np.log(getattr(CELL, name))))) for name in TABLES}
    )
    middle, _ = population(CELL, [other, CELL, other])
    for name in TABLES:
        # Between two nodes of the finer table the line is not exactly that of the coarser one.
        np.testing.assert_allclose(getattr(middle, name), getattr(CELL, name), rtol=0.02)


def test_what_the_cells_have_and_the_study_has_not_is_refused():
    with pytest.raises(ValueError, match="cells = 'x' has 2 cell files, allowed are at least 3"):
        replace(charging_problem(CELL), range=ChargingRangeSettings(cells="x"), range_cells=(CELL, CELL))
    two = replace(CELL, name="two", R2_ohm=CELL.R1_ohm, C2_F=tuple(10 * np.array(CELL.C1_F)))
    with pytest.raises(ValueError, match="'two' has 2 R-C pairs, allowed are 1, as the study's cell has"):
        replace(charging_problem(CELL), range=ChargingRangeSettings(cells="x"), range_cells=(CELL, CELL, two))


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ('cells = "nowhere"', "range: cells = .*nowhere.*, allowed is a folder of cell files"),
        ('cells = ""', "cells = '', allowed is a folder of cell files"),
        ("cells = 3", "range.cells = 3, allowed is text in quotes"),
        ("node_correlation = 0.5", "node_correlation = 0.5, allowed only with resistance_by_node or capacitance_by_node"),
        ("node_correlation = 1.0\nresistance_by_node = 0.1", r"node_correlation = 1.0, allowed is \[0, 0.99\]"),
    ],
)
def test_nonsense_in_the_file_is_refused_by_name(table, words, tmp_path):
    path = tmp_path / "s.toml"
    path.write_text(f"[range]\n{table}\n")
    with pytest.raises(ValueError, match=words):
        load_config(path).problem(tmp_path)


def test_a_folder_without_a_cell_and_a_file_that_is_none(folder):
    (folder / "make" / "cells" / "z.toml").write_text("[study]\n")
    with pytest.raises(ValueError, match=r"z\.toml"):
        load_config(folder / "s.toml").problem(folder)
    (folder / "empty").mkdir()
    (folder / "s.toml").write_text('[range]\ncells = "empty"\n')
    with pytest.raises(ValueError, match="cells = 'empty' has 0 cell files, allowed are at least 3"):
        load_config(folder / "s.toml").problem(folder)


def test_the_store_holds_the_cells_and_needs_no_folder(folder):
    config = load_config(folder / "s.toml")
    problem, document = config.problem(folder), json.loads(json.dumps(config.document(folder)))
    assert len(problem.range_cells) == 4
    for path in (folder / "make" / "cells").iterdir():
        path.unlink()
    again = problem_of_document(document)
    assert again.range_cells == problem.range_cells
    assert again.range.line == "soc_start 0.3 to 0.5, cells like those of cells"
    first, second = (ChargingRange(one).draw(3, 1) for one in (problem, again))
    assert [one.values for one in first] == [one.values for one in second]


def test_an_electrochemical_plant_has_no_circuit():
    problem = charging_problem(CELL, plant=Electrochemical())
    problem = replace(problem, range=ChargingRangeSettings(cells="x"), range_cells=(CELL,) * 3)
    with pytest.raises(ValueError, match="cells = 'x', allowed is none for an electrochemical plant"):
        ChargingRange(problem)


def test_its_certificate_says_of_which_cells_and_verifies(folder):
    problem = load_config(folder / "s.toml").problem(folder)
    charges = [charge for part in run_charges(problem, problem.space.default, seed=1, episodes=4) for charge in part]
    theta = dict(zip(problem.space.entries, problem.space.default.tolist(), strict=True))
    path = folder / "c.json"
    certificate = write_certificate(path, problem, charges, theta=theta, origin={"range": "study"}, seed=1, confidence=0.95)
    assert certificate["range"]["cells"] == "make/cells"
    assert "4 cells: cell 0.8, cell 1, cell 1.1, cell 1.25" in certificate["drawn"]
    assert verify(path) == []


def test_a_cell_of_the_make_is_learnt(folder):
    """Of two charges of a cell: the twin's resistances are nearer to it than the mean of the make is."""
    text = (folder / "s.toml").read_text().replace("[range]\n", "[range]\ncell = 2\n").replace("steps = 60", "steps = 120")
    (folder / "s.toml").write_text(text)
    problem = load_config(folder / "s.toml").problem(folder)
    loop, run, theta = ChargingRangeTwin(problem), RangeCharge(problem), problem.space.default
    episodes = [run(theta, seed)[1] for seed in (1, 2)]
    trials = [SimpleNamespace(number=i, theta=tuple(theta), status="done", seed=i, episode=lambda e=e: e) for i, e in enumerate(episodes)]
    learnt = learn(loop, trials)
    (true,) = ChargingRange(problem).draw(1, 0)
    known = dict(true.plant.model.parameters)
    off = []
    draws = loop.twin.unknowns_at(learnt.posterior.draw_scores(200, 0))
    for unknowns in (loop.twin.unknowns_at(np.zeros(loop.twin.score_count)), draws.mean(axis=0)):
        own = parameters_of(loop.twin, unknowns)["R0_ohm"]
        off.append(float(np.mean(np.abs(np.log(own / np.ravel(known["R0_ohm"]))))))
    assert off[1] < 0.3 * off[0]
