"""The range of use as the prior of a twin, against the range's own draws and closed forms."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm

import chargetune as ct
from chargetune.episode.compiled import simulate
from chargetune.learning.range_of_use.range_prior import RangePrior, range_twin
from chargetune.learning.twin.laplace import fit

pytestmark = pytest.mark.usefixtures("virtual_machine")

STEPS, NOISE = 30, 1e-3
MODEL = ct.Model.build(
    "oven", states=(ct.Signal("T", "K"),), inputs=(ct.Signal("u"),), outputs=(ct.Signal("T", "K"),),
    parameters={"gain": 1.0, "rate": (0.2, 0.2), "around": 2.0}, sampling_time_s=1.0,
    equations=lambda x, u, p: (
        {"T": x["T"] + p["rate"][0] * (p["around"] - x["T"]) + p["rate"][1] * p["gain"] * u["u"]}, {"T": x["T"]}
    ),
)  # fmt: skip
VARIATIONS = (
    ct.Variation("make", ct.Uniform(-0.3, 0.3), parameters={"gain": 1.0, "rate": -0.5}),
    ct.Variation("weather", ct.Uniform(-1.0, 1.0), parameters={"around": 0.5}, starts={"T": 1.0}, of="episode"),
    ct.Variation("node", ct.LogNormal(0.1, 0.5), parameters={"rate": 1.0}, by_entry=True),
    ct.Variation("sensor", ct.Normal(0.0, 0.1), biases={"T": 1.0}),
    ct.Variation("kind", ct.Choice((-0.1, 0.1)), parameters={"gain": 1.0}),
)
# What has correlated entries, in the exponent.
MIXED = (
    ct.Variation("make", ct.StudentT(5.0), parameters={"rate": (0.1, 0.2), "gain": 0.3}, by_entry=True, log=True,
                 correlation=((1.0, 0.9, 0.0), (0.9, 1.0, 0.3), (0.0, 0.3, 1.0))),
    ct.Variation("node", ct.Uniform(-0.1, 0.2), parameters={"rate": 1.0}, by_entry=True, correlation=0.7),
    ct.Variation("weather", ct.Uniform(-1.0, 1.0), parameters={"around": 0.5}, starts={"T": 1.0}, of="episode"),
)  # fmt: skip
SPACE = ct.ParameterSpace((ct.Parameter("power", 0.05, 2.0, default=1.0),))
BLIND = ct.Controller.build(
    MODEL, SPACE, horizon=1, stage_cost=lambda s: (s.u["u"] - s.theta["power"]) ** 2, input_lower={"u": 0.0}, input_upper={"u": 2.0}
)


def oven(*variations):
    return ct.RangeOfUse(ct.SimulatedPlant(MODEL, {"T": 2.0}, ct.Sensors(noise_sd={"T": NOISE})), variations or VARIATIONS)


def twin_of(use, read=("T",)):
    return range_twin(use, read, {"T": NOISE}, {"T": 1e-2}, 1.0)


def test_unknowns_of_scores_are_those_of_the_draws():
    use = oven()
    prior = RangePrior(use)
    draws = use.draw(16, 3, scores=np.random.default_rng(0).standard_normal((16, prior.size)))
    same = use.draw(16, 3, scores=np.random.default_rng(0).standard_normal((16, prior.size)))
    assert [one.values for one in draws] == [one.values for one in same]
    scores = np.random.default_rng(0).standard_normal((16, prior.size))
    assert [(u.name, u.kind) for u in prior.unknowns] == [("gain", "factor"), ("rate", "factor"), ("T", "bias")]
    for one, m in zip(draws, prior.at(scores), strict=True):
        blocks = dict(one.plant.model.parameters)
        np.testing.assert_allclose(np.exp(m[0]), blocks["gain"], rtol=1e-12)
        np.testing.assert_allclose(0.2 * np.exp(m[1:3]), blocks["rate"], rtol=1e-12)
        assert one.plant.sensors.bias["T"] == pytest.approx(m[3], abs=1e-12)


def test_what_is_of_the_episode_is_drawn_whatever_is_given_of_the_plant():
    use = oven()
    given, free = (use.draw(8, 3, scores=np.zeros(use.of_plant.sum())), use.draw(8, 3))
    assert [one.values["weather"] for one in given] == [one.values["weather"] for one in free]
    assert {one.values["make"] for one in given} == {(0.0,)}
    with pytest.raises(ValueError, match=r"scores have the shape \(2, 5\), allowed is \(8, 5\), or one row"):
        use.draw(8, 3, scores=np.zeros((2, 5)))


def test_slopes_are_those_of_finite_differences():
    prior = RangePrior(oven())
    e, step = np.array([0.3, -0.8, 1.2, 0.4, 0.9]), 1e-5
    expected = np.array([(prior.at(e + d) - prior.at(e - d)) / (2 * step) for d in step * np.eye(5)]).T
    np.testing.assert_allclose(prior.slopes(e), expected, rtol=1e-4, atol=1e-8)


def test_correlated_entries_follow_from_the_same_scores_as_the_draws():
    use = oven(*MIXED)
    prior = RangePrior(use)
    scores = np.random.default_rng(1).standard_normal((8, prior.size))
    for one, m in zip(use.draw(8, 3, scores=scores), prior.at(scores), strict=True):
        blocks = dict(one.plant.model.parameters)
        np.testing.assert_allclose(0.2 * np.exp(m[:2]), blocks["rate"], rtol=1e-9)
        np.testing.assert_allclose(np.exp(m[2]), blocks["gain"], rtol=1e-9)
    e, step = scores[0], 1e-5
    expected = np.array([(prior.at(e + d) - prior.at(e - d)) / (2 * step) for d in step * np.eye(prior.size)]).T
    np.testing.assert_allclose(prior.slopes(e), expected, rtol=1e-4, atol=1e-8)


def test_scores_that_are_one_number():
    assert RangePrior(oven()).scalars == [0, 3, 4]


def test_a_trace_says_in_which_condition_it_was():
    use = oven()
    (drawn,) = use.draw(1, 5)
    episode = simulate(BLIND, drawn.plant, steps=STEPS)
    twin = twin_of(use).under(episode)
    (weather,) = drawn.values["weather"]
    bias = drawn.values["sensor"][0]
    assert twin.start["T"] == pytest.approx(2.0 + weather + bias, abs=5 * NOISE)
    assert dict(twin.model.parameters)["around"][0] == pytest.approx(2.0 * (1 + 0.5 * (weather + bias)), abs=5 * NOISE)
    # Of a controller that does not read the state its estimate counts.
    told = replace(episode, estimate=np.full_like(episode.estimate, 2.5))
    assert twin_of(use, read=()).under(told).start["T"] == 2.5


def test_a_condition_that_a_trace_does_not_show_is_in_the_middle_of_its_range():
    hidden = ct.Variation("load", ct.Uniform(0.0, 0.4), parameters={"gain": 1.0}, of="episode")
    use = oven(VARIATIONS[0], hidden)
    episode = simulate(BLIND, use.draw(1, 5)[0].plant, steps=STEPS)
    assert dict(twin_of(use).under(episode).model.parameters)["gain"][0] == pytest.approx(1.2)


def test_the_posterior_is_that_of_the_uniform_prior():
    """The gain alone is unknown: p(v | y) ~ exp(-sum r(v)^2 / 2 noise^2) on [-0.3, 0.3], by quadrature."""
    use = oven(VARIATIONS[0])
    truth = use.draw(1, 2, scores=np.array([0.5]))[0]
    episode = simulate(BLIND, truth.plant, steps=STEPS, seed=4)
    twin = range_twin(use, (), {"T": 0.2}, {}, 1.0)
    posterior = fit(twin, [episode], discrepancy=False)
    draws = norm.cdf(posterior.draw_scores(4000, 1)[:, 0]) * 0.6 - 0.3
    grid = np.linspace(-0.3, 0.3, 401)
    plants = [use.draw(1, 2, scores=norm.ppf(np.clip((np.array([v]) + 0.3) / 0.6, 1e-9, 1 - 1e-9)))[0].plant for v in grid]
    runs = [simulate(BLIND, replace(plant, sensors=ct.Sensors()), steps=STEPS) for plant in plants]
    left = np.array([sum(np.sum((a - b) ** 2) for a, b in zip(r.signal("T"), episode.signal("T"), strict=True)) for r in runs])
    density = np.exp(-0.5 * (left - left.min()) / 0.2**2)
    mean = np.sum(grid * density) / density.sum()
    sd = np.sqrt(np.sum((grid - mean) ** 2 * density) / density.sum())
    assert np.all(np.abs(draws) < 0.3)
    assert draws.mean() == pytest.approx(mean, abs=0.15 * sd)
    assert draws.std() == pytest.approx(sd, rel=0.15)


def test_what_nothing_is_seen_of_stays_as_it_was():
    use = oven(VARIATIONS[0], VARIATIONS[4])
    episode = simulate(BLIND, use.draw(1, 5)[0].plant, steps=STEPS)
    scores = fit(twin_of(use), [episode]).draw_scores(400, 1)
    assert scores[:, 1].std() == pytest.approx(1.0, abs=0.1)


def test_a_range_without_anything_of_the_plant_has_nothing_to_learn():
    with pytest.raises(ValueError, match="nothing differs from plant to plant"):
        twin_of(oven(VARIATIONS[1]))
