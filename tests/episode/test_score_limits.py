"""The verdict by limits: by hand, with samples lost, and of episodes that ended early."""

from dataclasses import replace

import numpy as np
import pytest

from chargetune.episode.episode import Ending, Episode
from chargetune.episode.score_limits import ScoredLimit, Windows, limit_samples, moving_mean, score_limits, violation, worst_by_window


def test_moving_mean_by_hand():
    np.testing.assert_allclose(moving_mean(np.array([0.0, 3.0, 6.0, 0.0]), 3), [1.5, 3.0, 3.0, 3.0])
    np.testing.assert_allclose(moving_mean(np.array([1.0, 2.0]), 9), [1.5, 1.5])
    assert moving_mean(np.zeros(0), 3).size == 0


@pytest.mark.parametrize("samples", [1, 2, 3, 4, 9])
def test_a_lost_sample_is_left_out_of_the_mean_and_spoils_no_other(samples):
    draw = np.random.default_rng(4)
    values = draw.normal(size=40)
    values[[0, 7, 8, 9, 10, 11, 20]] = [np.nan, np.nan, np.inf, np.nan, np.nan, -np.inf, np.nan]
    found = moving_mean(values, samples)
    for k in range(values.size):
        part = values[max(0, k - samples // 2) : k + (samples - 1) // 2 + 1]
        known = part[np.isfinite(part)]
        if samples > 1:
            assert found[k] == pytest.approx(np.mean(known)) if known.size else np.isnan(found[k]), k


def episode(level, *, ending=Ending.DONE, message="", end=None):
    """Intervals of 2 s with one output ``level`` at both ends, or ``end`` at the second, and a position that goes from 0 to 1."""
    start = np.asarray(level, dtype=float)
    count = start.size
    end = start if end is None else np.asarray(end, dtype=float)
    position = (np.arange(count) + 1.0) / max(count, 1)
    return Episode(
        sampling_time_s=2.0,
        input_names=("u",),
        output_names=("level", "position"),
        input_units=("1",),
        output_units=("m", "m"),
        estimate_names=(),
        time_s=2.0 * np.arange(count),
        input=np.zeros((count, 1)),
        output_start=np.column_stack([start, position]),
        output_end=np.column_stack([end, position]),
        estimate=np.zeros((count, 0)),
        status=np.zeros(count, dtype=np.int64),
        kkt=np.zeros(count),
        iterations=np.ones(count, dtype=np.int64),
        ending=ending,
        message=message,
    )


LIMIT = ScoredLimit("level", lower=-1.0, upper=2.0, tolerance=0.5)


def total(one):
    return float(np.sum(one.signal("level")[1]))


def test_excess_tolerance_and_profile_by_hand():
    measured = episode([0.0, 2.75, 1.0, -1.25], end=[1.0, 1.0, 1.5, -1.0])
    np.testing.assert_allclose(LIMIT.excess(measured), [-1.0, 0.75, -0.5, 0.25])
    windows = Windows("position", 0.0, 1.5, 3)
    score, same, ending = score_limits(measured, [LIMIT, ScoredLimit("level", upper=3.0, name="top", by_window=False)], objective=total,
                                       windows=windows, metrics=lambda e: {"count": float(len(e))})  # fmt: skip
    assert (same, ending) == (measured, "done")
    assert score.excess == {"level": 0.75, "top": -0.25}
    assert score.tolerance == {"level": 0.5, "top": 0.0}
    # Positions 0.25 | 0.5, 0.75 | 1.0.
    assert score.profile == {"level": (-1.0, 0.75, 0.25)}
    assert score.objective == 2.5
    # Half a tolerance beyond the tolerance, at a penalty of 1.
    assert score.performance == pytest.approx(2.5 - 0.5)
    assert score.metrics == {"unsolved_percent": 0.0, "count": 4.0}
    assert not score.feasible


def test_a_profile_names_the_windows_that_were_not_visited():
    assert worst_by_window(np.array([1.0, 3.0, 2.0]), np.array([2, 2, 0]), 4) == (2.0, None, 3.0, None)


@pytest.mark.parametrize("ending", [e for e in Ending if e is not Ending.DONE])
def test_an_episode_that_ended_early_has_no_score_and_is_not_looked_at(ending):
    """Over half the intervals half is summed: it would be the best trial of the study."""

    def refuse(_):
        raise AssertionError("an episode that ended early was scored")

    cut = episode([0.1, 0.1], ending=ending, message="why")
    assert score_limits(cut, [LIMIT], objective=refuse, metrics=refuse) == (None, cut, f"{ending.value}: why")


def test_an_episode_without_an_interval_has_no_score():
    assert score_limits(episode([]), [LIMIT], objective=total).score is None


def test_a_lost_sample_is_left_out_and_a_lost_interval_is_no_kept_limit():
    half = episode([0.0, np.nan, 1.0], end=[0.0, 2.25, np.inf])
    score = score_limits(half, [LIMIT], objective=lambda _: 1.0).score
    assert score.excess == {"level": 0.25}
    lost = episode([0.0, np.nan, 1.0])
    score, _, ending = score_limits(lost, [LIMIT], objective=lambda _: 1.0)
    assert score is None
    assert ending == "sensor: of level not every interval was measured"
    # A moving mean of three has a neighbour to tell of it.
    assert score_limits(lost, [replace(LIMIT, samples=3)], objective=lambda _: 1.0).score.excess == {"level": -1.0}


@pytest.mark.parametrize("name", ["objective", "performance"])
def test_what_is_no_number_is_no_score(name):
    given = {"objective": lambda _: 1.0} | {name: lambda _: float("nan")}
    score, _, ending = score_limits(episode([0.0]), [LIMIT], **given)
    assert score is None
    assert ending == f"not scored: {name} = nan"


def test_violation_is_the_excess_beyond_the_tolerance_over_time():
    assert violation(episode([2.0, 2.4, 3.5, -2.5]), LIMIT) == pytest.approx(2.0 * (1.0 + 1.0))
    assert violation(episode([3.5, np.nan, 3.5]), LIMIT) == pytest.approx(3 * 2.0 * 1.0)
    assert violation(episode([np.nan]), LIMIT) == 0.0


def test_windows_of_a_lost_signal_lie_between_those_beside_it():
    one = episode([0.0] * 5)
    one.output_end[2, 1] = np.nan
    np.testing.assert_array_equal(Windows("position", 0.0, 1.0, 5).of(one), [1, 2, 3, 4, 4])
    np.testing.assert_array_equal(limit_samples(one, [LIMIT])["level"][1], np.zeros(5))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ScoredLimit("level"), "neither lower nor upper"),
        (lambda: ScoredLimit("level", lower=2.0, upper=1.0), "must be less than"),
        (lambda: ScoredLimit("level", upper=float("inf")), "finite"),
        (lambda: ScoredLimit("level", upper=1.0, tolerance=-1.0), "tolerance = -1.0, allowed is >= 0"),
        (lambda: ScoredLimit("level", upper=1.0, samples=0), "samples = 0, allowed is an integer >= 1"),
        (lambda: Windows("level", 1.0, 1.0, 3), "allowed are finite numbers"),
        (lambda: Windows("level", 0.0, 1.0, 0), "count = 0, allowed is an integer >= 1"),
        (lambda: score_limits(episode([0.0]), [LIMIT, LIMIT], objective=total), "allowed are different names"),
        (lambda: score_limits(episode([0.0]), [ScoredLimit("lvel", upper=1.0)], objective=total), "unknown output 'lvel'"),
    ],
)
def test_nonsense_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
