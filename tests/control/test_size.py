"""A problem of any size is the same problem: straight-line code or loops, inputs held in blocks, against IPOPT."""

import casadi as ca
import numpy as np
import pytest
from systems import SPACE, controller, linear, plant_model, random_point

from chargetune.control import condensing, ocp
from chargetune.control.control_step import act, begin, problem_of
from chargetune.control.ipopt_reference import ipopt_act
from chargetune.control.ocp import control_problem
from chargetune.control.sqp import SolveStatus
from chargetune.episode.compiled import simulate
from chargetune.episode.stepwise import run_episode
from chargetune.plants.simulated import SimulatedPlant

pytestmark = pytest.mark.usefixtures("virtual_machine")


def test_twelve_states_four_inputs_thirty_intervals_are_as_ipopt_says():
    own, plant = linear(12, 4, 6)
    ours, reference = simulate(own, plant, steps=5), run_episode(own, plant, steps=5, control=ipopt_act)
    assert set(ours.status) == {SolveStatus.CONVERGED}
    np.testing.assert_allclose(ours.input, reference.input, atol=2e-4)
    np.testing.assert_allclose(ours.true_end, reference.true_end, atol=2e-4)
    # Limits and bounds are in the way: it is no mere feedback law.
    assert np.any(np.abs(ours.input) > 0.299)
    assert np.any(ours.true_end[:, :6] > 0.399)


CHANGES = (
    {},
    {"blocks": (1, 2, 3, 5)},
    {"limits": []},
    {"hessian": "exact"},
    {"input_rate": {"force": 0.1}},
    {"hessian": "exact", "input_rate": {"force": 0.1}, "blocks": (1, 2, 3, 5)},
)


@pytest.mark.parametrize("stage_max", [1500, 60, 0])
@pytest.mark.parametrize("change", CHANGES)
def test_loops_and_straight_line_code_are_the_same_functions(monkeypatch, change, stage_max):
    """Chunks of sensitivities: all at once, several of straight-line code, several of loops."""
    own = controller("E", **{"horizon": 11, **change})
    straight = control_problem(own)
    monkeypatch.setattr(ocp, "STRAIGHT_MAX", 0)
    monkeypatch.setattr(condensing, "STAGE_MAX", stage_max)
    loops = control_problem(own)
    assert straight.quadratic.class_name() == "SXFunction"
    assert loops.quadratic.class_name() == "MXFunction"
    now, inputs, q, lower, upper = random_point(straight)
    _, rows, derivatives = straight.sweep(now, inputs, q)
    multipliers = np.random.default_rng(1).uniform(0.0, 2.0, len(straight.groups))
    for name, given in {
        "scaling": (derivatives, lower, upper),
        "quadratic": (inputs, rows, derivatives, lower, upper, 0.7, 0.2),
        "curvature": (now, inputs, derivatives, multipliers, q),
        "convex": (derivatives, lower, upper),
        "residual": (inputs, rows, derivatives, multipliers, 0.7, lower, upper),
        "merit": (1.3, rows),
    }.items():
        for one, other in zip(*(getattr(problem, name).call([ca.DM(g) for g in given]) for problem in (straight, loops)), strict=True):
            np.testing.assert_allclose(np.array(one), np.array(other), rtol=1e-12, atol=1e-12, err_msg=name)


@pytest.mark.parametrize(("blocks", "written_out"), [((), True), ((40,), True), ((60, 60, 80), False)])
def test_long_blocks_are_no_small_problem(blocks, written_out):
    """Few variables, but a product of matrices an interval: what is written out as straight-line code stays small."""
    own, _ = linear(3 if written_out else 12, 1, 1, horizon=sum(blocks) or 20, blocks=blocks)
    quadratic = control_problem(own).quadratic
    assert quadratic.class_name() == ("SXFunction" if written_out else "MXFunction")
    assert quadratic.n_instructions() < 5 * ocp.STRAIGHT_MAX


PLANT = SimulatedPlant(plant_model(), {"position": -0.2, "speed": 0.1})


@pytest.mark.parametrize("slot", ["X", "Y", "E"])
def test_inputs_held_in_blocks_are_as_ipopt_says(slot):
    own = controller(slot, horizon=8, blocks=(1, 1, 2, 4))
    ours, reference = simulate(own, PLANT, steps=15), run_episode(own, PLANT, steps=15, control=ipopt_act)
    assert set(ours.status) == {SolveStatus.CONVERGED}
    np.testing.assert_allclose(ours.input, reference.input, atol=2e-3)


def test_blocks_change_the_loop_where_no_limit_leads_it_and_ipopt_says_the_same():
    free, held = (controller("l", limits=[], horizon=8, blocks=blocks) for blocks in ((), (2, 6)))
    ours, reference = simulate(held, PLANT, steps=15), run_episode(held, PLANT, steps=15, control=ipopt_act)
    assert set(ours.status) == {SolveStatus.CONVERGED}
    np.testing.assert_allclose(ours.input, reference.input, atol=5e-4)
    assert np.max(np.abs(simulate(free, PLANT, steps=15).input - ours.input)) > 2e-2


def test_the_largest_problem_with_blocks_is_as_ipopt_says():
    own, plant = linear(12, 4, 6, blocks=(1, 1, 2, 2, 4, 4, 8, 8))
    ours, reference = simulate(own, plant, steps=3), run_episode(own, plant, steps=3, control=ipopt_act)
    assert problem_of(own).size == 8 * 4
    assert len(problem_of(own).groups) == 30 * 6
    assert set(ours.status) == {SolveStatus.CONVERGED}
    np.testing.assert_allclose(ours.input, reference.input, atol=2e-4)


def test_blocks_of_one_interval_are_no_blocks():
    plain, held = controller("X"), controller("X", blocks=(1,) * 6)
    plant = SimulatedPlant(plant_model(), {})
    assert plain.structure == held.structure
    assert controller("X", blocks=(2, 2, 2)).structure != plain.structure
    for name, values in simulate(plain, plant, steps=10).arrays().items():
        np.testing.assert_array_equal(values, simulate(held, plant, steps=10).arrays()[name])


def test_the_input_of_a_block_is_held_in_the_prediction_and_free_in_the_loop():
    """All in one block: the first input is the best constant one, found by scanning."""
    own = controller("l", limits=[], blocks=(6,))
    problem = problem_of(own)
    received = np.array([0.1, -0.2])
    u, memory, info = act(own, received, SPACE.default, begin(own))
    assert info.status is SolveStatus.CONVERGED
    assert memory.warm.size == 1 + 1
    q = problem.prepare(SPACE.default, ca.DM(own.setpoint), own.model.nominal)
    tried = np.linspace(-0.9, 0.9, 1801)
    costs = [float(problem.sweep(received, value, q)[0]) for value in tried]
    assert float(u[0]) == pytest.approx(tried[int(np.argmin(costs))], abs=1.1e-3)
