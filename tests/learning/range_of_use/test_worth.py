"""What entries of theta are worth, on plants whose best theta is known in closed form."""

import numpy as np
import pytest

import chargetune as ct
from chargetune.learning.range_of_use.worth import _beside, entry_worths, without_idle

pytestmark = pytest.mark.usefixtures("virtual_machine")


def heater():
    """T+ = 0.8 T + 0.2 gain u: at rest T = gain u, and from 0 it never overshoots."""
    return ct.Model.build(
        "heater", states=(ct.Signal("T", "K"),), inputs=(ct.Signal("u"),), outputs=(ct.Signal("T", "K"),),
        parameters={"gain": 1.0}, sampling_time_s=1.0,
        equations=lambda x, u, p: ({"T": 0.8 * x["T"] + 0.2 * p["gain"] * u["u"]}, {"T": x["T"]}),
    )  # fmt: skip


# The power below and above T = 0.5, a factor of it that changes nothing, and a table of two of which the mean counts.
SPACE = ct.ParameterSpace(
    (
        ct.Parameter("power", 0.05, 2.0, default=1.5),
        ct.Parameter("nothing", -1.0, 1.0, default=0.0),
        ct.Parameter("more", -0.2, 0.2, default=0.0, size=2),
    )
)
CONTROLLER = ct.Controller.build(
    heater(), SPACE, horizon=1,
    stage_cost=lambda s: (s.u["u"] - s.theta["power"] - (s.theta["more"][0] + s.theta["more"][1]) / 2 - 0.0 * s.theta["nothing"]) ** 2,
    input_lower={"u": 0.0}, input_upper={"u": 2.0},
)  # fmt: skip
RANGE = ct.RangeOfUse(ct.SimulatedPlant(heater(), {}), (ct.Variation("gain", ct.Uniform(-0.25, 0.25), parameters={"gain": 1.0}),))


@pytest.fixture(scope="module")
def evaluation():
    limits = (ct.ScoredLimit("T", upper=1.0, tolerance=1e-3),)
    return ct.RangeEvaluation(ct.SimulatedRange(CONTROLLER, RANGE, 30, limits, lambda e: float(np.mean(e.signal("T")[1]))), 64)


def test_worth_in_closed_form(evaluation):
    """At u = power + the mean of more; mean T is u times a constant, so the share of u that an entry gives is what it is worth."""
    plants, theta = evaluation.loop.draw(64, 0), np.array([0.7, 0.4, 0.1, 0.1])
    power, nothing, first, second = entry_worths(evaluation, SPACE, theta, plants)
    assert (power.put_to, power.value) == ("untuned", 1.5)
    # T at rest is gain u.
    wanted = sum(1.6 * (1 + one.values["gain"][0]) * (1 - 0.8**30) > 1.001 for one in plants)
    assert power.more_violating == wanted > 50
    assert power.lost < 0
    assert not power.idle
    assert (nothing.idle, nothing.lost, nothing.more_violating) == (True, 0.0, 0)
    base = evaluation.loop.simulate([theta], plants[:1])[0]
    assert base is not None
    share = 0.05 / 0.8
    objective = np.mean([np.mean(e.signal("T")[1]) for e in evaluation.loop.simulate([theta] * 64, plants)])
    for one in (first, second):
        assert one.put_to == "untuned"
        assert one.lost == pytest.approx(share * objective, rel=1e-6)
        assert not one.idle


def test_only_what_is_worth_nothing_is_put_back(evaluation):
    plants, theta = evaluation.loop.draw(64, 0), np.array([0.7, 0.4, 0.1, 0.1])
    np.testing.assert_allclose(without_idle(evaluation, SPACE, theta, plants), [0.7, 0.0, 0.1, 0.1])


def test_an_entry_like_its_neighbours_is_tied_to_them(evaluation):
    """0.1000 and 0.1001: put to the other one nothing is lost."""
    plants, theta = evaluation.loop.draw(16, 0), np.array([0.7, 0.0, 0.1, 0.1001])
    first, second = entry_worths(evaluation, SPACE, theta, plants)[-2:]
    assert {first.put_to, second.put_to} == {"neighbours"}
    assert first.idle
    assert second.idle


def test_the_tuner_drops_on_request(evaluation):
    settings = ct.RangeSettings(plants=8, pool=4, first=4, iterations=4, drop_idle=True)
    found = ct.RangeTuner(evaluation, seed=0, settings=settings).ask(SPACE, [])[0]
    assert found[1] == 0.0
    kept = ct.RangeTuner(evaluation, seed=0, settings=ct.RangeSettings(plants=8, pool=4, first=4, iterations=4)).ask(SPACE, [])[0]
    assert found[0] + np.mean(found[2:]) == pytest.approx(kept[0] + np.mean(kept[2:]), rel=2e-3)


def test_neighbours_are_those_of_the_table():
    space = ct.ParameterSpace((ct.Parameter("one", 0.0, 1.0, 0.5), ct.Parameter("table", 0.0, 1.0, 0.5, size=6, shape=(2, 3))))
    assert [sorted(_beside(space, i)) for i in range(7)] == [[], [2, 4], [1, 3, 5], [2, 6], [1, 5], [2, 4, 6], [3, 5]]
    with pytest.raises(ValueError, match=r"shape = \(2, 2\), allowed is one of size = 6"):
        ct.Parameter("table", 0.0, 1.0, 0.5, size=6, shape=(2, 2))
