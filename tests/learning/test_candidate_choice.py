"""The corrected prediction against dense algebra, its acquisition against Monte Carlo, and what it makes of a twin that errs."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from chargetune.learning.candidate_choice import _Corrected, choose_candidate

from chargetune.episode.score import Score
from chargetune.learning.black_box.optimize_acquisition import reproducible
from chargetune.learning.twin.ensemble import Prediction
from chargetune.model.parameter_space import Parameter, ParameterSpace

SPACE = ParameterSpace((Parameter("a", 0.0, 1.0, 0.5), Parameter("b", 0.0, 1.0, 0.5)))
LIMITS = {"voltage": 0.1, "temperature": 0.2}
PLANTS = 32


def verdict(theta, objective=0.0, voltage=0.0, temperature=0.0):
    """Faster and nearer to both limits with a; the other arguments are what a plant differs by."""
    a, b = theta
    excess = {"voltage": a - 0.5 + 0.1 * b + voltage, "temperature": a - 0.9 + temperature}
    return Score(a - 0.2 * b + objective, 0.0, excess, LIMITS)


class Twin:
    """A ensemble whose prediction is known in closed form; nothing is predicted_before where b is 1."""

    def scores(self, thetas):
        return [None if theta[1] == 1.0 else verdict(theta) for theta in thetas]


def candidate(theta, spread=0.02):
    """With an ensemble that differs in both, by the same draws at each theta."""
    draws = np.random.default_rng(4).standard_normal((PLANTS, 2)) * spread
    scores = tuple(None if theta[1] == 1.0 else verdict(theta, objective=d, voltage=v) for d, v in draws)
    return np.array(theta), Prediction(SimpleNamespace(score=lambda one: one), scores)


def tried(*thetas, status="done", **differs):
    return [
        SimpleNamespace(number=k, theta=theta, status=status, score=verdict(theta, **differs) if status == "done" else None)
        for k, theta in enumerate(thetas)
    ]


def corrected(trials, thetas):
    twin, known = Twin(), [candidate(theta) for theta in thetas]
    done = list(zip(trials, twin.scores([np.array(t.theta) for t in trials]), strict=True))
    return _Corrected(SPACE, done, known), known


def fitted(model, output):
    """(kernel, noise variance) of one output."""
    (part,) = model._model.models

    def kernel(one, other):
        return part.covar_module(torch.tensor(one), torch.tensor(other)).to_dense()[output].detach().numpy()

    return kernel, float(part.likelihood.noise[output].detach())


TRIALS = tried((0.1, 0.2), (0.3, 0.4), (0.45, 0.1), objective=0.03, voltage=0.05)
THETAS = [(0.4, 0.3), (0.5, 0.2), (0.6, 0.6)]


def test_the_prediction_is_the_twin_and_a_gaussian_process_of_what_it_left():
    with reproducible(0):
        model, known = corrected(TRIALS, THETAS)
        points = torch.tensor(THETAS)[:, None, :]
        found = model.posterior(points)
        mean, variance = found.mean[:, 0].detach().numpy(), found.variance[:, 0].detach().numpy()
        x = np.array([t.theta for t in TRIALS])
        for output, (left, own) in enumerate([(0.03, lambda s: s.objective), (0.05, lambda s: s.excess["voltage"] - 0.1)]):
            kernel, noise = fitted(model, output)

            # Every residual is the same, so it is the unit.
            gain = np.linalg.solve(kernel(x, x) + noise * np.eye(3), kernel(x, np.array(THETAS)))
            predicted_before = np.array([np.mean([own(s) for s in p.scores]) for _, p in known]) / left
            ensemble = np.array([np.std([own(s) for s in p.scores]) for _, p in known]) / left
            np.testing.assert_allclose(mean[:, output], predicted_before + gain.sum(axis=0), rtol=1e-6)
            prior = np.diag(kernel(np.array(THETAS), np.array(THETAS)))
            spent = np.sum(kernel(x, np.array(THETAS)) * gain, axis=0)
            np.testing.assert_allclose(variance[:, output], prior - spent + ensemble**2, rtol=1e-5)


def test_its_acquisition_is_that_of_monte_carlo():
    with reproducible(0):
        model, _ = corrected(TRIALS, THETAS)
        points = torch.tensor(THETAS)[:, None, :]
        values = model.acquisition()(points).detach().exp().numpy()
        found = model.posterior(points)
        # Every trial left the same temperature, and it is far below its limit: nothing to be learnt, and no output.
        assert model.num_outputs == 2
        draws = np.random.default_rng(2).standard_normal((400_000, 3, 2))
        y = found.mean[:, 0].detach().numpy() + draws * found.variance[:, 0].sqrt().detach().numpy()
        # All trials are believed to have kept the limits; the best is the newest, by what is left of its residual when noise is taken out.
        kernel, noise = fitted(model, 0)
        k = kernel([t.theta for t in TRIALS], [t.theta for t in TRIALS])
        smooth = k @ np.linalg.solve(k + noise * np.eye(3), np.ones(3))
        best = verdict(TRIALS[2].theta).objective / 0.03 + smooth[2]
        gain = np.maximum(y[..., 0] - best, 0.0) * np.all(y[..., 1:] <= 0.0, axis=-1)
    np.testing.assert_allclose(values, gain.mean(axis=0), atol=5 * gain.std(axis=0).max() / np.sqrt(len(gain)))


@pytest.mark.parametrize(("voltage", "picked"), [(0.0, (0.55, 0.1)), (0.08, (0.45, 0.1))])
def test_what_the_twin_left_of_the_excess_decides_how_far_it_is_trusted(voltage, picked):
    """The faster candidate keeps the limit as the twin has it, but not when the trials were all 80 mV nearer to it."""
    candidates = [candidate(theta, 0.01) for theta in ((0.55, 0.1), (0.45, 0.1))]
    trials = tried((0.2, 0.1), (0.3, 0.1), (0.4, 0.1), voltage=voltage)
    theta, _ = choose_candidate(Twin(), SPACE, trials, candidates, 0)
    assert tuple(theta) == picked


def test_a_trial_that_only_noise_let_keep_the_limit_is_no_incumbent():
    """Beside the quickest trial, which was over the limit at 0.59, no theta that keeps it would be an improvement."""
    noisy = ((0.56, 0.05), (0.57, -0.05), (0.61, 0.05), (0.62, -0.05))
    trials = [t for a, noise in noisy for t in tried((a, 0.1), voltage=noise)]
    assert [t.score.feasible for t in trials] == [False, True, False, True]
    candidates = [candidate(theta, 0.01) for theta in ((0.66, 0.1), (0.58, 0.1))]
    assert tuple(choose_candidate(Twin(), SPACE, trials, candidates, 0)[0]) == (0.58, 0.1)


def test_while_no_trial_kept_the_limits_the_likeliest_to_keep_them_is_taken():
    candidates = [candidate(theta, 0.05) for theta in ((0.6, 0.1), (0.3, 0.1))]
    theta, _ = choose_candidate(Twin(), SPACE, tried((0.8, 0.1), (0.9, 0.1)), candidates, 0)
    assert tuple(theta) == (0.3, 0.1)


def test_failed_trials_are_kept_away_from():
    candidates = [candidate(theta) for theta in ((0.5, 0.1), (0.45, 0.1))]
    done = tried((0.2, 0.1), (0.3, 0.1))
    assert tuple(choose_candidate(Twin(), SPACE, done, candidates, 0)[0]) == (0.5, 0.1)
    failed = tried((0.5, 0.1), status="failed")
    assert tuple(choose_candidate(Twin(), SPACE, [*done, *failed], candidates, 0)[0]) == (0.45, 0.1)


def test_without_a_residual_the_first_of_which_something_is_foretold_is_taken():
    candidates = [candidate(theta) for theta in ((0.5, 1.0), (0.3, 0.1), (0.45, 0.1))]
    for trials in ([], tried((0.2, 0.1)), tried((0.2, 0.1), status="running")):
        assert tuple(choose_candidate(Twin(), SPACE, trials, candidates, 0)[0]) == (0.3, 0.1)
    assert tuple(choose_candidate(Twin(), SPACE, [], candidates[:1], 0)[0]) == (0.5, 1.0)


def test_a_problem_without_limits_is_corrected_too():
    def free(theta):
        return Score(float(theta[0]), 0.0, {}, {})

    candidates = [
        (np.array(theta), Prediction(SimpleNamespace(score=free), tuple(np.array(theta) + d for d in (-0.01, 0.01))))
        for theta in ((0.3, 0.1), (0.6, 0.1))
    ]
    trials = [SimpleNamespace(number=k, theta=(a, 0.1), status="done", score=free((a,))) for k, a in enumerate((0.1, 0.2))]
    twin = SimpleNamespace(scores=lambda thetas: [free(theta) for theta in thetas])
    assert tuple(choose_candidate(twin, SPACE, trials, candidates, 0)[0]) == (0.6, 0.1)
