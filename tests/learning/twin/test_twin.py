"""The twin against another simulation, finite differences, dense algebra and known plants."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from toy_loop import GAIN, LOSS, MODEL, NOISE, SPACE, UNKNOWNS, Plant, ToyLoop, holed, structural

from chargetune.episode.episode import Ending
from chargetune.learning import Twin, Uncertain
from chargetune.learning.twin.laplace import NegativeLogPosterior, fit
from chargetune.learning.twin.residuals import binned_residuals, measured
from chargetune.learning.twin.rollout import parameters, predict, predict_each, slopes, slopes_each, start_state
from chargetune.learning.twin.settings import TwinSettings

pytestmark = pytest.mark.usefixtures("virtual_machine")

EVERYTHING = (
    *UNKNOWNS, Uncertain("level", 0.02, "start"), Uncertain("swirl", 0.02, "start"), Uncertain("gauge", 0.01, "bias"),
)  # fmt: skip
TRUE = np.log([*Plant().factors, Plant().gain / GAIN])


def test_roll_outs_are_those_of_another_simulation():
    """Of the toy in numpy: outputs at both ends of each interval, with starts and a bias."""
    loop, m = ToyLoop(EVERYTHING), np.array([0.3, -0.2, 0.1, 0.2, 0.05, 0.02, -0.01])
    (episode,) = loop.simulate([(SPACE.default, m, None)])
    np.testing.assert_allclose(predict(loop.twin, m, episode.input)[..., 0], np.stack(episode.signal("gauge"), axis=1), atol=1e-12)
    np.testing.assert_allclose(parameters(loop.twin, m), np.append(LOSS, GAIN) * np.exp(m[:4]), rtol=1e-12)
    np.testing.assert_allclose(start_state(loop.twin, m), m[4:6], atol=1e-15)


def test_sensitivities_are_those_of_finite_differences():
    unknowns = (Uncertain("loss", 0.3), Uncertain("gain", 0.1, "offset"), *EVERYTHING[2:])
    twin = ToyLoop(unknowns, {"gauge": NOISE, "swirl": NOISE}).twin
    inputs = np.random.default_rng(0).uniform(0, 0.6, (25, 1))
    m = 0.03 * np.random.default_rng(1).standard_normal(7)
    exact = slopes(twin, m, inputs)
    assert exact.shape == (25, 2, 2, 7)
    differences = [(predict(twin, m + h, inputs) - predict(twin, m - h, inputs)) / 2e-6 for h in 1e-6 * np.eye(7)]
    np.testing.assert_allclose(exact, np.moveaxis(differences, 0, -1), atol=1e-7)


def test_several_episodes_and_several_unknowns_at_once_are_as_one_after_the_other():
    """Also more of them than go into one call, and episodes of different lengths."""
    twin = ToyLoop().twin
    inputs = [np.random.default_rng(k).uniform(0, 1, (length, 1)) for k, length in enumerate((30, 60, 17))]
    unknowns = 0.1 * np.random.default_rng(9).standard_normal((19, 4))
    together = predict_each(twin, unknowns, inputs)
    assert [values.shape for values in together] == [(19, len(u), 2, 1) for u in inputs]
    for u, values in zip(inputs, together, strict=True):
        np.testing.assert_allclose(values, [predict(twin, m, u) for m in unknowns], rtol=0, atol=1e-12)
    for u, values in zip(inputs, slopes_each(twin, unknowns[0], inputs), strict=True):
        np.testing.assert_allclose(values, slopes(twin, unknowns[0], u), rtol=0, atol=1e-12)


@pytest.mark.parametrize("discrepancy", [False, True])
def test_covariance_is_that_of_dense_algebra_with_the_spread_that_is_stated(discrepancy):
    """(J'J / spread^2 + S^-1)^-1 with J by finite differences, on a plant that the twin cannot be."""
    episode, twin = Plant(unmodelled=structural).episode(SPACE.upper, 3), ToyLoop().twin
    posterior = fit(twin, [episode], discrepancy=discrepancy)
    inputs, mode = episode.input, posterior.mode
    columns = [(predict(twin, mode + h, inputs) - predict(twin, mode - h, inputs)).ravel() / 2e-5 for h in 1e-5 * np.eye(4)]
    jacobian = np.array(columns).T / posterior.spread[0]
    prior = np.linalg.inv(twin.prior_factor @ twin.prior_factor.T)
    # The mode is found to a part of a standard deviation, and so is the curvature there.
    np.testing.assert_allclose(posterior.covariance, np.linalg.inv(jacobian.T @ jacobian + prior), rtol=1e-2, atol=1e-7)
    assert (posterior.spread[0] == NOISE) is not discrepancy


def test_the_squares_are_those_of_all_samples():
    """|values|^2 = |e|^2 + sum of squared residuals, its gradient by finite differences; samples without a number do not count."""
    twin, episode = ToyLoop().twin, holed(Plant().episode(SPACE.upper, 3), "gauge", slice(5, 20))
    loss = NegativeLogPosterior(twin, [(twin, episode.input, measured(twin, episode))], np.array([NOISE]))

    def dense(e):
        left = (measured(twin, episode) - predict(twin, twin.prior_factor @ e, episode.input)) / NOISE
        return e @ e + np.nansum(left**2)

    e = np.array([0.3, 0.1, -0.2, 0.4])
    assert np.sum(loss.values(e) ** 2) == pytest.approx(dense(e), rel=1e-6)
    gradient = [(dense(e + h) - dense(e - h)) / 2e-5 for h in 1e-5 * np.eye(4)]
    np.testing.assert_allclose(2 * loss.slopes(e).T @ loss.values(e), gradient, rtol=1e-4)


@pytest.mark.parametrize("extra", [None, structural], ids=["of the model", "structural"])
def test_a_fit_that_begins_at_another_ends_where_it_would_by_itself(extra):
    """Within a small part of a standard deviation, and it is as wide."""
    twin = ToyLoop().twin
    episodes = [Plant(unmodelled=extra).episode(np.full(3, level), k) for k, level in enumerate((3.0, 2.0, 1.7, 1.5))]
    alone = fit(twin, episodes)
    along = fit(twin, episodes, start=fit(twin, episodes[:3]))
    np.testing.assert_allclose(along.spread, alone.spread, rtol=0.05)
    assert np.linalg.norm(np.linalg.solve(alone.root, along.mode - alone.mode)) < 0.3
    np.testing.assert_allclose(along.covariance, alone.covariance, rtol=0.15, atol=1e-6)


def test_the_true_unknowns_lie_where_the_posterior_says():
    """(m - true)' C^-1 (m - true) ~ chi-squared of 4 degrees: its mean over 40 plants is 4 with an sd of 0.45."""
    loop, draw = ToyLoop(), np.random.default_rng(0)
    off = []
    for seed in range(40):
        true = loop.twin.prior_factor @ draw.standard_normal(4)
        plant = Plant(tuple(np.exp(true[:3])), GAIN * np.exp(true[3]))
        posterior = fit(loop.twin, [plant.episode(SPACE.upper, seed)], discrepancy=False)
        off.append(np.sum(np.linalg.solve(posterior.root, posterior.mode - true) ** 2))
    assert 4 - 4 * 0.45 < np.mean(off) < 4 + 4 * 0.45


def test_one_trial_tells_the_gauge_of_another():
    """90 % intervals of new noisy samples under another input cover 85 to 95 % of them."""
    twin, covered = ToyLoop().twin, []
    for seed in range(12):
        posterior = fit(twin, [Plant().episode(SPACE.upper, seed)])
        other = Plant().episode(np.full(3, 1.5), 100 + seed)
        off = measured(twin, other) - predict(twin, posterior.mode, other.input)
        covered.append(np.abs(off) < 1.645 * posterior.predicted_sd(other.input))
    assert 0.85 < np.mean(covered) < 0.95


def test_starts_and_a_constant_error_come_back():
    loop = ToyLoop(EVERYTHING)
    true = np.array([*TRUE, 0.03, 0.01, -0.02])
    (episode,) = loop.simulate([(SPACE.upper, true, None)])
    (without,) = loop.simulate([(SPACE.upper, np.append(true[:-1], 0.0), None)])
    np.testing.assert_allclose(episode.signal("gauge")[1] - without.signal("gauge")[1], -0.02, atol=1e-12)
    posterior = fit(loop.twin, [episode])
    sd = np.sqrt(np.diag(posterior.covariance))
    assert np.all(np.abs(posterior.mode - true) < 3 * sd)
    assert np.all(sd[-3:] < [0.02, 0.02, 0.01])


def test_missing_samples_and_short_traces_are_taken_as_they_are():
    twin, episode = ToyLoop().twin, Plant().episode(SPACE.upper, 0)
    short = holed(episode, "gauge", slice(None, None, 3)).cut(30, Ending.DONE, "")
    whole, part = (fit(twin, [e]) for e in (episode, short))
    assert np.all(np.isfinite(part.mode))
    assert np.trace(part.covariance) > np.trace(whole.covariance)


def test_where_the_record_of_the_input_ends_nothing_is_predicted_and_nothing_is_lost():
    twin, episode = ToyLoop().twin, Plant().episode(SPACE.upper, 0)
    lost = replace(episode, input=episode.input.copy(), output_start=episode.output_start.copy(), output_end=episode.output_end.copy())
    for values in (lost.input, lost.output_start, lost.output_end):
        values[40:] = np.nan
    whole, half = (fit(twin, [e], discrepancy=False) for e in (lost, episode.cut(40, Ending.DONE, "")))
    np.testing.assert_allclose(whole.mode, half.mode, atol=1e-4)
    np.testing.assert_allclose(whole.draw(4, 0), half.draw(4, 0), atol=1e-3)


def test_what_the_model_cannot_represent_is_a_discrepancy():
    twin, episode = ToyLoop().twin, Plant().episode(SPACE.upper, 0)
    wrong = Plant(unmodelled=lambda level, inflow: 0.01 * np.sin(40 * level)).episode(SPACE.upper, 0)
    assert fit(twin, [wrong]).discrepancy_sd[0] > 0.004
    assert fit(twin, [episode]).discrepancy_sd[0] < 0.001


def test_means_over_bins_are_those_of_a_loop():
    values = np.random.default_rng(0).standard_normal((23, 2, 3))
    values[4:9, :, 1] = np.nan
    means, counts = binned_residuals(values, 5)
    edges = np.cumsum([0, 5, 5, 5, 4, 4])
    for k, (low, high) in enumerate(itertools.pairwise(edges)):
        for i in range(3):
            seen = values[low:high, :, i][np.isfinite(values[low:high, :, i])]
            assert counts[k, i] == len(seen)
            assert means[k, i] == pytest.approx(seen.mean()) if len(seen) else np.isnan(means[k, i])


def test_twins_of_equal_content_are_equal_and_of_another_are_not():
    twin = ToyLoop().twin
    fresh = Twin(MODEL.with_parameters(loss=tuple(LOSS)), UNKNOWNS, {"gauge": NOISE}, discrepancy_sd_floor={"gauge": 1e-3})
    assert fresh.content == twin.content
    others = [
        replace(twin, model=MODEL.with_parameters(gain=0.11)),
        replace(twin, unknowns=(Uncertain("loss", 0.3, smooth=0.3), UNKNOWNS[1])),
        replace(twin, noise_sd={"gauge": 2e-3}),
        replace(twin, noise_sd={"swirl": NOISE}, discrepancy_sd_floor={}),
        replace(twin, start={"level": 0.1}),
        replace(twin, discrepancy_sd_floor={}),
        replace(twin, floor_at_zero_input=0.5),
    ]
    contents = [repr(one.content) for one in (twin, *others)]
    assert len(set(contents)) == len(contents)


def test_a_twin_remembers_nothing_that_learning_does():
    """It is data: what it holds before and after a fit and roll-outs is the same but for what follows from its own fields."""
    twin = ToyLoop().twin
    names = ("sizes", "content", "factors", "prior_factor")
    before = {name: np.array(getattr(twin, name), dtype=object, copy=True) for name in names if name != "content"} | {
        "content": repr(twin.content)
    }
    held = set(vars(twin))
    posterior = fit(twin, [Plant().episode(SPACE.upper, 0)])
    predict(twin, posterior.mode, Plant().episode(SPACE.upper, 0).input)
    assert set(vars(twin)) == held
    assert repr(twin.content) == before["content"]
    for name in names[:1] + names[2:]:
        np.testing.assert_array_equal(np.array(getattr(twin, name), dtype=object), before[name])


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: Uncertain("loss", 0.0), "sd of loss = 0.0"),
        (lambda: Uncertain("loss", 0.1, smooth=1.0), "smooth of loss = 1.0"),
        (lambda: Uncertain("loss", 0.1, "ratio"), "kind of loss = 'ratio'"),
        (lambda: Twin(MODEL, (Uncertain("R9", 0.1),), {"gauge": 1e-3}), "unknown factor 'R9'"),
        (lambda: Twin(MODEL, (Uncertain("level", 0.1, "bias"),), {"gauge": 1e-3}), "unknown bias 'level', allowed are gauge"),
        (lambda: Twin(MODEL, (), {"gauge": 1e-3}), "at least one"),
        (lambda: Twin(MODEL, (UNKNOWNS[0], UNKNOWNS[0]), {"gauge": 1e-3}), "each once"),
        (lambda: Twin(MODEL, UNKNOWNS, {"inflow": 1e-3}), "noise_sd names ['inflow']"),
        (lambda: Twin(MODEL, UNKNOWNS, {"gauge": 0.0}), "finite numbers > 0"),
        (lambda: Twin(MODEL, UNKNOWNS, {"gauge": 1e-3}, {"height": 1.0}), "start names ['height']"),
        (lambda: TwinSettings(traces=0), "twin settings: traces = 0, allowed is an integer >= 1"),
        (lambda: TwinSettings(plants=True), "plants = True"),
        (lambda: TwinSettings(rounds=2.0), "rounds = 2.0"),
        (lambda: TwinSettings(scale_sd=0.0), "twin settings: scale_sd = 0.0, allowed is a number > 0"),
        (lambda: TwinSettings(gain=float("nan")), "gain = nan"),
        (lambda: TwinSettings(aim=1.5), "twin settings: aim = 1.5, allowed is [0, 1]"),
        (lambda: TwinSettings(proximal=-0.1), "proximal = -0.1"),
        (lambda: TwinSettings(length_scales=(0.1, 0.0)), "length_scales = (0.1, 0.0)"),
        (lambda: TwinSettings(steps_back=(1.0,)), "steps_back = (1.0,), allowed are numbers in (0, 1)"),
    ],
)
def test_nonsense_is_refused_by_name(make, said):
    with pytest.raises(ValueError, match="twin") as caught:
        make()
    assert said in str(caught.value)
