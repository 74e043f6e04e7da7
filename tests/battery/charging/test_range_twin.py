"""Learning one cell of a range of use from its charges."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from chargetune.battery.charging.charging_range import ChargingRange
from chargetune.battery.charging.controller import controller_of
from chargetune.battery.charging.range_twin import ChargingRangeTwin, RangeCharge
from chargetune.battery.charging.tunables import CapacityRatio
from chargetune.battery.studies.open_study import evaluation_of, make_tuner
from chargetune.battery.studies.study_file import load_config
from chargetune.learning.range_of_use.range_twin import parameters_of
from chargetune.learning.twin.ensemble import learn

EXAMPLES = Path(__file__).parents[3] / "examples"
FILE = EXAMPLES / "range_learn.toml"


@pytest.fixture(scope="module")
def problem():
    found = load_config(FILE).problem()
    return replace(found, theta=replace(found.theta, capacity=CapacityRatio()))


def of_cell(problem, cell):
    return replace(problem, range=replace(problem.range, cell=cell))


def test_one_cell_of_the_range_is_the_same_in_every_charge(problem):
    use = ChargingRange(problem)
    draws = use.draw(8, 1) + use.draw(8, 2)
    assert len({one.plant.model.nominal.tobytes() for one in draws}) == 1
    assert len({one.plant.start["soc"] for one in draws}) == 16
    other = ChargingRange(of_cell(problem, 4)).draw(1, 1)[0]
    assert not np.allclose(other.plant.model.nominal, draws[0].plant.model.nominal)
    assert problem.range.names == ("soc_start",)
    assert "one cell of it, number 3" in problem.range.line


def test_each_charge_of_a_study_is_in_a_condition_that_its_seed_draws(problem):
    run = evaluation_of("twin", problem)
    assert isinstance(run, RangeCharge)
    starts = [run(problem.space.default, seed)[1].signal("soc")[0][0] for seed in (1, 1, 2)]
    assert starts[0] == starts[1] != starts[2]


def test_without_a_number_the_plant_is_the_cell_of_the_file(problem):
    plain = of_cell(problem, None)
    plain = replace(plain, sensors=type(plain.sensors)())
    score, episode, _ = RangeCharge(plain)(plain.space.default, 3)
    start = episode.signal("soc")[0][0]
    assert start != plain.episode.soc_start
    soc = episode.signal("soc")[1]
    # The nominal capacity: z+ = z + Ts I / (3600 Q).
    moved = np.diff(np.append(start, soc))
    np.testing.assert_allclose(moved, 10.0 * episode.input[:, 0] / 3600 / plain.cell.capacity_Ah, atol=1e-9)
    assert score.metrics["t80_min"] is not None


def test_traces_narrow_the_range_around_the_cell(problem):
    """Its posterior holds the true tables and capacity, which the controller is not told."""
    loop, run = ChargingRangeTwin(problem), RangeCharge(problem)
    episodes = [run(problem.space.default, seed)[1] for seed in (1, 2)]
    trials = [Told(episode) for episode in episodes]
    learnt = learn(loop, trials)
    draws = loop.twin.unknowns_at(learnt.posterior.draw_scores(200, 0))
    before = loop.twin.unknowns_at(np.random.default_rng(0).standard_normal((200, loop.twin.score_count)))
    cell = dict(ChargingRange(problem).draw(1, 0)[0].plant.model.parameters)
    nominal, names = dict(loop.twin.model.parameters), [one.name for one in loop.twin.unknowns]
    truth = np.concatenate([np.log(np.array(cell[name]) / np.array(nominal[name])) for name in names])
    sd = draws.std(axis=0)
    # R0 in the range of the charges to a few per cent, where the range has more than 20.
    resistances = slice(1, 8)
    assert np.all(sd[resistances] < 0.5 * before.std(axis=0)[resistances])
    assert np.sqrt(np.mean(((draws.mean(axis=0) - truth) / sd) ** 2)) < 2.0
    assert not learnt.rejected


def test_the_matched_theta_gives_the_controller_the_circuit_of_the_plant(problem):
    loop = ChargingRangeTwin(problem)
    unknowns = loop.twin.unknowns_at(np.full(loop.twin.score_count, 0.3))
    theta, held = loop.matched(unknowns)
    named = {name: held[at].all() for name, at in problem.space.slices.items()}
    assert {name for name, all_held in named.items() if all_held} == {"R0_ratio", "R1_ratio", "capacity_ratio"}
    controller = controller_of(problem)
    blocks = list(controller.model.parameter_blocks)
    first = dict(zip(blocks, np.cumsum([0, *controller.model.parameter_blocks.values()]), strict=False))
    p = np.array(controller.parameters(theta, controller.model.nominal, np.zeros(0))).ravel()
    wanted = parameters_of(loop.twin, unknowns)
    for name in ("R0_ohm", "R1_ohm", "capacity_Ah"):
        at = int(first[name])
        np.testing.assert_allclose(p[at : at + len(wanted[name])], wanted[name], rtol=1e-9)
    bare = replace(problem, theta=replace(problem.theta, R0=None, R1=None, capacity=None))
    assert ChargingRangeTwin(bare).matched(unknowns) is None


def test_the_learner_knows_nothing_of_the_number_of_the_cell(problem):
    first, second = (ChargingRangeTwin(of_cell(problem, cell)) for cell in (3, 4))
    assert [one.values for one in first.draw(4, 1)] == [one.values for one in second.draw(4, 1)]
    assert repr(first.twin.content) == repr(second.twin.content)


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ("[twin]\nresistance_spread = 0.3\n", r"\[twin\] is given with a table \[range\] and without \[plant\]"),
        ("[range]\ncell = -1\n", r"range: cell = -1, allowed is an integer >= 0"),
        ("[range]\ncell = 1.5\n", r"cell"),
        ("[range]\nsoc_start = [0.1, 0.2]\n", r"nothing differs from plant to plant"),
    ],
)
def test_what_cannot_be_learnt_is_refused(table, message, tmp_path):
    path = tmp_path / "s.toml"
    text = '[study]\ntuner = "twin"\n[theta.R0]\n' + table + ("" if "[range]" in table else "[range]\nresistance = 0.1\n")
    path.write_text(text)

    def tuner():
        config = load_config(path)
        return make_tuner("twin", 0, config.problem(), config.twin)

    with pytest.raises(ValueError, match=message):
        _ = tuner().loop.twin


def test_a_plant_that_is_no_circuit_leaves_every_table_unsure():
    config = load_config(EXAMPLES / "range_dfn.toml")
    loop = make_tuner("twin", 0, config.problem(EXAMPLES), config.twin).loop
    assert loop.spread == 0.4
    sd = {one.name: one.sd for one in loop.twin.unknowns}
    assert sd["C1_F"] == pytest.approx(0.4, rel=1e-3)
    assert sd["R0_ohm"] > 0.4
    # The discrepancy is told apart from the coldest start on.
    assert loop.features["temperature_K"][0] == 278.0
    assert tuple(loop.twin.noise_sd) == ("voltage_V", "temperature_K", "anode_potential_V")
    assert loop.twin.prior.read == ("voltage_V", "soc", "temperature_K")


class Told:
    """A trial with a trace."""

    def __init__(self, episode):
        self.episode = lambda: episode
