"""Draws of a posterior against the equation that they are to solve, and another solver of it."""

import numpy as np
import pytest
from scipy.optimize import root

from chargetune.battery.cell.cell import default_cell
from chargetune.battery.charging.evaluate import run_charge
from chargetune.battery.charging.tunables import ResistanceRatio
from chargetune.battery.charging.twin_loop import ChargingTwin
from charging_problems import charging_problem

# In standard deviations of the posterior, what of the equation may be left, squared; and what a solution further on may differ by.
LEFT, AWAY = 0.05, 0.3


@pytest.fixture(scope="module")
def posterior():
    problem = charging_problem(default_cell(), mismatch_seed=1, voltage_noise_sd_V=0.002, steps=120, R0=ResistanceRatio())
    return ChargingTwin(problem).twin.fit([run_charge(problem, problem.space.default, seed=k) for k in (0, 1)])


def equation(posterior, draw):
    """m -> J'W (y(m) - y(mode) - J (m' - mode)) + S^-1 (m - m'), in standard deviations of the posterior, from the twin alone."""
    twin, mode = posterior.twin, posterior.mode
    inputs = [u for u, _ in posterior.seen]
    slopes = np.concatenate([twin.slopes(mode, u).reshape(-1, mode.size) for u in inputs]) / posterior.spread[0]
    prior = np.linalg.inv(twin.prior_factor @ twin.prior_factor.T)
    scale = np.linalg.cholesky(np.linalg.inv(slopes.T @ slopes + prior)).T

    def predicted(m):
        return np.concatenate([twin.predict(m, u).ravel() for u in inputs]) / posterior.spread[0]

    wanted = predicted(mode) + slopes @ draw
    return lambda m: scale @ (slopes.T @ (predicted(m) - wanted) + prior @ (m - mode - draw))


def test_draws_solve_their_equation_as_another_solver_does(posterior):
    """Gaussian draws are far from it: what is predicted is not linear in the logarithms of resistances."""
    draws = np.random.default_rng(2).standard_normal((24, posterior.root.shape[1])) @ posterior.root.T
    moved = posterior.moved(draws)
    sd = np.sqrt(np.diag(posterior.covariance))
    solved, unmoved = [], []
    for draw, m in zip(draws, moved, strict=True):
        left = equation(posterior, draw)
        unmoved.append(np.sum(left(posterior.mode + draw) ** 2))
        solved.append(np.sum(left(m) ** 2) < LEFT)
        if solved[-1]:
            further = root(left, m, tol=1e-8)
            assert further.success
            assert np.max(np.abs(further.x - m) / sd) < AWAY
    # One in a hundred may not be where it is solved, and is halved.
    assert np.mean(solved) >= 0.9
    assert np.mean(np.array(unmoved) > LEFT) >= 0.9


def test_in_factors_a_draw_begins_nearer_than_in_logarithms(posterior):
    """What a draw begins at is as far from the solution as the data are from linear in what is drawn."""
    draws = np.random.default_rng(2).standard_normal((24, posterior.root.shape[1])) @ posterior.root.T
    begun, _ = posterior._moved_by(draws)
    in_factors, in_logarithms = (
        [np.sum(equation(posterior, draw)(m) ** 2) for draw, m in zip(draws, starts, strict=True)]
        for starts in (begun, posterior.mode + draws)
    )
    assert np.median(in_factors) < 0.5 * np.median(in_logarithms)


def test_a_draw_that_may_not_be_where_it_is_brought_to_is_halved(posterior, monkeypatch):
    draws = np.random.default_rng(2).standard_normal((4, posterior.root.shape[1])) @ posterior.root.T
    whole, half = posterior.moved(draws), posterior.moved(0.5 * draws)
    refused = iter([np.array([1.0, np.nan, 1.0, np.inf]), np.array([1.0, 1.0])])
    led = type(posterior)._led
    monkeypatch.setattr(type(posterior), "_led", lambda self, some: (led(self, some)[0], next(refused)))
    moved = posterior.moved(draws)
    np.testing.assert_allclose(moved[[0, 2]], whole[[0, 2]], atol=1e-12)
    np.testing.assert_allclose(moved[[1, 3]], half[[1, 3]], atol=1e-12)
