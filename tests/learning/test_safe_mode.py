"""Safe learning: what reaches the plant, what it promises, and when it stops."""

from dataclasses import replace

import numpy as np
import pytest
from toy_loop import SPACE, TOLERANCE, UNKNOWNS, Plant, Told, ToyLoop, structural

from chargetune.learning import ConstrainedLogEI, NoSafeThetaError, Safety, TwinTuner, Uncertain
from chargetune.learning.candidates import Proposal
from chargetune.learning.safe_mode import safe_thetas
from chargetune.learning.twin.calibration import SCALES, PredictionCheck
from chargetune.learning.twin.ensemble import condition
from chargetune.learning.twin.settings import TwinSettings
from chargetune.model.parameter_space import Parameter, ParameterSpace

pytestmark = pytest.mark.usefixtures("virtual_machine")

# What differential evolution finds on the plant, of the whole tolerance: see test_search for the comparison.
ATTAINABLE = -0.4365
SAFE = TwinTuner(ToyLoop(), safety=Safety())


def excess(plant, trials):
    return [plant.truth(t.theta).excess["gauge"] for t in trials]


@pytest.mark.parametrize("seed", [0, 1])
def test_three_trials_and_none_breaks_the_limit(seed):
    trials = Plant().learn(replace(SAFE, seed=seed), 3, seed)
    np.testing.assert_array_equal(trials[0].theta, SPACE.upper)
    assert max(excess(Plant(), trials)) <= TOLERANCE
    assert Plant().truth(trials[-1].theta).objective > 1.02 * ATTAINABLE


def test_a_plant_that_the_twin_cannot_be_is_approached_with_care():
    """The loop states that the gauge may be off by a hundredth, which is what it is."""
    plant, tuner = Plant(unmodelled=structural), replace(SAFE, loop=ToyLoop(discrepancy_sd_floor={"gauge": 1e-2}))
    trials = plant.learn(tuner, 4)
    assert max(excess(plant, trials)) <= 3 * TOLERANCE
    assert excess(plant, trials)[-1] <= TOLERANCE
    assert plant.truth(trials[-1].theta).objective > 1.05 * ATTAINABLE


def test_nothing_is_risked_for_nothing():
    """A fourth parameter that does nothing stays where it was tried, and so do losses at levels that are never reached."""

    class Idle(ToyLoop):
        def simulate(self, members):
            return super().simulate([(theta[:3], m, error) for theta, m, error in members])

    space = ParameterSpace((Parameter("loss", 0.3, 3.0, 1.0, size=3), Parameter("idle", 0.0, 1.0, 0.5)))
    tuner, trials = TwinTuner(Idle(), safety=Safety(start=(3.0, 3.0, 3.0, 0.7))), []
    for number in range(3):
        theta = tuner.ask(space, trials)[0]
        trials.append(replace(Plant().trial(number, theta[:3]), theta=tuple(theta)))
        assert theta[3] == pytest.approx(0.7, abs=1e-6)
    assert Plant().truth(trials[-1].theta[:3]).objective > 1.02 * ATTAINABLE


def test_the_first_theta_is_the_declared_one_or_the_corner_that_is_safe():
    declared = (2.5, 2.0, 2.9)
    np.testing.assert_array_equal(replace(SAFE, safety=Safety(start=declared)).ask(SPACE, [], 2), [declared] * 2)
    # At most 1.1 times the loss cannot cover what the prior allows.
    narrow = ParameterSpace((Parameter("loss", 0.9, 1.1, 1.0, size=3),))
    with pytest.raises(NoSafeThetaError, match=r"no corner .* probability 0\.95"):
        SAFE.ask(narrow, [])
    with pytest.raises(ValueError, match=r"loss\[0\] = 9"):
        replace(SAFE, safety=Safety(start=(9.0,) * 3)).ask(SPACE, [])


@pytest.mark.parametrize("status", ["failed", "running"])
def test_a_trial_without_a_trace_teaches_nothing_and_the_start_is_proposed_again(status):
    """A start is not judged anew by other plants either: they could pass by chance what these refused."""
    lost = [Told(0, tuple(SPACE.upper), status)]
    np.testing.assert_array_equal(SAFE.ask(SPACE, lost), SAFE.ask(SPACE, []))
    declared = replace(SAFE, safety=Safety(start=(2.0, 2.0, 2.0)))
    np.testing.assert_array_equal(declared.ask(SPACE, lost), [(2.0, 2.0, 2.0)])


def test_a_safe_batch_is_of_thetas_that_all_passed_and_what_runs_is_not_tried_twice(monkeypatch):
    """Candidates of the search at these levels, of which 1.2 breaks the limit."""
    trials = [Plant().trial(0, SPACE.upper)]
    monkeypatch.setattr(Proposal, "search", lambda self: ([self.candidate(np.full(3, v)) for v in (1.2, 1.8, 1.9, 2.0)], None))
    np.testing.assert_allclose(SAFE.ask(SPACE, trials, 2)[:, 0], [1.8, 1.9])
    np.testing.assert_allclose(SAFE.ask(SPACE, trials, 4)[:, 0], [1.8, 1.9, 2.0, 1.8])
    running = Told(1, (1.8,) * 3, "running")
    np.testing.assert_allclose(SAFE.ask(SPACE, [*trials, running], 2)[:, 0], [1.9, 2.0])


def test_what_is_proposed_is_safe_on_plants_that_nothing_was_chosen_by():
    trials = Plant().learn(SAFE, 2)
    # Three standard errors of a share of 200 below 0.95.
    predicted = condition(SAFE.loop, trials).predict(SAFE.ask(SPACE, trials)[0], 12345, 200)
    assert predicted.probability() >= 0.95 - 3 * (0.95 * 0.05 / 200) ** 0.5


def test_a_spent_budget_stops_the_study():
    broken = [Plant().trial(0, SPACE.upper), Plant().trial(1, SPACE.default)]
    spent = sum(ToyLoop().violation(t.episode()) for t in broken)
    assert spent > 0
    with pytest.raises(NoSafeThetaError, match="budget of violation is spent"):
        replace(SAFE, safety=Safety(budget=0.9 * spent)).ask(SPACE, broken)
    assert np.all(np.isfinite(replace(SAFE, safety=Safety(budget=1.1 * spent)).ask(SPACE, broken)))


def after_one_trial(level=2.5, **settings):
    trials = [Plant().trial(0, np.full(3, level))]
    return Proposal(SPACE, condition(ToyLoop(), trials, TwinSettings(**settings)), trials, 0.95, 0), np.full(3, level)


def test_the_longest_part_of_the_way_that_is_safe_is_gone():
    proposal, theta = after_one_trial()
    shares = proposal.ensemble.settings.steps_back

    def accepted(theta):
        return proposal.accepts(proposal.candidate(theta))

    for level in (1.8, 1.2, 0.3):
        aim = np.full(3, level)
        found = proposal.backtrack(theta, aim, accepted)
        passed = [s for s in shares if accepted(theta + s * (aim - theta))]
        assert passed
        np.testing.assert_allclose(found, theta + passed[0] * (aim - theta), rtol=1e-12)
    assert proposal.backtrack(np.full(3, 1.0), np.full(3, 0.3), accepted) is None


def test_what_only_the_plants_it_was_chosen_by_allow_is_not_proposed(monkeypatch):
    """The plants that candidates are chosen by allow everything: a part of the way is proposed, and it holds on other plants."""
    proposal, theta = after_one_trial()
    aim = np.full(3, 1.2)
    assert not proposal.holds(aim)
    monkeypatch.setattr(Proposal, "search", lambda self: ([self.candidate(aim)], self.candidate(aim)))
    (proposed,) = safe_thetas(proposal, Safety())
    assert proposal.ensemble.predict(proposed, 12345, 200).probability() >= 0.95 - 3 * (0.95 * 0.05 / 200) ** 0.5
    assert 1.2 < proposed[0] < theta[0]
    np.testing.assert_allclose(proposed, proposed[0])


def test_without_an_improvement_the_theta_that_was_safe_is_proposed_again_and_said(monkeypatch):
    proposal, theta = after_one_trial(steps_back=(0.99,))
    monkeypatch.setattr(Proposal, "search", lambda self: ([], self.candidate(np.full(3, 0.3))))
    with pytest.warns(RuntimeWarning, match="no safe improvement is known"):
        np.testing.assert_array_equal(safe_thetas(proposal, Safety()), [theta])


def test_where_nothing_that_was_tried_is_safe_nothing_is_proposed():
    """The space ends where the loss is believed too small on the plant, which one trial shows."""
    narrow = ParameterSpace((Parameter("loss", 0.3, 1.0, 1.0, size=3),))
    trials = [Plant().trial(0, SPACE.default)]
    with pytest.raises(NoSafeThetaError, match=r"no theta keeps every limit .* 1 trial can show; nothing was proposed"):
        SAFE.ask(narrow, trials)


def test_candidates_keep_every_limit_on_the_stated_share_of_the_plants_the_best_first():
    plant = Plant(unmodelled=structural)
    trials = plant.learn(SAFE, 2)
    proposal = Proposal(SPACE, condition(SAFE.loop, trials), trials, 0.95, 3)
    accepted, _ = proposal.search()
    assert accepted
    assert all(predicted.probability() >= 0.95 for _, predicted in accepted)
    objectives = [proposal.expected.score(SPACE.to_unit(theta)).objective for theta, _ in accepted]
    assert objectives == sorted(objectives, reverse=True) or objectives[1:] == sorted(objectives[1:], reverse=True)


def test_more_certainty_costs_objective():
    trials = [Plant().trial(0, np.full(3, 2.5))]
    ensemble = condition(ToyLoop(), trials)
    best = []
    for probability in (0.5, 0.95):
        (_theta, predicted), *_ = Proposal(SPACE, ensemble, trials, probability, 0).search()[0]
        assert predicted.probability() >= probability
        best.append(predicted.objective())
    assert best[0] > best[1]


def unforeseen():
    """Three trials whose gauge no vessel has."""
    trials = []
    for number, level in enumerate((3.0, 2.5, 2.0)):
        plant = Plant(unmodelled=lambda height, _, n=number: -0.1 + 0.1 * np.sin(25 * height + 2 * n))
        trials.append(plant.trial(number, np.full(3, level)))
    return trials


def test_a_twin_that_is_none_repeats_the_best_trial_and_says_so():
    trials = unforeseen()
    assert condition(ToyLoop(), trials).rejected
    assert [t.score.feasible for t in trials] == [True] * 3
    best = max(trials, key=lambda t: t.score.objective)
    # Without a promise the black box goes on, and it learns from these trials.
    with pytest.warns(RuntimeWarning, match="is no model of this plant: .*; this proposal is the black box's"):
        np.testing.assert_array_equal(TwinTuner(ToyLoop()).ask(SPACE, trials, 2), ConstrainedLogEI(0, n_initial=0).ask(SPACE, trials, 2))
    with pytest.warns(RuntimeWarning, match="is no model of this plant: .* is proposed again"):
        np.testing.assert_array_equal(SAFE.ask(SPACE, trials, 2), [best.theta] * 2)
    broken = [replace(t, score=replace(t.score, excess={"gauge": 1.0})) for t in trials]
    with pytest.raises(NoSafeThetaError, match="no trial kept every limit; nothing was proposed"):
        SAFE.ask(SPACE, broken)


def test_errors_beyond_every_scale_are_said():
    proposal, theta = after_one_trial()
    beyond = PredictionCheck(np.where(np.arange(len(SCALES)) == len(SCALES) - 1, 0.0, -1e3), 1.0)
    proposal = replace(proposal, ensemble=replace(proposal.ensemble, learnt=replace(proposal.ensemble.learnt, checks=(beyond,))))
    with pytest.warns(RuntimeWarning, match="times as large as stated"):
        np.testing.assert_array_equal(safe_thetas(proposal, Safety()), [theta])


def test_trials_of_another_plant_are_refused():
    with pytest.raises(ValueError, match="trials of earlier studies"):
        SAFE.ask(SPACE, [replace(Plant().trial(0, SPACE.upper), number=-1)])


def test_an_unknown_start_is_learnt_safely():
    """What the vessel holds at the start is unknown too."""
    loop = ToyLoop((*UNKNOWNS, Uncertain("gauge", 0.02, "bias")))
    plant = Plant(unmodelled=lambda level, _: 0.015 + 0.0 * level)
    trials = plant.learn(replace(SAFE, loop=loop), 3)
    assert max(excess(plant, trials)) <= TOLERANCE


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: Safety(probability=1.0), "probability = 1.0"),
        (lambda: Safety(probability=0.2), "probability = 0.2"),
        (lambda: Safety(budget=-1.0), "budget = -1.0"),
    ],
)
def test_nonsense_is_refused_by_name(make, said):
    with pytest.raises(ValueError, match="=") as caught:
        make()
    assert said in str(caught.value)
