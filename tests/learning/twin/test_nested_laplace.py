"""A posterior as a sum of Gaussians along one unknown, against quadrature."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import quad, trapezoid

from chargetune.learning import Twin, Uncertain
from chargetune.learning.twin.laplace import fit
from chargetune.learning.twin.nested_laplace import WIDTH, nested_laplace
from chargetune.learning.twin.posterior import Posterior
from chargetune.model.model import Model, Signal


class Line:
    """r linear in e: the posterior is Laplace's."""

    matrix = np.array([[1.0, 0.0, 0.2], [0.5, 2.0, 0.0], [0.0, 0.3, 1.0], [0.4, 0.1, 0.9]])

    def values(self, e):
        return self.matrix @ (e - np.array([0.3, -0.2, 0.1]))

    def slopes(self, e):
        return self.matrix


class Bent:
    """r = (f(x), (y - g(x)) / s(x), z): given x the others are Gaussian, and p(x) ~ s(x) exp(-f(x)^2 / 2)."""

    def f(self, x):
        return x if x < 0 else x / (1 + 0.15 * x)

    def values(self, e):
        x, y, z = e
        return np.array([self.f(x), (y - x**2) / np.exp(0.1 * x), z])

    def slopes(self, e):
        x, y, _ = e
        s, df = np.exp(0.1 * x), 1.0 if x < 0 else 1 / (1 + 0.15 * x) ** 2
        return np.array([[df, 0, 0], [-2 * x / s - 0.1 * (y - x**2) / s, 1 / s, 0], [0, 0, 1.0]])


def laplace(loss, mode):
    return np.linalg.cholesky(np.linalg.inv(loss.slopes(mode).T @ loss.slopes(mode)))


def test_of_a_gaussian_there_is_nothing_to_say():
    loss, mode = Line(), np.array([0.3, -0.2, 0.1])
    assert nested_laplace(loss, mode, laplace(loss, mode), [0, 1, 2]) == []
    assert nested_laplace(loss, mode, laplace(loss, mode), []) == []


def test_moments_are_those_of_quadrature():
    loss, mode = Bent(), np.zeros(3)
    found = nested_laplace(loss, mode, laplace(loss, mode), [2, 0])
    assert sum(one.share for one in found) == pytest.approx(1.0)

    def density(x):
        return np.exp(0.1 * x - loss.f(x) ** 2 / 2)

    whole, *moments = (quad(lambda x, k=k: x**k * density(x), -8, 12)[0] for k in (0, 1, 2))
    mean = moments[0] / whole
    sd = np.sqrt(moments[1] / whole - mean**2)
    places, shares = np.array([one.mode[0] for one in found]), np.array([one.share for one in found])
    # Steps of Laplace's standard deviation, which is 1 here.
    np.testing.assert_allclose(np.diff(places), 1.0, atol=1e-9)
    own = np.array([(one.root @ one.root.T)[0, 0] for one in found])
    np.testing.assert_allclose(own, WIDTH**2, atol=1e-9)
    assert shares @ places == pytest.approx(mean, abs=0.05 * sd)
    assert np.sqrt(shares @ (places - shares @ places) ** 2) == pytest.approx(sd, rel=0.03)
    assert sd > 1.3  # where Laplace's is 1
    for one in found:
        x = one.mode[0]
        np.testing.assert_allclose(one.mode[1:], [x**2, 0.0], atol=2e-3 * (1 + x**2))
        # Along the curve, and across it as wide as given x.
        across = one.root[:, :-1] @ one.root[:, :-1].T
        np.testing.assert_allclose(across[1:, 1:], np.diag([np.exp(0.2 * x), 1.0]), rtol=1e-6, atol=1e-9)
        if abs(x) < 3:
            np.testing.assert_allclose(one.root[1, -1], WIDTH * 2 * x, atol=0.1)


class Trace:
    """What a twin reads of an episode."""

    def __init__(self, current, voltage):
        self.input, self._voltage = current[:, None], voltage

    def __len__(self):
        return len(self.input)

    def signal(self, name):
        return self._voltage, self._voltage


QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)


def quantiles(grid, density):
    known_to = np.cumsum(density) / np.sum(density)
    return np.interp(QUANTILES, known_to, grid)


def measured(equation, parameters, unknowns, level, noise):
    """The posterior after eight intervals at one current, and the measured voltages, each at both ends of its interval."""
    model = Model.build(
        "series", states=[Signal("charge")], inputs=[Signal("current")], outputs=[Signal("voltage")], parameters=parameters,
        sampling_time_s=1.0, equations=lambda x, u, p: ({"charge": x["charge"] + u["current"]}, {"voltage": equation(p, u["current"])}),
    )  # fmt: skip
    voltage = level + noise * np.random.default_rng(0).standard_normal(8)
    return fit(Twin(model, unknowns, {"voltage": noise}), [Trace(np.ones(8), voltage)], discrepancy=False), voltage


@pytest.mark.usefixtures("virtual_machine")
def test_draws_where_a_large_value_is_told_badly():
    """A voltage as the inverse hyperbolic sine of the current: the larger the value, the less is known of it."""
    noise, sd = 1.6, 6.0
    posterior, voltage = measured(lambda p, u: ca.asinh(p["gain"] * u), {"gain": 0.0}, (Uncertain("gain", sd, "offset"),), 1.7, noise)
    grid = np.linspace(-15.0, 30.0, 9001)
    loss = 2 * sum((v - np.arcsinh(grid)) ** 2 for v in voltage) / noise**2 + grid**2 / sd**2
    true = quantiles(grid, np.exp(-loss / 2))
    own, short = (np.quantile(p.draw(2000, 1)[:, 0], QUANTILES) for p in (posterior, replace(posterior, components=())))
    spread = true[-1] - true[0]
    assert posterior.components
    # Each section is half of Laplace's standard deviation wide, which the tails show.
    assert np.max(np.abs(own - true)) < 0.09 * spread
    assert np.max(np.abs(own - true)[1:4]) < 0.04 * spread
    assert np.max(np.abs(short - true)[1:4]) > 0.08 * spread


@pytest.mark.usefixtures("virtual_machine")
def test_draws_of_two_resistances_in_series_need_no_sections():
    """Their sum is measured, each is known to a factor e: the density ends where one of them is the sum, sharper than sections are wide."""
    both = (Uncertain("R1", 1.0), Uncertain("R2", 1.0))
    posterior, voltage = measured(lambda p, u: (p["R1"] + p["R2"]) * u, {"R1": 1.0, "R2": 1.0}, both, 3.0, 0.2)
    grid = np.linspace(-5.0, 4.0, 1201)
    one, other = np.meshgrid(grid, grid, indexing="ij")
    loss = 2 * sum((v - np.exp(one) - np.exp(other)) ** 2 for v in voltage) / 0.2**2 + one**2 + other**2
    true = quantiles(grid, trapezoid(np.exp(-loss / 2), grid, axis=1))
    assert posterior.components == ()
    # Laplace's Gaussian has the middle; its interval is no narrower than the true one.
    own = np.quantile(posterior.draw(2000, 1)[:, 0], QUANTILES)
    assert own[2] == pytest.approx(true[2], abs=0.05 * (true[-1] - true[0]))
    assert own[-1] - own[0] > 0.95 * (true[-1] - true[0])


def test_draws_are_reproducible_and_as_many_as_the_shares_say():
    loss, mode = Bent(), np.zeros(3)
    shares = [one.share for one in nested_laplace(loss, mode, laplace(loss, mode), [0])]
    # Each component is a point, which says of a draw which one it is of.
    parts = tuple(
        (share, Posterior(None, np.full(3, float(k)), np.zeros((3, 3)), np.zeros(1), np.ones(1))) for k, share in enumerate(shares)
    )
    posterior = Posterior(None, mode, np.eye(3), np.zeros(1), np.ones(1), parts)
    drawn = [posterior.draw(200, seed)[:, 0].astype(int).tolist() for seed in (1, 1, 2)]
    assert drawn[0] == drawn[1] != drawn[2]
    np.testing.assert_allclose(np.bincount(drawn[0], minlength=len(shares)), 200 * np.array(shares), atol=1.0)


class Single:
    """One unknown, and a loss that is steeper to one side."""

    def values(self, e):
        return np.array([e[0] / (1 + 0.2 * e[0]) if e[0] > 0 else e[0]])

    def slopes(self, e):
        return np.array([[1 / (1 + 0.2 * e[0]) ** 2 if e[0] > 0 else 1.0]])


def test_of_a_single_unknown_there_are_no_others_to_find():
    loss = Single()
    found = nested_laplace(loss, np.zeros(1), np.eye(1), [0])
    at, shares = np.array([one.mode[0] for one in found]), np.array([one.share for one in found])
    density = np.array([np.exp(-0.5 * loss.values([x])[0] ** 2) for x in at])
    np.testing.assert_allclose(shares, density / density.sum())
    assert {one.root.shape for one in found} == {(1, 1)}
