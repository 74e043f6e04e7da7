"""The condensed problem against finite differences and dense algebra; the residual against IPOPT."""

import casadi as ca
import numpy as np
import pytest
from systems import controller, ipopt_solution, random_point

from chargetune.control.control_step import problem_of
from chargetune.control.controller import SoftLimit
from chargetune.control.sqp import KKT_TOLERANCE, cold, solver


def differences(function, at, step=1e-6):
    columns = []
    for k in range(len(at)):
        ahead, behind = at.copy(), at.copy()
        ahead[k] += step
        behind[k] -= step
        columns.append((function(ahead) - function(behind)) / (2 * step))
    return np.array(columns).T


def coordinates(problem, inputs, rows, derivatives, lower, upper):
    """(g, T, rows of A, lba, uba, span, gamma) of the QP with v = T e and the slacks apart."""
    gamma, near = problem.scaling(derivatives, lower, upper)
    g, columns, lba, uba, span = (np.array(o) for o in problem.quadratic(inputs, rows, derivatives, lower, upper, gamma, near))
    slacks, size = len(problem.controller.limits), problem.size
    return g[slacks:, 0], columns[slacks:, :size].T, columns[slacks:, size:].T, lba.ravel(), uba.ravel(), span.ravel(), float(gamma)


HELD = {
    "blocks": (1, 2, 3),
    "input_rate": {"force": 0.1},
    "stage_cost": lambda s: (s.x["position"] - 1) ** 2 + 0.1 * s.u["force"] ** 2 + 0.3 * (s.u["force"] - s.u_last["force"]) ** 2,
}


@pytest.mark.parametrize(("slot", "change"), [("l", {}), ("X", {}), ("E", {}), ("E", {"blocks": (1, 2, 3)}), ("X", HELD)])
def test_condensed_gradient_and_jacobian_are_those_of_finite_differences(slot, change):
    problem = problem_of(controller(slot, **change))
    now, inputs, q, lower, upper = random_point(problem)
    _, rows, derivatives = problem.sweep(now, inputs, q)
    gradient, transform, jacobian, lba, uba, span, gamma = coordinates(problem, inputs, rows, derivatives, lower, upper)
    size = problem.size
    slope = differences(lambda u: float(problem.sweep(now, u, q)[0]), inputs)
    np.testing.assert_allclose(gradient, transform.T @ (gamma * span * slope), rtol=1e-6, atol=1e-7)
    matrix = differences(lambda u: np.array(problem.sweep(now, u, q)[1]).ravel(), inputs)
    np.testing.assert_allclose(jacobian, matrix * span @ transform, rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(uba[size:], -np.array(rows).ravel())
    assert np.all(lba[size:] == -np.inf)
    np.testing.assert_allclose(lba[:size] * span + inputs, lower)
    np.testing.assert_allclose(uba[:size] * span + inputs, upper)


def test_slacks_stand_against_their_rows_with_the_penalty_as_price():
    own = controller("X")
    problem = problem_of(own)
    now, inputs, q, lower, upper = random_point(problem)
    _, rows, derivatives = problem.sweep(now, inputs, q)
    gamma, near = (float(one) for one in problem.scaling(derivatives, lower, upper))
    g, columns, *_ = (np.array(o) for o in problem.quadratic(inputs, rows, derivatives, lower, upper, gamma, near))
    for j, limit in enumerate(own.limits):
        price = gamma * limit.penalty * limit.scale
        # s = e / sqrt(price) costs price (s + s^2 / 2).
        assert g[j, 0] == pytest.approx(np.sqrt(price))
        wanted = [0.0] * problem.size + [-1 / np.sqrt(price) if group == j else 0.0 for group in problem.groups]
        np.testing.assert_allclose(columns[j], wanted)


def test_transformed_hessian_is_gauss_newton_by_dense_algebra():
    """l = (position - 1 + 0.3 force)^2 + 0.1 force^2 at x_0 .. x_{N-1}, Vf = 5 (position - 1)^2 at x_N."""
    own = controller(stage_cost=lambda s: (s.x["position"] - 1 + 0.3 * s.u["force"]) ** 2 + 0.1 * s.u["force"] ** 2)
    problem = problem_of(own)
    now, inputs, q, lower, upper = random_point(problem)
    _, rows, derivatives = problem.sweep(now, inputs, q)
    _, transform, *_, span, gamma = coordinates(problem, inputs, rows, derivatives, lower, upper)

    def positions(u):
        x, out = now, []
        for value in u:
            out.append(x[0])
            x = np.array(own.model.f(x, value, own.model.nominal)).ravel()
        return np.array([*out, x[0]])

    of_inputs = differences(positions, inputs)
    residuals = [*(of_inputs[:-1] + 0.3 * np.eye(problem.size)), *(np.sqrt(0.1) * np.eye(problem.size)), np.sqrt(5) * of_inputs[-1]]
    dense = 2 * np.array(residuals).T @ np.array(residuals)
    scaled = gamma * span[:, None] * dense * span + 1e-8 * np.eye(problem.size)
    assert np.mean(np.diag(scaled)) == pytest.approx(1.0, rel=1e-5)
    np.testing.assert_allclose(transform.T @ scaled @ transform, np.eye(problem.size), atol=1e-5)


def hessian_of(problem, inputs, rows, derivatives, lower, upper):
    """The Hessian of the QP in the inputs, from its coordinates: v = T e and |e|^2 / 2."""
    _, transform, *_, span, gamma = coordinates(problem, inputs, rows, derivatives, lower, upper)
    back = np.linalg.inv(transform) / span
    return back.T @ back / gamma


def test_curvature_is_that_of_the_lagrangian_in_each_input():
    """load = 0.8 force + speed^2 at the end of each interval: bent in the force of its own interval by the speed it brings."""
    own = controller("Y", limits=[SoftLimit("load", upper=0.6, at="end")])
    problem = problem_of(own)
    now, inputs, q, lower, upper = random_point(problem)
    _, rows, derivatives = problem.sweep(now, inputs, q)
    multipliers = np.random.default_rng(0).uniform(0.0, 2.0, len(problem.groups))
    bent = problem.curvature(now, inputs, derivatives, multipliers, q)
    added = [hessian_of(problem, inputs, rows, d, lower, upper) for d in (derivatives, bent)]
    found = np.diag(added[1] - added[0])
    # At the last stage the Lagrangian's curvature is the stage's own and that of the costs, 0.2 for the force and 10 at the end.
    total = second_differences(lagrangian(problem, now, q, multipliers), inputs)[-1, -1]
    ahead = differences(lambda u: np.array([own_position(own, now, u)]), inputs)[0, -1]
    assert found[-1] == pytest.approx(total - (0.2 + 10 * ahead**2), rel=1e-3)
    assert found[-1] > 0
    assert np.all(found >= -1e-6)


@pytest.mark.parametrize("blocks", [(), (1, 2, 3)])
def test_exact_hessian_is_that_of_the_lagrangian(blocks):
    """With inputs that push outwards it is positive definite, and nothing of it is changed."""
    own = controller("Y", limits=[SoftLimit("load", upper=0.6, at="end")], hessian="exact", blocks=blocks)
    problem = problem_of(own)
    now, inputs, q, lower, upper = random_point(problem)
    _, rows, derivatives = problem.sweep(now, inputs, q)
    multipliers = np.random.default_rng(0).uniform(0.0, 2.0, len(problem.groups))
    wanted = second_differences(lagrangian(problem, now, q, multipliers), inputs)
    assert np.linalg.eigvalsh(wanted)[0] > 0
    found = hessian_of(problem, inputs, rows, problem.curvature(now, inputs, derivatives, multipliers, q), lower, upper)
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-4 * np.max(np.abs(wanted)))
    straight = hessian_of(problem, inputs, rows, derivatives, lower, upper)
    assert np.max(np.abs(straight - wanted)) > 0.01 * np.max(np.abs(wanted))


@pytest.mark.parametrize("blocks", [(), (1, 2, 3)])
def test_a_hessian_that_is_bent_downwards_is_turned_upwards(blocks):
    cost = {"stage_cost": lambda s: -(s.u["force"] ** 2) + 0.1 * s.x["position"] ** 2, "terminal_cost": lambda s: 0.0}
    own = controller("Y", **cost, limits=[], blocks=blocks)
    assert own.hessian == "exact"
    problem = problem_of(own)
    now, inputs, q, lower, upper = random_point(problem)
    _, rows, derivatives = problem.sweep(now, inputs, q)
    bent = problem.curvature(now, inputs, derivatives, np.zeros(0), q)
    wanted = second_differences(lagrangian(problem, now, q, np.zeros(0)), inputs)
    assert np.all(np.diag(wanted) < 0)
    assert np.linalg.eigvalsh(hessian_of(problem, inputs, rows, bent, lower, upper))[0] > 0


def lagrangian(problem, now, q, multipliers):
    def value(at):
        cost, c, _ = problem.sweep(now, at, q)
        return float(cost) + multipliers @ np.array(c).ravel()

    return value


def second_differences(function, at, step=1e-3):
    size = at.size
    unit = step * np.eye(size)
    return np.array(
        [
            [
                (
                    function(at + unit[i] + unit[j])
                    - function(at + unit[i] - unit[j])
                    - function(at - unit[i] + unit[j])
                    + function(at - unit[i] - unit[j])
                )
                / (4 * step**2)
                for j in range(size)
            ]
            for i in range(size)
        ]
    )


def own_position(own, now, inputs):
    x = now
    for value in inputs:
        x = np.array(own.model.f(x, value, own.model.nominal)).ravel()
    return x[0]


@pytest.mark.parametrize("seed", range(3))
def test_residual_is_zero_where_ipopt_says_it_is_optimal_and_nowhere_near(seed):
    own = controller("E")
    problem = problem_of(own)
    now, inputs, q, lower, upper = random_point(problem, seed)
    best, multipliers = ipopt_solution(own, now, inputs)

    def residual(at, duals):
        _, rows, derivatives = problem.sweep(now, at, q)
        gamma, _ = problem.scaling(derivatives, lower, upper)
        return float(problem.residual(at, rows, derivatives, float(gamma) * 0.1 * duals, gamma, lower, upper))

    assert residual(best, multipliers) < 1e-5
    inward = np.where(best > 0, -0.05, 0.05)
    assert residual(best + inward, multipliers) > 100 * KKT_TOLERANCE
    assert residual(best, multipliers + 1.0) > 100 * KKT_TOLERANCE
    assert np.isinf(residual(best * np.nan, multipliers))


def test_residual_sees_a_multiplier_of_an_unused_row():
    """The same one added to the upper and the lower row cancels in the gradient: only complementarity is wrong."""
    own = controller("l", limits=[SoftLimit("speed", lower=-5.0, upper=5.0, at="end")])
    problem = problem_of(own)
    now, _, q, lower, upper = random_point(problem)
    inputs, *_ = solver(problem)(now, cold(problem, np.zeros(1)), q)
    _, rows, derivatives = problem.sweep(now, inputs, q)
    gamma, _ = problem.scaling(derivatives, lower, upper)
    none, both = np.zeros(2 * own.horizon), np.zeros(2 * own.horizon)
    both[:2] = 0.3
    assert float(problem.residual(inputs, rows, derivatives, none, gamma, lower, upper)) <= KKT_TOLERANCE
    assert float(problem.residual(inputs, rows, derivatives, both, gamma, lower, upper)) == pytest.approx(0.3)


@pytest.mark.parametrize("change", [{}, {"limits": [], "input_rate": {"force": 0.1}}])
def test_merit_refuses_a_point_where_a_row_is_no_number(change):
    problem = problem_of(controller("l", **change))
    rows = np.full(len(problem.groups), -1.0)
    assert float(problem.merit(2.0, rows)) == 2.0
    rows[3] = np.nan
    assert np.isinf(float(problem.merit(2.0, rows)))


@pytest.mark.parametrize("at", ["start", "end", "both"])
def test_a_limit_without_the_input_in_it_is_set_at_the_end_only(at):
    """The value at the start of an interval is given or the one at the end of the interval before."""
    own = controller("l", limits=[SoftLimit("position", upper=0.1, at=at)])
    assert own.limits[0].at == "end"
    problem = problem_of(own)
    q = problem.prepare(own.theta.default, ca.DM(own.setpoint), own.model.nominal)
    # x_0 is beyond the limit and nothing can be done about it: it is no row.
    rows = np.array(problem.sweep([0.2, -1.0], np.zeros(problem.size), q)[1]).ravel()
    assert rows.size == own.horizon
    assert rows[0] < 0
