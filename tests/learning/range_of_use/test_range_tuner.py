"""One theta for a range of plants whose best one is known in closed form."""

from dataclasses import replace
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest

import chargetune as ct
from chargetune.learning.range_of_use.range_verdict import run_plants

pytestmark = pytest.mark.usefixtures("virtual_machine")

STEPS, LIMIT, TOLERANCE = 30, 1.0, 1e-3


def heater(gain):
    """T+ = 0.8 T + 0.2 gain u: at rest T = gain u, and from 0 it never overshoots."""
    return ct.Model.build(
        "heater", states=(ct.Signal("T", "K"),), inputs=(ct.Signal("u"),), outputs=(ct.Signal("T", "K"),),
        parameters={"gain": gain}, sampling_time_s=1.0,
        equations=lambda x, u, p: ({"T": 0.8 * x["T"] + 0.2 * p["gain"] * u["u"]}, {"T": x["T"]}),
    )  # fmt: skip


SPACE = ct.ParameterSpace((ct.Parameter("power", 0.05, 2.0, default=1.5),))
# Blind: it heats with theta whatever is measured, so the plant with the largest gain decides.
BLIND = ct.Controller.build(
    heater(1.0), SPACE, horizon=1, stage_cost=lambda s: (s.u["u"] - s.theta["power"]) ** 2,
    input_lower={"u": 0.0}, input_upper={"u": 2.0},
)  # fmt: skip
RANGE = ct.RangeOfUse(ct.SimulatedPlant(heater(1.0), {}), (ct.Variation("gain", ct.Uniform(-0.25, 0.25), parameters={"gain": 1.0}),))


def heat(episode):
    return float(np.mean(episode.signal("T")[1]))


def loop(tolerance=TOLERANCE, **changes):
    limits = (ct.ScoredLimit("T", upper=LIMIT, tolerance=tolerance),)
    return ct.SimulatedRange(changes.get("controller", BLIND), changes.get("range_of_use", RANGE), STEPS, limits, heat)


def told(evaluation, tuner, count):
    trials = []
    for k in range(count):
        theta = tuner.ask(SPACE, trials)[0]
        score, _, _ = evaluation(theta, 100 + k)
        trials.append(SimpleNamespace(number=k, theta=theta, status="done", score=score, seed=100 + k))
    return trials


def test_the_found_theta_is_the_largest_that_the_worst_plant_allows():
    """In closed form: the largest gain is 1.25, T never exceeds gain power, so the best power is LIMIT / 1.25."""
    evaluation = ct.RangeEvaluation(loop(), 200)
    trials = told(evaluation, ct.RangeTuner(evaluation, seed=0), 3)
    best = LIMIT / (1.25 * (1 - 0.8**STEPS))
    assert trials[0].theta[0] == pytest.approx(best, rel=0.01)
    # With a margin for what was not drawn.
    assert 0.98 * best < trials[-1].theta[0] < 1.001 * best
    assert trials[-1].score.metrics["violating_plants"] == 0
    assert trials[-1].score.objective == pytest.approx(0.97 * trials[0].score.objective, rel=0.04)


def test_a_corner_that_no_draw_came_near_is_kept():
    """Two numbers decide, and the largest product of both is drawn once in hundreds: (1.1 * 1.1) power is the limit."""
    both = ct.RangeOfUse(
        ct.SimulatedPlant(heater(1.0), {}),
        tuple(ct.Variation(name, ct.Uniform(-0.1, 0.1), parameters={"gain": 1.0}) for name in ("gain", "valve")),
    )
    evaluation = ct.RangeEvaluation(loop(range_of_use=both), 100)
    few = ct.RangeSettings(plants=4, added=2, pool=2)
    best, found = LIMIT / (1.1**2 * (1 - 0.8**STEPS)), {}
    for corners in (0, 8):
        tuner = ct.RangeTuner(evaluation, seed=0, settings=replace(few, corners=corners))
        ((found[corners],),) = tuner.ask(SPACE, [])
    assert found[0] > 1.02 * best
    # A share of 0.005 of each number is farther out, and half the tolerance is used.
    assert found[8] == pytest.approx(best, rel=3e-3)
    # The draws alone would put it back to what they allow, the corners do not.
    space = ct.ParameterSpace((ct.Parameter("power", 0.05, 2.0, default=0.995 * found[0]),))
    ((kept,),) = ct.RangeTuner(evaluation, seed=0, settings=replace(few, corners=8, drop_idle=True)).ask(space, [])
    assert kept < 1.01 * best


def test_a_violation_that_does_not_change_with_theta_is_left_behind():
    """Above power 1.4 the input is saturated: the limit is broken, and no slope says in which direction it is kept."""
    saturated = ct.Controller.build(
        heater(1.0),
        SPACE,
        horizon=1,
        stage_cost=lambda s: (s.u["u"] - s.theta["power"]) ** 2,
        input_lower={"u": 0.0},
        input_upper={"u": 1.4},
    )
    evaluation = ct.RangeEvaluation(loop(controller=saturated), 40)
    score, _, _ = evaluation(np.array([1.9]), 100)
    tried = SimpleNamespace(number=0, theta=np.array([1.9]), status="done", score=score, seed=100)
    assert score.metrics["violating_plants"] > 0
    (theta,) = ct.RangeTuner(evaluation, seed=0).ask(SPACE, [tried])
    # The margin is the spread of what broke the limit so far, and that was far beyond it.
    best = LIMIT / (1.25 * (1 - 0.8**STEPS))
    assert 0.85 * best < theta[0] < 1.001 * best


@pytest.mark.parametrize("corners", [0, 8])
def test_beside_a_plant_that_no_theta_mends_all_others_keep_the_limit(corners):
    """A plant that begins half beyond the limit stays there whatever theta is; the best power is that of the others."""
    rare = ct.Variation("hot", ct.Choice((0.0,) * 7 + (1.5,)), starts={"T": 1.0}, of="episode")
    use = ct.RangeOfUse(ct.SimulatedPlant(heater(1.0), {}), (*RANGE.variations, rare))
    evaluation = ct.RangeEvaluation(loop(range_of_use=use), 40)
    tuner = ct.RangeTuner(evaluation, seed=0, settings=ct.RangeSettings(plants=16, pool=4, corners=corners))
    drawn = use.draw(tuner.settings.plants, 0)
    assert 0 < sum(one.values["hot"][0] > 0 for one in drawn) < 4
    best = LIMIT / (1.25 * (1 - 0.8**STEPS))
    assert tuner.ask(SPACE, [])[0][0] == pytest.approx(best, rel=0.03)


def test_a_trial_is_judged_on_draws_that_nothing_was_chosen_on():
    evaluation = ct.RangeEvaluation(loop(), 40)
    tuner = ct.RangeTuner(evaluation, seed=0)
    chosen = {one.values["gain"] for one in loop().draw(tuner.settings.plants, tuner.seed)}
    judged = {one.plant.values["gain"] for one in evaluation.results(SPACE.default, 100)}
    assert len(judged) == 40
    assert not chosen & judged


def test_the_score_is_that_of_all_plants_counted_by_hand():
    evaluation, theta = ct.RangeEvaluation(loop(), 50), np.array([0.9])
    score, trace, why = evaluation(theta, 7)
    gains = np.array([1 + one.values["gain"][0] for one in RANGE.draw(50, 7)])
    levels = gains[:, None] * 0.9 * (1 - 0.8 ** np.arange(1, STEPS + 1))
    assert why == "done"
    assert score.objective == pytest.approx(levels.mean(), rel=1e-5)
    assert score.excess["T"] == pytest.approx(levels.max() - LIMIT, rel=1e-5)
    assert score.metrics["violating_plants"] == np.sum(levels.max(axis=1) - LIMIT > TOLERANCE)
    assert score.metrics["objective_worst"] == pytest.approx(levels.mean(axis=1).min(), rel=1e-5)
    order = np.argsort(levels.max(axis=1))
    for name, place in (("worst", order[-1]), ("median", order[24]), ("best", order[0])):
        assert trace.places[name] == place
        np.testing.assert_allclose(getattr(trace, name).signal("T")[1], levels[place], rtol=1e-5)
    np.testing.assert_allclose(trace.plants["objective"], levels.mean(axis=1), rtol=1e-5)
    np.testing.assert_allclose(trace.plants["excess of T"], levels.max(axis=1) - LIMIT, rtol=0, atol=1e-5)
    np.testing.assert_allclose(1 + trace.plants["drawn gain"], gains)
    for quantile, share in ((1.0, 0.0), (0.9, 0.1), (0.0, 1.0)):
        least, _, _ = ct.RangeEvaluation(loop(), 50, objective_quantile=quantile)(theta, 7)
        assert least.objective == pytest.approx(np.quantile(levels.mean(axis=1), share), rel=1e-5)


def test_a_theta_for_the_slowest_plant_is_another_one_than_for_the_mean():
    """Two kinds of plant, one with T = gain u, one with T = gain (2 - u): the mean wants u where most gain is, the slowest u = 1."""
    mirrored = ct.Model.build(
        "mirrored", states=(ct.Signal("T", "K"),), inputs=(ct.Signal("u"),), outputs=(ct.Signal("T", "K"),),
        parameters={"rising": 1.0, "falling": 0.0}, sampling_time_s=1.0,
        equations=lambda x, u, p: ({"T": p["rising"] * u["u"] + p["falling"] * (2.0 - u["u"])}, {"T": x["T"]}),
    )  # fmt: skip
    # Draws of both kinds, four of five of the first.
    kinds = [ct.SimulatedPlant(mirrored.with_parameters(rising=r, falling=f), {}) for r, f in [(1.0, 0.0)] * 4 + [(0.0, 1.0)]]
    use = ct.OwnDraws(kinds[0], lambda rng: kinds[rng.integers(5)])
    wide = ct.SimulatedRange(BLIND, use, STEPS, (ct.ScoredLimit("T", upper=9.0, tolerance=TOLERANCE),), heat)
    few, found = ct.RangeSettings(plants=12, pool=4, corners=0), {}
    for q in (None, 1.0):
        found[q] = ct.RangeTuner(ct.RangeEvaluation(wide, 20, objective_quantile=q), seed=0, settings=few).ask(SPACE, [])[0][0]
    assert found[None] == pytest.approx(2.0, abs=1e-3)
    assert found[1.0] == pytest.approx(1.0, abs=0.02)


def test_it_is_a_pure_function_of_its_trials():
    evaluation = ct.RangeEvaluation(loop(), 20)
    few = ct.RangeSettings(plants=12, pool=4, corners=4)
    trials = told(evaluation, ct.RangeTuner(evaluation, 1, few), 2)
    again, other = ct.RangeTuner(evaluation, 1, few), ct.RangeTuner(evaluation, 2, few)
    np.testing.assert_array_equal(again.ask(SPACE, trials), ct.RangeTuner(evaluation, 1, few).ask(SPACE, trials))
    assert again.ask(SPACE, trials, 2).shape == (2, 1)
    assert not np.array_equal(again.ask(SPACE, []), other.ask(SPACE, []))


def test_a_failed_plant_fails_the_trial_and_says_how_many():
    """The plant with the negative gain leaves the domain of its output, a square root."""
    model = ct.Model.build(
        "root", states=(ct.Signal("T"),), inputs=(ct.Signal("u"),), outputs=(ct.Signal("T"),), parameters={"gain": 1.0},
        sampling_time_s=1.0, equations=lambda x, u, p: ({"T": ca.sqrt(x["T"] + 0.01 + p["gain"] * u["u"])}, {"T": x["T"]}),
    )  # fmt: skip
    controller = ct.Controller.build(
        model, SPACE, horizon=1, stage_cost=lambda s: (s.u["u"] - s.theta["power"]) ** 2, input_lower={"u": 0.0}, input_upper={"u": 2.0}
    )
    signs = ct.RangeOfUse(ct.SimulatedPlant(model, {}), (ct.Variation("sign", ct.Choice((0.0, -2.0)), parameters={"gain": 1.0}),))
    score, trace, why = ct.RangeEvaluation(loop(controller=controller, range_of_use=signs), 16)(np.array([1.0]), 0)
    assert score is None
    assert why.startswith("8 of 16 plants")
    # What the others did is kept, and which failed.
    assert np.isnan(trace.plants["objective"]).sum() == 8
    np.testing.assert_array_equal(np.isnan(trace.plants["objective"]), trace.plants["drawn sign"] == -2.0)
    assert np.isfinite(trace.plants["objective"][list(trace.places.values())]).all()


def test_run_plants_is_the_same_in_batches_as_one_by_one():
    plants = RANGE.draw(70, 5)
    together = run_plants(loop(), np.array([0.7]), plants)
    for k in (0, 63, 64, 69):
        (alone,) = run_plants(loop(), np.array([0.7]), [plants[k]])
        assert alone.score == together[k].score


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ct.RangeEvaluation(loop(), 0), "plants = 0, allowed is an integer >= 1"),
        (
            lambda: ct.RangeEvaluation(loop(), 5, objective_quantile=1.5),
            r"objective_quantile = 1.5, allowed is \[0, 1\], or None for the mean",
        ),
        (lambda: ct.RangeSettings(plants=0), "plants = 0"),
        (lambda: ct.RangeSettings(aim=1.5), r"aim = 1.5, allowed is \[0, 1\]"),
    ],
)
def test_nonsense_is_refused_by_name(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_each_draw_has_a_case_of_the_given_signals():
    """T+ = 0.8 T + 0.2 gain u + rain, the controller blind: each draw is one that is run alone under its own rain."""
    wet = ct.Model.build(
        "wet heater", states=(ct.Signal("T", "K"),), inputs=(ct.Signal("u"),), outputs=(ct.Signal("T", "K"),),
        parameters={"gain": 1.0, "rain": 0.0}, sampling_time_s=1.0,
        equations=lambda x, u, p: ({"T": 0.8 * x["T"] + 0.2 * p["gain"] * u["u"] + p["rain"]}, {"T": x["T"]}),
    )  # fmt: skip
    controller = ct.Controller.build(
        wet, SPACE, horizon=1, stage_cost=lambda s: (s.u["u"] - s.theta["power"] * s.given["price"]) ** 2, input_lower={"u": 0.0},
        input_upper={"u": 2.0}, given=(ct.Signal("price"),),
    )  # fmt: skip
    plant = ct.SimulatedPlant(wet, {}, given=("rain",), input_before={"u": 0.5})
    draws = ct.RangeOfUse(plant, (ct.Variation("gain", ct.Uniform(-0.25, 0.25), parameters={"gain": 1.0}),))
    cases = [{"price": 1.0, "rain": np.linspace(0.0, 0.1, STEPS)}, {"price": np.linspace(1.0, 0.2, STEPS), "rain": -0.05}]
    own = ct.SimulatedRange(controller, draws, STEPS, (ct.ScoredLimit("T", upper=LIMIT),), heat, given=cases)
    plants = own.draw(8, 0)
    assert all(one.plant.input_before == {"u": 0.5} for one in plants)
    found = own.simulate([np.array([1.0])] * 8, plants)
    matches = []
    for episode, drawn in zip(found, plants, strict=True):
        alone = [ct.run_episode(controller, drawn.plant, steps=STEPS, theta=[1.0], seed=drawn.seed, given=case) for case in cases]
        matches.append([bool(np.allclose(episode.output_end, one.output_end, atol=1e-6)) for one in alone])
    assert all(sum(one) == 1 for one in matches)
    assert 0 < sum(first for first, _ in matches) < 8
    with pytest.raises(ValueError, match="given: missing"):
        ct.SimulatedRange(controller, draws, STEPS, (), heat)
    with pytest.raises(ValueError, match="no case"):
        ct.SimulatedRange(controller, draws, STEPS, (), heat, given=[])
    with pytest.raises(ValueError, match=r"names \['rain'\], allowed are none that follow a given signal"):
        ct.RangeOfUse(plant, (ct.Variation("rain", ct.Uniform(-0.25, 0.25), parameters={"rain": 1.0}),))
