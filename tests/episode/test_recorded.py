"""An episode of a device's log has its charge, its samples and its verdict."""

import numpy as np
import pytest

import chargetune as ct

INPUTS, OUTPUTS = (ct.Signal("u", "A"),), (ct.Signal("y", "V"),)


def recorded(time, u, y, step=10.0, **more):
    return ct.recorded_episode(time, {"u": u, "y": y}, inputs=INPUTS, outputs=OUTPUTS, sampling_time_s=step, **more)


def log(levels, step=10.0, each=5):
    """One level of the input an interval, ``each`` samples in it; the output counts the samples."""
    time = np.arange(len(levels) * each + 1) * step / each
    return time, np.concatenate([[0.0], np.repeat(levels, each)]), np.arange(time.size, dtype=float)


def test_inputs_and_samples_of_each_interval():
    episode = recorded(*log([2.0, 1.0, -1.0]))
    np.testing.assert_allclose(episode.input[:, 0], [2.0, 1.0, -1.0], rtol=1e-12)
    np.testing.assert_array_equal(episode.signal("y"), [[1, 6, 11], [5, 10, 15]])
    np.testing.assert_allclose(episode.time_s, [0.0, 10.0, 20.0])
    assert (episode.ending, episode.unsolved_share, episode.input_units) == ("done", 0.0, ("A",))


def test_no_charge_is_lost_where_samples_and_intervals_differ():
    rng = np.random.default_rng(3)
    time = 100 + np.concatenate([[0.0], np.cumsum(rng.uniform(0.3, 4.0, 200))])
    u = rng.normal(size=time.size)
    episode = recorded(time, u, time, step=7.0)
    passed = np.concatenate([[0.0], np.cumsum(u[1:] * np.diff(time))])
    whole = 7.0 * np.arange(len(episode) + 1)
    np.testing.assert_allclose(np.cumsum(7.0 * episode.input[:, 0]), np.interp(whole[1:], time - time[0], passed), atol=1e-9)
    start, end = episode.signal("y")
    assert np.all((start > 100 + whole[:-1]) & (start < 100 + whole[:-1] + 4.0))
    assert np.all((end <= 100 + whole[1:]) & (end > 100 + whole[1:] - 4.0))


def test_an_interval_without_a_sample_was_not_measured():
    episode = recorded([0.0, 10.0, 40.0], [0.0, 1.0, 2.0], [1.0, 2.0, 3.0])
    np.testing.assert_allclose(episode.input[:, 0], [1.0, 2.0, 2.0, 2.0])
    np.testing.assert_array_equal(episode.signal("y")[1], [2.0, np.nan, np.nan, 3.0])


def test_what_a_simulation_logs_is_the_same_episode(tmp_path):
    level = [ct.Signal("y", "V")]
    model = ct.Model.build(
        "m",
        states=level,
        inputs=INPUTS,
        outputs=level,
        parameters={},
        sampling_time_s=1.0,
        equations=lambda x, u, p: ({"y": 0.9 * x["y"] + u["u"]}, x),
    )
    controller = ct.Controller.build(
        model, ct.ParameterSpace(()), horizon=3, stage_cost=lambda s: (s.x["y"] - 1) ** 2, input_lower={"u": 0.0}, input_upper={"u": 0.3}
    )
    run = ct.simulate(controller, ct.SimulatedPlant(model, {}), steps=8)
    end = run.signal("y")[1]
    found = recorded(np.arange(9.0), np.concatenate([[0.0], run.input[:, 0]]), np.concatenate([[0.0], end]), step=1.0)
    np.testing.assert_allclose(found.input, run.input, atol=1e-12)
    np.testing.assert_allclose(found.output_end, run.output_end, atol=1e-12)
    limits = [ct.ScoredLimit("y", upper=0.9, tolerance=1e-3)]
    scores = [ct.score_limits(e, limits, objective=lambda e: e.signal("y")[1].mean()).score for e in (run, found)]
    assert scores[1].objective == pytest.approx(scores[0].objective)
    assert scores[1].excess["y"] == pytest.approx(scores[0].excess["y"])
    with ct.Store(tmp_path / "s.sqlite") as store:
        space = ct.ParameterSpace((ct.Parameter("a", 0.0, 1.0, default=0.5),))
        with ct.Study.create_or_resume(store, "log", config={}, space=space, tuner=ct.Sobol(0), hardware=True) as study:
            (trial,) = study.ask_batch(1)
            study.tell(trial.number, scores[1], found)
            kept = ct.Episode.from_arrays(*study.trace(trial.number))
    np.testing.assert_array_equal(kept.input, found.input)
    assert kept.estimate.shape == (8, 0)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"time": [0.0, 10.0, 10.0]}, r"time_s\[2\] = 10 after 10, allowed is an increasing time"),
        ({"time": [0.0, np.nan, 20.0]}, "allowed are two or more finite numbers"),
        ({"u": [0.0, 1.0]}, "signals: u of shape .2,., allowed are finite numbers, one for each of 3 times"),
        ({"y": [0.0, np.inf, 1.0]}, "signals: y of shape"),
        ({"step": 21.0}, "sampling_time_s = 21, allowed is more than 0 and at most the 20 s of the log"),
        ({"step": 0.0}, "sampling_time_s = 0, allowed"),
        ({"step": np.nan}, "sampling_time_s = nan, allowed"),
    ],
)
def test_refusals(change, words):
    with pytest.raises(ValueError, match=words):
        recorded(**{"time": [0.0, 10.0, 20.0], "u": [0.0, 1.0, 1.0], "y": [0.0, 1.0, 2.0]} | change)


def test_a_signal_that_is_missing_is_named():
    with pytest.raises(ValueError, match="signals: y is missing, given are u"):
        ct.recorded_episode([0.0, 1.0], {"u": [0.0, 1.0]}, inputs=INPUTS, outputs=OUTPUTS, sampling_time_s=1.0)
