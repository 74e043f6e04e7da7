"""The composite tuner on a track with unknown speed limits: closed-form optimum, missing windows, failures, batches."""

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from chargetune.learning import Composite
from chargetune.learning.black_box.composite import WindowOutputs, _Data, _near, _Processes, _Surrogate
from chargetune.learning.black_box.optimize_acquisition import reproducible
from chargetune.model.parameter_space import Parameter, ParameterSpace

NODES, WINDOWS = 4, 8
SPACE = ParameterSpace((Parameter("speed", 0.5, 3.0, 2.5, size=NODES),))
HATS = np.array([np.interp(np.linspace(0, NODES - 1, WINDOWS), range(NODES), unit) for unit in np.eye(NODES)]).T
ALLOWED = HATS @ np.array([1.2, 2.0, 1.5, 1.0])
NOISE = 0.01


@dataclass(frozen=True)
class Lap:
    """The speed in each window of the track, and what a noisy instrument says of its excess."""

    speed: np.ndarray
    seen: np.ndarray

    def __len__(self):
        return len(self.speed)


class Track:
    """Speeds are interpolated between the entries of theta, and a little less where it is fast; limits are not known."""

    widths = costs = np.ones(WINDOWS)
    duration_s = 20.0
    tolerances = np.array([0.02])

    def window_outputs(self, lap):
        return WindowOutputs(lap.speed, lap.seen[None], np.where(np.isfinite(lap.seen), NOISE, np.nan)[None])


def lap(theta, number=0):
    speed = HATS @ np.asarray(theta)
    speed = speed - 0.05 * speed**2
    return Lap(speed, speed - ALLOWED + NOISE * np.random.default_rng(number).standard_normal(WINDOWS))


def trial(number, theta, status="done", episode=lap):
    made = None if episode is None else episode(theta, number)
    score = object() if status == "done" else None
    return SimpleNamespace(number=number, theta=tuple(theta), status=status, score=score, episode=lambda: made)


def tuned(tuner, count):
    trials = []
    while len(trials) < count:
        trials.append(trial(len(trials), tuner.ask(SPACE, trials)[0]))
    return trials


def time_of(theta):
    return float(np.sum(1.0 / lap(theta).speed))


def best_time():
    """Every node at its limit: the windows between are beyond theirs by less than the tolerance."""
    nodes = np.array([1.2, 2.0, 1.5, 1.0])
    return time_of(10 * (1 - np.sqrt(1 - 0.2 * nodes)))


@pytest.mark.parametrize("seed", range(2))
def test_finds_the_fastest_lap_within_limits_that_it_only_sees_with_noise(seed):
    tuner = Composite(Track(), seed=seed, n_initial=4)
    trials = tuned(tuner, 14)
    best = trials[tuner.best(SPACE, trials)]
    assert np.max(lap(best.theta).speed - ALLOWED) <= 0.04
    assert time_of(best.theta) <= 1.03 * best_time()


def test_the_first_points_are_theta_0_and_points_about_it_however_they_are_asked():
    tuner = Composite(Track(), seed=1)
    nine = tuner.ask(SPACE, [], 9)
    np.testing.assert_allclose(nine[0], SPACE.default)
    assert len(np.unique(nine, axis=0)) == 9
    # theta_0 lies near the upper bound: the box about it ends there.
    assert np.all(SPACE.to_unit(nine) >= 0.4 - 1e-9)
    trials = []
    for size in (1, 3, 5):
        asked = tuner.ask(SPACE, trials, size)
        np.testing.assert_array_equal(asked, nine[len(trials) : len(trials) + size])
        trials += [trial(len(trials) + k, theta) for k, theta in enumerate(asked)]


def test_is_a_pure_function_of_the_trials():
    tuner = Composite(Track(), seed=2, n_initial=3)
    trials = tuned(tuner, 6)
    torch.manual_seed(1)
    before = torch.random.get_rng_state()
    first = tuner.ask(SPACE, trials, 2)
    assert torch.equal(torch.random.get_rng_state(), before)
    torch.manual_seed(2)
    np.testing.assert_array_equal(tuner.ask(SPACE, trials, 2), first)


def test_thetas_of_a_batch_differ_and_keep_away_from_what_is_running():
    tuner = Composite(Track(), seed=0, n_initial=3)
    trials = tuned(tuner, 6)
    alone = tuner.ask(SPACE, trials)[0]
    running = trial(6, alone, "running", episode=None)
    batch = np.vstack([alone, tuner.ask(SPACE, [*trials, running], 2)])
    distances = np.linalg.norm(SPACE.to_unit(batch)[:, None] - SPACE.to_unit(batch)[None], axis=2)
    assert np.min(distances[np.triu_indices(3, 1)]) > 1e-3


def test_without_any_trace_the_points_go_on():
    tuner = Composite(Track(), seed=0, n_initial=2)
    trials = [trial(k, theta, "failed", episode=None) for k, theta in enumerate(tuner.ask(SPACE, [], 3))]
    asked = tuner.ask(SPACE, trials, 2)
    assert asked.shape == (2, NODES)
    assert len(np.unique(np.vstack([asked, [t.theta for t in trials]]), axis=0)) == 5
    assert tuner.best(SPACE, trials) is None
    assert tuner.best(SPACE, []) is None


def test_a_lap_that_was_cut_short_teaches_what_it_showed():
    def cut(theta, number):
        full = lap(theta, number)
        shown = np.arange(WINDOWS) < 3
        return Lap(np.where(shown, full.speed, np.nan), np.where(shown, full.seen, np.nan))

    tuner = Composite(Track(), seed=0, n_initial=3)
    trials = tuned(tuner, 5)
    failed = trial(5, SPACE.from_unit(np.full(NODES, 0.45)), "failed", episode=cut)
    data = _Data.of(Track(), SPACE, [*trials, failed])
    assert len(data.x) == 6
    with reproducible(0):
        sd = _Surrogate(data).rates(torch.full((1, NODES), 0.45))[1].detach()
    assert float(sd[0, :3].max()) < 0.02 < float(sd[0, 5:].min())


def test_what_was_not_measured_has_no_influence():
    draw = np.random.default_rng(0)
    x, y = draw.uniform(size=(7, 2)), draw.standard_normal((7, 2))
    holes = y.copy()
    holes[:3, 1] = np.nan
    spread = np.full((7, 2), 0.05)
    at = torch.as_tensor(draw.uniform(size=(5, 2)))
    with reproducible(0):
        filled = _Processes(x, holes, spread)(at)
        alone = _Processes(x[3:], np.column_stack([y[3:, 1], y[3:, 1]]), spread[3:])(at)
    # Scaled by the larger of both columns' deviations on one side, by its own on the other.
    np.testing.assert_allclose(filled[0][:, 1].detach(), alone[0][:, 1].detach(), atol=0.15)


def test_windows_far_from_their_limit_are_left_out():
    excess = np.array([[-1.0, -0.1, -5.0, np.nan, 0.1], [-0.9, -0.3, -5.0, np.nan, np.nan]])
    np.testing.assert_array_equal(_near(excess), [False, True, False, False, True])


def test_the_objective_is_the_time_of_the_lap_and_stays_finite():
    data = _Data.of(Track(), SPACE, tuned(Composite(Track(), n_initial=3), 4))
    with reproducible(0):
        surrogate = _Surrogate(data)
        speed = torch.tensor([[1.0, 2.0, 1.5, 0.8, 2.0, 1.0, 1.0, 3.0]])
        assert float(surrogate.objective(speed)) == pytest.approx(-float((1 / speed).sum()), rel=2e-2)
        stuck = surrogate.objective(torch.tensor([[-1.0] * WINDOWS]))
    assert torch.isfinite(stuck).all()
    assert float(stuck) < -Track().duration_s


@pytest.mark.parametrize("n_initial", [-1, 1.5, True])
def test_refuses_a_design_that_is_none(n_initial):
    with pytest.raises(ValueError, match=r"n_initial = .*allowed is an integer >= 0"):
        Composite(Track(), n_initial=n_initial)
