"""Learning over a range of use, on a heater whose best theta is known in closed form for every plant."""

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest

import chargetune as ct
from chargetune.episode.compiled import simulate
from chargetune.learning.range_of_use.conditioned_range import ConditionedRange
from chargetune.learning.range_of_use.range_prior import RangePrior
from chargetune.learning.range_twin_tuner import Choice
from chargetune.learning.twin.ensemble import learn
from chargetune.study.result import by_newest
from chargetune.study.serialization import describe

pytestmark = pytest.mark.usefixtures("virtual_machine")

STEPS, LIMIT, NOISE = 30, 1.0, 1e-3


def heater(gain, bend=0.0):
    """T+ = 0.8 T + 0.2 gain (u + bend u^2): at rest T = gain u, and from below it never overshoots."""
    return ct.Model.build(
        "heater", states=(ct.Signal("T", "K"),), inputs=(ct.Signal("u"),), outputs=(ct.Signal("T", "K"),),
        parameters={"gain": gain}, sampling_time_s=1.0,
        equations=lambda x, u, p: ({"T": 0.8 * x["T"] + 0.2 * p["gain"] * (u["u"] + bend * u["u"] ** 2)}, {"T": x["T"]}),
    )  # fmt: skip


SPACE = ct.ParameterSpace((ct.Parameter("power", 0.05, 2.0, default=1.5),))
# Blind: it heats with theta whatever is measured.
BLIND = ct.Controller.build(
    heater(1.0), SPACE, horizon=1, stage_cost=lambda s: (s.u["u"] - s.theta["power"]) ** 2,
    input_lower={"u": 0.0}, input_upper={"u": 2.0},
)  # fmt: skip
RANGE = ct.RangeOfUse(
    ct.SimulatedPlant(heater(1.0), {}, ct.Sensors(noise_sd={"T": NOISE})),
    (
        ct.Variation("gain", ct.Uniform(-0.25, 0.25), parameters={"gain": 1.0}),
        ct.Variation("start", ct.Uniform(0.0, 0.2), starts={"T": 1.0}, of="episode"),
    ),
)
LIMITS = (ct.ScoredLimit("T", upper=LIMIT, tolerance=5e-3),)
LOOP = ct.SimulatedRangeTwin(ct.SimulatedRange(BLIND, RANGE, STEPS, LIMITS, lambda e: float(np.mean(e.signal("T")[1]))))
FEW = ct.RangeSettings(plants=8, added=4, pool=4, corners=4, iterations=8)
SETTINGS = ct.RangeTwinSettings(rounds=2, judges=150, first=FEW, later=replace(FEW, pool=0))
TUNER = ct.RangeTwinTuner(LOOP, settings=SETTINGS)


def tried(theta, plant, number):
    episode = simulate(BLIND, plant, steps=STEPS, theta=theta, seed=number)
    score = LOOP.score(episode)
    return SimpleNamespace(number=number, theta=tuple(theta), status="done", score=score, episode=lambda: episode)


def told(tuner, count, plant=None):
    """Trials of one plant of the range, each from a start of its own."""
    trials, choices = [], []
    for number in range(count):
        found = tuner.proposed(SPACE, trials)
        (drawn,) = RANGE.draw(1, 50 + number, scores=np.array([-0.8]))
        choices.append(found)
        trials.append(tried(np.array(found.theta), drawn.plant if plant is None else replace(plant, start=drawn.plant.start), number))
    return trials, choices


GAIN = 1.0 + float(RANGE.variations[0].distribution.at(np.array([0.2118554]))[0])  # of the score -0.8: Phi(-0.8) = 0.2118554


def test_the_first_theta_is_that_of_the_whole_range_and_the_next_one_that_of_the_plant():
    trials, choices = told(TUNER, 3)
    assert [one.choice for one in choices] == [Choice.ROBUST, Choice.CONDITIONED, Choice.CONDITIONED]
    assert choices[0].theta[0] == pytest.approx(LIMIT / 1.25, rel=0.02)
    # What the traces leave is the gain to a per cent; what is of an episode costs nothing here.
    assert 0.96 * LIMIT / GAIN < choices[2].theta[0] < (LIMIT + 5e-3) / GAIN
    assert all(one.score.feasible for one in trials)
    assert all(one.probability >= 0.95 for one in choices)


def test_the_same_trials_give_the_same_theta_and_a_batch_repeats_it():
    trials, choices = told(TUNER, 2)
    again = ct.RangeTwinTuner(LOOP, settings=SETTINGS).ask(SPACE, trials[:1], 2)
    np.testing.assert_array_equal(again, np.tile(choices[1].theta, (2, 1)))


def test_the_result_of_its_study_is_the_newest_trial_that_kept_the_limits():
    """Episodes begin in conditions of their own: the best objective is that of the best start."""
    assert by_newest({"tuner": describe(TUNER)})
    assert not by_newest({"tuner": describe(ct.RangeTuner(ct.RangeEvaluation(LOOP, 4)))})


def test_a_declared_start_is_tried_first_and_no_search_is_made():
    tuner = replace(TUNER, safety=ct.Safety(start=(0.3,)))
    assert tuner.proposed(SPACE, []).choice is Choice.DECLARED
    np.testing.assert_array_equal(tuner.ask(SPACE, []), [[0.3]])


def test_a_plant_that_is_none_of_the_range_is_said_and_the_first_theta_stays():
    """Three traces: a single prediction is not enough to reject a twin."""
    strange = ct.SimulatedPlant(heater(0.9, bend=-0.9), {}, ct.Sensors(noise_sd={"T": NOISE}))
    powers = (0.3, 0.9, 0.1, 0.6)
    trials = [tried(np.array([power]), strange, number) for number, power in enumerate(powers)]
    found = TUNER.proposed(SPACE, trials)
    assert found.choice is Choice.NO_TWIN
    assert "standard deviations" in found.why or "times as large as stated" in found.why
    assert found.theta == (0.3,)
    with pytest.warns(RuntimeWarning, match="the traces are of no plant of the range"):
        TUNER.ask(SPACE, trials)


def test_a_charge_that_kept_what_no_draw_keeps_is_believed_and_not_the_draws():
    """The twin is told a limit of half the height: all of its draws break it with a theta that kept the real one."""
    strict = replace(LOOP.range, limits=(ct.ScoredLimit("T", upper=LIMIT / 2, tolerance=5e-3),))
    tuner = ct.RangeTwinTuner(ct.SimulatedRangeTwin(strict), settings=SETTINGS)
    trials, _ = told(TUNER, 1)
    found = tuner.proposed(SPACE, trials)
    assert (found.choice, found.theta, found.probability) == (Choice.REPEATED, trials[0].theta, 0.0)
    assert "it kept every limit, which it does on 0.000 of the draws" in found.why
    with pytest.warns(RuntimeWarning, match="these are not of this plant"):
        tuner.ask(SPACE, trials)
    # Of a charge that broke the limit the same draws say the truth: theta is chosen on them.
    trials[0].score = strict.score(trials[0].episode())
    assert tuner.proposed(SPACE, trials).choice is Choice.CONDITIONED


def test_draws_after_a_trace_are_of_its_plant_in_fresh_episodes():
    trials, _ = told(TUNER, 1)
    loop = ConditionedRange.of(LOOP, learn(LOOP, trials), SPACE.default)
    draws = loop.draw(64, 9)
    gains = np.array([one.plant.model.nominal[0] for one in draws])
    starts = np.array([one.plant.start["T"] for one in draws])
    assert np.abs(gains - GAIN).max() < 0.02
    assert starts.min() < 0.01
    assert starts.max() > 0.19
    assert loop.draw(64, 9)[3].values == draws[3].values
    # What its model cannot represent belongs to each draw, in what it is judged by too.
    assert np.ptp([one.error[0, 0] for one in draws]) > 0
    without = [replace(one, error=None) for one in draws]
    first, second = (loop.simulate([np.array([0.5])] * 64, plants) for plants in (draws, without))
    assert np.ptp([a.signal("T")[1][-1] - b.signal("T")[1][-1] for a, b in zip(first, second, strict=True)]) > 0


def test_entries_of_the_controllers_model_are_those_of_the_expected_plant():
    space = ct.ParameterSpace((*SPACE.parameters, ct.Parameter("believed", 0.5, 2.0, default=1.0)))
    knowing = ct.Controller.build(
        heater(1.0), space, horizon=1, stage_cost=lambda s: (s.u["u"] - s.theta["power"]) ** 2,
        input_lower={"u": 0.0}, input_upper={"u": 2.0},
    )  # fmt: skip
    simulated = ct.SimulatedRange(knowing, RANGE, STEPS, LIMITS, LOOP.range.objective)
    loop = ct.SimulatedRangeTwin(simulated, model_entries=lambda p: {"believed": p["gain"][0]})
    trials, _ = told(TUNER, 1)
    found = ConditionedRange.of(loop, learn(loop, trials), np.array([0.7, 1.0]))
    assert found.space(space).entries == ("power",)
    assert found.space(space).default.tolist() == [0.7]
    assert found.whole(np.array([0.6])) == pytest.approx([0.6, GAIN], rel=0.02)


def test_it_stops_when_the_budget_is_spent():
    trials, _ = told(TUNER, 1)
    over = tried(np.array([1.5]), RANGE.draw(1, 3)[0].plant, 1)
    assert LOOP.violation(over.episode()) > 1.0
    with pytest.raises(ct.NoSafeThetaError, match="the budget of violation is spent"):
        replace(TUNER, safety=ct.Safety(budget=1.0)).ask(SPACE, [*trials, over])


def test_no_theta_for_the_range_is_said_with_the_share_that_the_best_one_keeps():
    tight = replace(LOOP.range, limits=(ct.ScoredLimit("T", upper=0.01, tolerance=1e-3),))
    with pytest.raises(ct.NoSafeThetaError, match=r"no theta keeps every limit on 0\.95 of the range of use"):
        ct.RangeTwinTuner(ct.SimulatedRangeTwin(tight), settings=SETTINGS).ask(SPACE, [])


def test_trials_of_earlier_studies_are_refused():
    trials, _ = told(TUNER, 1)
    trials[0].number = -1
    with pytest.raises(ValueError, match="trials of earlier studies"):
        TUNER.ask(SPACE, trials)


def test_numbers_of_the_settings_are_checked():
    for name in ("rounds", "judges"):
        with pytest.raises(ValueError, match=f"range twin settings: {name} = 0, allowed is an integer >= 1"):
            ct.RangeTwinSettings(**{name: 0})
    with pytest.raises(ValueError, match=r"range twin settings: contradicted = 1\.0, allowed is \[0, 1\)"):
        ct.RangeTwinSettings(contradicted=1.0)


@pytest.mark.parametrize(("probability", "count"), [(0.95, 150), (0.99, 299), (0.999, 2995)])
def test_as_many_draws_judge_a_theta_as_can_show_the_probability(probability, count):
    drawn = []

    @dataclass(frozen=True)
    class Counting(ct.SimulatedRangeTwin):
        def draw(self, count, seed, scores=None, *, extreme=None):
            drawn.append(count)
            return super().draw(count, seed, scores, extreme=extreme)

    found = ct.RangeTwinTuner(Counting(LOOP.range), 5, ct.Safety(probability), SETTINGS).proposed(SPACE, [])
    assert max(drawn) == count
    assert found.probability >= probability
    if count > 150:
        # One draw less would not show it: so many of them keep the limits by chance at a share just below (binomial distribution).
        assert probability**count <= 0.05 < probability ** (count - 1)


def test_scores_of_the_nominal_plant_change_nothing():
    (one,) = RANGE.draw(1, 3, scores=RANGE.nominal_scores)
    assert one.plant.model.nominal[0] == pytest.approx(1.0, abs=1e-12)
    assert RangePrior(RANGE).at(RANGE.nominal_scores) == pytest.approx([0.0], abs=1e-12)
