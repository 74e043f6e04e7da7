"""Draws of a range of use, against closed forms."""

import numpy as np
import pytest
from scipy.special import ndtri
from scipy.stats import kstest, norm, t

from chargetune.model.model import Model, Signal
from chargetune.plants.range_of_use import OwnDraws, RangeOfUse
from chargetune.plants.sensors import Sensors
from chargetune.plants.simulated import SimulatedPlant
from chargetune.plants.variation import Choice, LogNormal, Normal, StudentT, Uniform, Variation

MODEL = Model.build(
    "two tanks", states=(Signal("a"), Signal("b")), inputs=(Signal("u"),), outputs=(Signal("a"),),
    parameters={"r": (1.0, 2.0, 3.0), "c": 4.0}, sampling_time_s=1.0,
    equations=lambda x, u, p: ({"a": x["a"] + u["u"] / p["c"], "b": x["b"] + p["r"][0]}, {"a": x["a"]}),
)  # fmt: skip
PLANT = SimulatedPlant(MODEL, {"a": 0.5}, Sensors(noise_sd={"a": 0.1}, bias={"a": 0.25}))


def drawn(*variations, count=256, seed=3, **more):
    return RangeOfUse(PLANT, variations, **more).draw(count, seed)


@pytest.mark.parametrize(
    ("distribution", "cdf"),
    [
        (Uniform(-2.0, 3.0), lambda v: (v + 2) / 5),
        (Normal(1.0, 0.5), norm(1.0, 0.5).cdf),
        (LogNormal(2.0, 0.3), lambda v: norm.cdf(np.log(v / 2.0) / 0.3)),
        (StudentT(4.0), t(4.0).cdf),
    ],
)
def test_draws_have_the_stated_distribution(distribution, cdf):
    values = [one.values["v"][0] for one in drawn(Variation("v", distribution, parameters={"c": 1.0}))]
    # A Sobol sequence is far closer to it than random numbers of the same count, whose statistic is about 0.05.
    assert kstest(values, cdf).statistic < 0.02


def nodes(**more):
    return drawn(Variation("v", **({"distribution": Uniform(-0.1, 0.1), "parameters": {"r": 1.0}, "by_entry": True} | more)))


def test_each_choice_is_as_likely():
    values = [one.values["v"][0] for one in drawn(Variation("v", Choice((1.0, 5.0)), starts={"b": 1.0}))]
    assert sorted(set(values)) == [1.0, 5.0]
    assert values.count(1.0) == 128


def test_one_number_changes_what_it_says_by_its_sensitivities():
    age = Variation("age", Uniform(0.0, 1.0), parameters={"r": 0.5, "c": -0.2})
    for one in drawn(age, count=5):
        (a,) = one.values["age"]
        blocks = dict(one.plant.model.parameters)
        np.testing.assert_allclose(blocks["r"], np.array([1.0, 2.0, 3.0]) * (1 + 0.5 * a))
        np.testing.assert_allclose(blocks["c"], 4.0 * (1 - 0.2 * a))
        assert one.plant.start_state.tolist() == [0.5, 0.0]


def test_without_variations_the_noise_alone_differs():
    first, second = drawn(count=2)
    assert first.values == second.values == {}
    assert first.seed != second.seed
    assert first.plant.start_state.tolist() == [0.5, 0.0]


def test_variations_multiply_and_entries_have_their_own():
    both = (
        Variation("make", Uniform(-0.2, 0.2), parameters={"r": 1.0}),
        Variation("node", Uniform(-0.1, 0.1), parameters={"r": 1.0, "c": 2.0}, by_entry=True),
    )
    for one in drawn(*both, count=4):
        make, nodes = one.values["make"][0], np.array(one.values["node"])
        assert nodes.shape == (4,)
        assert len(set(nodes)) == 4
        blocks = dict(one.plant.model.parameters)
        np.testing.assert_allclose(blocks["r"], np.array([1.0, 2.0, 3.0]) * (1 + make) * (1 + nodes[:3]))
        np.testing.assert_allclose(blocks["c"], 4.0 * (1 + 2.0 * nodes[3]))


def test_starts_and_biases_are_added_and_kept_within_bounds():
    shifts = (
        Variation("filled", Uniform(-1.0, 1.0), starts={"a": 1.0, "b": -2.0}, of="episode"),
        Variation("sensor", Normal(0.0, 0.01), biases={"a": 1.0}, of="episode"),
    )
    plants = drawn(*shifts, start_bounds={"a": (0.0, 1.0)})
    for one in plants:
        (v,), (bias,) = one.values["filled"], one.values["sensor"]
        np.testing.assert_allclose(one.plant.start_state, [np.clip(0.5 + v, 0.0, 1.0), -2.0 * v])
        assert one.plant.sensors.bias["a"] == pytest.approx(0.25 + bias)
        assert one.plant.sensors.noise_sd == {"a": 0.1}
    assert min(one.plant.start_state[0] for one in plants) == 0.0


def test_more_draws_begin_with_the_same_ones_and_other_seeds_are_others():
    one = Variation("v", Uniform(0.0, 1.0), parameters={"c": 1.0})
    few, many, other = drawn(one, count=5), drawn(one, count=100), drawn(one, count=5, seed=4)
    assert [d.values for d in few] == [d.values for d in many[:5]]
    assert [d.seed for d in few] == [d.seed for d in many[:5]]
    assert len({d.seed for d in many}) == 100
    assert not {d.values["v"] for d in few} & {d.values["v"] for d in other}


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Variation("v", Uniform(0, 1)), "variation v: changes nothing, allowed is at least one of parameters, starts and biases"),
        (lambda: Uniform(1.0, 0.0), "lower = 1.0, allowed is at most upper = 0.0"),
        (lambda: Normal(0.0, float("nan")), "sd = nan, allowed is a finite number"),
        (lambda: LogNormal(0.0, 0.1), "median = 0.0"),
        (lambda: StudentT(0.0), "degrees = 0.0, allowed is more than 0"),
        (lambda: nodes(parameters={"r": (0.1, 0.2)}), "has 2 sensitivities of r, allowed is one, or one for each of its 3 entries"),
        (lambda: nodes(parameters={"r": (0.1, 0.2, float("nan"))}), r"r\[2\] = nan, allowed is a finite number"),
        (lambda: nodes(correlation=1.0), r"correlation = 1.0, allowed is \[0, 1\), or a matrix"),
        (lambda: nodes(correlation=True), r"correlation = True"),
        (lambda: nodes(by_entry=False, correlation=0.5), "correlation is given, allowed is that only with by_entry = True"),
        (lambda: nodes(correlation=((1.0, 0.5), (0.5, 1.0))), "correlation has 2 rows, allowed is one for each of 3 numbers"),
        (lambda: nodes(correlation=((1.0, 0.5), (0.4, 1.0))), "allowed is a symmetric matrix with ones on its diagonal"),
        (lambda: nodes(correlation=((1.0, 2.0), (2.0, 1.0))), "has an eigenvalue -1, allowed are none below 0"),
        (lambda: OwnDraws(PLANT, lambda _: PLANT).draw(0, 1), "count = 0, allowed is an integer >= 1"),
        (lambda: OwnDraws(PLANT, lambda _: PLANT).draw(1, 1, scores=np.zeros(1)), "allowed are none for draws of your own"),
        (lambda: Choice(()), "allowed is at least one"),
        (lambda: Variation("v", Uniform(0, 1), starts={"a": 1.0}, by_entry=True), "by_entry = True"),
        (lambda: Variation("v", Uniform(0, 1), starts={"a": 1.0}, of="day"), "of = 'day', allowed is 'plant' or 'episode'"),
        (lambda: drawn(Variation("v", Uniform(0, 1), parameters={"q": 1.0})), r"parameters names unknown \['q'\], allowed are r, c"),
        (lambda: drawn(Variation("v", Uniform(0, 1), starts={"q": 1.0})), r"starts names unknown \['q'\], allowed are a, b"),
        (lambda: drawn(Variation("v", Uniform(0, 1), biases={"b": 1.0})), r"biases names unknown \['b'\], allowed are a"),
        (lambda: drawn(*[Variation("v", Uniform(0, 1), starts={"a": 1.0})] * 2), "allowed are different names"),
        (lambda: drawn(Variation("v", Uniform(0, 1), starts={"a": 1.0}), count=0), "count = 0, allowed is an integer >= 1"),
        (lambda: drawn(start_bounds={"q": (0, 1)}), r"start_bounds names unknown \['q'\]"),
    ],
)
def test_nonsense_is_refused_by_name(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_corners_are_all_combinations_of_the_extremes():
    """Of three numbers there are eight; those by entry are drawn as before, and what is given stays so."""
    use = RangeOfUse(
        PLANT,
        (
            Variation("a", Uniform(0.0, 1.0), starts={"a": 1.0}, of="episode"),
            Variation("r", Uniform(-0.1, 0.1), parameters={"r": 1.0}, by_entry=True),
            Variation("c", Normal(0.0, 0.1), parameters={"c": 1.0}),
            Variation("bias", Uniform(-1.0, 1.0), biases={"a": 1.0}, of="episode"),
        ),
    )
    corners, plain = use.draw(16, 4, extreme=0.01), use.draw(16, 4)
    own = [(one.values["a"][0], one.values["c"][0], one.values["bias"][0]) for one in corners]
    low, high = 0.1 * norm.ppf([0.01, 0.99])
    expected = {(a, c, bias) for a in (0.01, 0.99) for c in (low, high) for bias in (-0.98, 0.98)}
    assert {tuple(np.round(one, 9)) for one in own[:8]} == {tuple(np.round(one, 9)) for one in expected}
    assert own[:8] == own[8:]
    assert [one.values["r"] for one in corners] == [one.values["r"] for one in plain]
    assert [one.seed for one in corners] == [one.seed for one in plain]
    scores = np.array([0.1, 0.2, 0.3, 0.4])
    known = use.draw(4, 4, scores=scores, extreme=0.01)
    assert {one.values["c"] for one in known} == {use.draw(1, 9, scores=scores)[0].values["c"]}
    assert len({(one.values["a"], one.values["bias"]) for one in known}) == 4
    # With many numbers there are too many: some of them.
    many = RangeOfUse(PLANT, tuple(Variation(f"v{k}", Uniform(-1.0, 1.0), starts={"b": 1.0}) for k in range(9)))
    values = {tuple(one.values[f"v{k}"][0] for k in range(9)) for one in many.draw(32, 0, extreme=0.25)}
    assert len(values) > 25
    assert {v for row in values for v in row} == {-0.5, 0.5}
    with pytest.raises(ValueError, match=r"extreme = 0.5, allowed is \(0, 0.5\)"):
        use.draw(1, 0, extreme=0.5)


def test_sensitivities_by_entry_and_in_the_exponent():
    both = (
        Variation("age", Uniform(0.0, 1.0), parameters={"r": (0.5, 0.0, -0.25), "c": -0.2}),
        Variation("make", Normal(0.0, 0.3), parameters={"r": (1.0, 2.0, 0.0)}, log=True),
    )
    for one in drawn(*both, count=5):
        (a,), (v,) = one.values["age"], one.values["make"]
        blocks = dict(one.plant.model.parameters)
        expected = np.array([1.0, 2.0, 3.0]) * (1 + a * np.array([0.5, 0.0, -0.25])) * np.exp(v * np.array([1.0, 2.0, 0.0]))
        np.testing.assert_allclose(blocks["r"], expected)
        np.testing.assert_allclose(blocks["c"], 4.0 * (1 - 0.2 * a))


def test_neighbouring_entries_are_correlated_and_each_is_distributed_as_stated():
    both = (
        Variation("first", Uniform(0.0, 1.0), starts={"a": 1.0}),
        Variation("v", Uniform(-0.1, 0.1), parameters={"r": 1.0, "c": 1.0}, by_entry=True, correlation=0.8),
    )
    draws = drawn(*both, count=4096)
    values = np.array([one.values["v"] for one in draws])
    for column in values.T:
        assert kstest(column, lambda v: (v + 0.1) / 0.2).statistic < 0.02
    # A correlation of normal scores; c has no neighbour among r.
    found = np.corrcoef(ndtri((values + 0.1) / 0.2), rowvar=False)
    expected = [[1, 0.8, 0.64, 0], [0.8, 1, 0.8, 0], [0.64, 0.8, 1, 0], [0, 0, 0, 1]]
    np.testing.assert_allclose(found, expected, atol=0.03)
    # What is not correlated is drawn as without it.
    plain = drawn(both[0], Variation("v", Uniform(-0.1, 0.1), parameters={"r": 1.0, "c": 1.0}, by_entry=True), count=4096)
    assert [one.values["first"] for one in draws] == [one.values["first"] for one in plain]


def test_given_scores_are_those_before_the_correlation():
    """Of a singular one too: two entries are the same, the third is their opposite."""
    matrix = ((1.0, 1.0, -1.0), (1.0, 1.0, -1.0), (-1.0, -1.0, 1.0))
    same = Variation("v", Normal(0.0, 0.1), parameters={"r": 1.0}, by_entry=True, correlation=matrix)
    use = RangeOfUse(PLANT, (same,))
    e = np.array([0.3, -1.0, 0.5])
    (one,) = use.draw(1, 2, scores=e)
    # The symmetric root of a matrix w w' with |w|^2 = 3 is w w' / sqrt(3).
    w = np.array([1.0, 1.0, -1.0])
    np.testing.assert_allclose(one.values["v"], 0.1 * w * (w @ e) / np.sqrt(3), rtol=1e-6)
    values = np.array([one.values["v"] for one in use.draw(64, 2)])
    np.testing.assert_allclose(values, values[:, :1] * w, atol=1e-9)
    np.testing.assert_allclose(use.nominal_scores, 0.0, atol=1e-9)


def test_what_changes_nothing_has_the_score_of_it_also_where_entries_are_correlated():
    use = RangeOfUse(PLANT, (Variation("v", Uniform(-0.1, 0.3), parameters={"r": 1.0}, by_entry=True, correlation=0.6),))
    (one,) = use.draw(1, 2, scores=use.nominal_scores)
    np.testing.assert_allclose(one.values["v"], 0.0, atol=1e-9)


def test_draws_of_your_own():
    """Rows of a table, each as likely; more draws begin with the same ones."""
    table = [SimulatedPlant(MODEL.with_parameters(c=c), {"a": c}, PLANT.sensors) for c in (1.0, 2.0, 3.0)]
    use = OwnDraws(PLANT, lambda rng: table[rng.integers(3)])
    few, many, other = use.draw(5, 3), use.draw(300, 3), use.draw(300, 4)
    starts = [one.plant.start["a"] for one in many]
    assert [one.plant.start["a"] for one in few] == starts[:5]
    assert [one.seed for one in few] == [one.seed for one in many[:5]]
    assert len({one.seed for one in many}) == 300
    assert all(70 < starts.count(c) < 130 for c in (1.0, 2.0, 3.0))
    assert starts != [one.plant.start["a"] for one in other]
    assert [one.plant.start["a"] for one in use.draw(5, 3, 7)] == starts[7:12]
    assert {one.seed for one in many} == {one.seed for one in RangeOfUse(PLANT, ()).draw(300, 3)}
