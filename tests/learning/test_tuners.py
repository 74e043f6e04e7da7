"""What holds for every tuner, and how well each does."""

import numpy as np
import pytest
import torch

from chargetune.learning import ConstrainedLogEI, ExpectedImprovement, Sobol
from chargetune.learning.initial_design import initial_design, sobol_points
from chargetune.model.parameter_space import Parameter, ParameterSpace

SPACE = ParameterSpace((Parameter("a", 0.0, 1.0, 0.9, size=2), Parameter("r", 0.1, 10.0, 1.0, scale="log")))
TUNERS = [ConstrainedLogEI(seed=3), ExpectedImprovement(seed=3), Sobol(seed=3)]
LEARNING = TUNERS[:2]


def bowl(theta):
    u = SPACE.to_unit(theta)
    return -float(np.sum((u - 0.35) ** 2)), float(0.5 - u[0])


def history(told, tuner, count, function=bowl):
    thetas = tuner.ask(SPACE, [], min(count, 9))
    if count > len(thetas):
        more = SPACE.from_unit(np.random.default_rng(0).uniform(size=(count - len(thetas), 3)))
        thetas = np.vstack([thetas, more])
    return [told(k, t, *function(t)) for k, t in enumerate(thetas)]


@pytest.mark.parametrize("tuner", TUNERS)
def test_the_first_points_are_theta_0_and_sobol_however_they_are_asked(tuner, told):
    nine = tuner.ask(SPACE, [], 9)
    np.testing.assert_array_equal(nine[0], SPACE.default)
    np.testing.assert_array_equal(nine[1:], SPACE.from_unit(sobol_points(3, 3, 0, 8)))
    trials = []
    for size in (1, 3, 2, 3):
        asked = tuner.ask(SPACE, trials, size)
        np.testing.assert_array_equal(asked, nine[len(trials) : len(trials) + size])
        trials += [told(len(trials) + k, t, *bowl(t)) for k, t in enumerate(asked)]


def test_the_design_is_cut_to_what_is_left():
    assert initial_design(SPACE, 8, 0, 9, 4).shape == (0, 3)
    assert initial_design(SPACE, 8, 0, 7, 4).shape == (2, 3)


@pytest.mark.parametrize("n", [1, 3])
@pytest.mark.parametrize("count", [5, 12])
@pytest.mark.parametrize("tuner", TUNERS)
def test_a_tuner_is_a_pure_function_of_the_trials(tuner, count, n, told):
    trials = history(told, tuner, count)
    threads, dtype = torch.get_num_threads(), torch.get_default_dtype()
    torch.manual_seed(1)
    before = torch.random.get_rng_state()
    first = tuner.ask(SPACE, trials, n)
    assert torch.equal(torch.random.get_rng_state(), before)
    assert (torch.get_num_threads(), torch.get_default_dtype()) == (threads, dtype)
    torch.manual_seed(2)
    np.random.seed(5)  # noqa: NPY002 - the global generator must not matter
    np.testing.assert_array_equal(tuner.ask(SPACE, trials, n), first)
    assert first.shape == (n, 3)
    assert np.all((first >= SPACE.lower) & (first <= SPACE.upper))
    assert len(np.unique(first, axis=0)) == n


@pytest.mark.parametrize("tuner", LEARNING)
def test_seeds_differ(tuner, told):
    trials = history(told, tuner, 12)
    other = type(tuner)(seed=4)
    assert not np.array_equal(other.ask(SPACE, [], 4)[1:], tuner.ask(SPACE, [], 4)[1:])
    assert other.ask(SPACE, trials).shape == (1, 3)


@pytest.mark.parametrize("tuner", LEARNING)
@pytest.mark.parametrize("kind", ["all failed", "some failed", "running", "duplicates", "constant", "heavy tails", "no limits", "one done"])
def test_awkward_histories_give_usable_thetas(kind, tuner, told):
    trials = history(told, tuner, 12)
    if kind == "all failed":
        trials = [told(t.number, t.theta) for t in trials]
    if kind == "some failed":
        trials = [told(t.number, t.theta) if t.number % 3 == 0 else t for t in trials]
    if kind == "running":
        trials = [*trials[:10], told(10, trials[10].theta, status="running"), told(11, trials[11].theta, status="running")]
    if kind == "duplicates":
        trials = [told(k, trials[0].theta, *bowl(np.array(trials[0].theta))) for k in range(12)]
    if kind == "constant":
        trials = [told(t.number, t.theta, -1.0, -0.2) for t in trials]
    if kind == "heavy tails":
        trials = [
            told(t.number, t.theta, t.score.objective * 10.0 ** (t.number - 5), t.score.excess["limit"] * 10.0 ** (t.number - 5))
            for t in trials
        ]
    if kind == "no limits":
        trials = [told(t.number, t.theta, t.score.objective) for t in trials]
    if kind == "one done":
        trials = [trials[0], *(told(t.number, t.theta) for t in trials[1:])]
    for n in (1, 2):
        asked = tuner.ask(SPACE, trials, n)
        assert asked.shape == (n, 3)
        assert np.all(np.isfinite(asked))
        assert np.all((asked >= SPACE.lower) & (asked <= SPACE.upper))
        known = np.array([t.theta for t in trials])
        distance = np.abs(SPACE.to_unit(known)[:, None] - SPACE.to_unit(asked)).max(-1)
        assert distance.min() > 1e-7


@pytest.mark.parametrize("n", [0, -1, True, 1.0])
@pytest.mark.parametrize("tuner", TUNERS)
def test_a_wrong_count_is_refused(tuner, n):
    with pytest.raises(ValueError, match="n = "):
        tuner.ask(SPACE, [], n)


@pytest.mark.parametrize("tuner", LEARNING)
def test_the_neighbourhood_of_failures_is_left(tuner, told):
    # Everything better lies where trials fail; the tuner must not stay there.
    def function(theta):
        u = SPACE.to_unit(theta)
        return -float(np.sum((u - 0.35) ** 2)), None

    trials = history(told, tuner, 12, function)
    centre = SPACE.from_unit([0.35, 0.35, 0.35])
    inside = tuner.ask(SPACE, trials)[0]
    trials += [told(12, inside), told(13, centre)]
    outside = SPACE.to_unit(tuner.ask(SPACE, trials)[0])
    assert np.linalg.norm(outside - SPACE.to_unit(inside)) > 0.02
    assert np.linalg.norm(outside - 0.35) > 0.02


def corner(theta):
    """Maximum of the sum inside a quarter disc: at the middle of the arc, value sqrt(2) * 0.8."""
    u = SPACE.to_unit(theta)[:2]
    return float(np.sum(u)), float(np.linalg.norm(u) - 0.8)


def best(trials):
    kept = [t.score.objective for t in trials if t.score.feasible]
    return max(kept, default=-np.inf)


def test_the_default_finds_a_constrained_optimum_and_beats_sobol(run):
    found = [best(run(ConstrainedLogEI(seed=s), SPACE, corner, 18)) for s in range(3)]
    baseline = [best(run(Sobol(seed=s), SPACE, corner, 18)) for s in range(3)]
    assert np.median(found) > 0.98 * np.sqrt(2) * 0.8
    assert np.median(found) > np.median(baseline)


def test_expected_improvement_finds_an_unconstrained_optimum_and_beats_sobol(run):
    def function(theta):
        return bowl(theta)[0], None

    found = [best(run(ExpectedImprovement(seed=s), SPACE, function, 14)) for s in range(3)]
    baseline = [best(run(Sobol(seed=s), SPACE, function, 14)) for s in range(3)]
    assert np.median(found) > -2e-3
    assert np.median(found) > np.median(baseline)
