"""Episode as data: arrays and metadata there and back, cutting, trips and the rules that end it."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from chargetune.control.sqp import SolveStatus
from chargetune.episode.episode import Ending, Episode, Trip, ending_at
from chargetune.study.store.trace import decode, encode

STEPS = 6


def make(**more):
    """Six intervals with different numbers everywhere."""
    numbers = iter(range(1000))

    def block(*shape):
        return np.array([next(numbers) for _ in range(math.prod(shape))], dtype=float).reshape(shape)

    values = {
        "sampling_time_s": 2.0,
        "input_names": ("inflow",),
        "output_names": ("level", "gauge"),
        "input_units": ("m",),
        "output_units": ("m", "m"),
        "estimate_names": ("level",),
        "time_s": 2.0 * np.arange(STEPS),
        "input": block(STEPS, 1),
        "output_start": block(STEPS, 2),
        "output_end": block(STEPS, 2),
        "estimate": block(STEPS, 1),
        "status": np.zeros(STEPS, dtype=np.int64),
        "kkt": block(STEPS),
        "iterations": np.ones(STEPS, dtype=np.int64),
        "ending": Ending.DONE,
        "true_start": block(STEPS, 2),
        "true_end": block(STEPS, 2),
        "state": block(STEPS + 1, 1),
    }
    return Episode(**(values | more))


def equal(one, two):
    left, right = one.arrays(), two.arrays()
    return left.keys() == right.keys() and all(np.array_equal(left[n], right[n], equal_nan=True) for n in left) and one.meta() == two.meta()


@pytest.mark.parametrize("hardware", [False, True])
def test_there_and_back_through_the_stored_form(hardware):
    unknown = {"true_start": None, "true_end": None, "state": None} if hardware else {}
    episode = make(ending=Ending.LIMIT, message="gauge = 3 left [0, 2]", **unknown)
    arrays, meta = decode(encode(episode.arrays(), json.loads(json.dumps(episode.meta()))))
    again = Episode.from_arrays(arrays, meta)
    assert equal(again, episode)
    assert again.ending is Ending.LIMIT
    assert isinstance(again.output_names, tuple)
    assert again.status.dtype == np.int64
    assert (again.state is None) == hardware


def test_cut_keeps_one_state_more_than_intervals():
    episode = make()
    short = episode.cut(2, Ending.PLANT, "gone")
    assert len(short) == 2
    assert (short.ending, short.message) == (Ending.PLANT, "gone")
    for name, value in short.arrays().items():
        assert len(value) == (3 if name == "state" else 2), name
        np.testing.assert_array_equal(value, getattr(episode, name)[: len(value)])
    assert equal(episode, make())


def test_cut_to_nothing():
    empty = make().cut(0, Ending.LIMIT, "")
    assert len(empty) == 0
    assert empty.input.shape == (0, 1)
    assert empty.arrays()["state"].shape == (1, 1)


def test_signal_by_name():
    episode = make()
    np.testing.assert_array_equal(episode.signal("gauge")[0], episode.output_start[:, 1])
    np.testing.assert_array_equal(episode.signal("gauge")[1], episode.output_end[:, 1])
    np.testing.assert_array_equal(episode.signal("level", true=True)[1], episode.arrays()["true_end"][:, 0])
    measured_only = replace(episode, true_start=None, true_end=None)
    np.testing.assert_array_equal(measured_only.signal("level", true=True)[1], episode.output_end[:, 0])
    with pytest.raises(ValueError, match="unknown output 'voltage', allowed are level, gauge"):
        episode.signal("voltage")


def test_failures_counts_every_step_that_is_not_solved():
    status = np.array([SolveStatus.CONVERGED, SolveStatus.NOT_CONVERGED, SolveStatus.FALLBACK, 0, 0, 0])
    assert make(status=status).failures == 2


@pytest.mark.parametrize(("lower", "upper"), [(1.0, 1.0), (2.0, 1.0), (math.nan, 1.0), (0.0, math.nan)])
def test_a_trip_needs_lower_less_than_upper(lower, upper):
    with pytest.raises(ValueError, match=r"trip of gauge: lower = .* must be less than upper"):
        Trip("gauge", lower, upper)


def column(*values):
    """A measured gauge; the level stays what it is."""
    return np.column_stack([np.ones(STEPS), np.array(values, dtype=float)])


FINE = column(1, 1, 1, 1, 1, 1)
NAN = math.nan
FALLBACK = int(SolveStatus.FALLBACK)
BLIND = "no finite measurement in 3 intervals in a row"
BROKEN = "the solver gave no finite input in 3 intervals in a row"

ENDINGS = {
    "nothing": ({}, Ending.DONE, STEPS, ""),
    "over at the end": ({"output_end": column(1, 1, 3, 1, 1, 9)}, Ending.LIMIT, 3, "gauge = 3 left [0, 2]"),
    "over at the start": ({"output_start": column(1, 3, 1, 4, 1, 1)}, Ending.LIMIT, 2, "gauge = 3 left [0, 2]"),
    "under": ({"output_end": column(1, 1, 1, 1, 1, -1)}, Ending.LIMIT, 6, "gauge = -1 left [0, 2]"),
    "on the limit": ({"output_end": column(2, 2, 0, 2, 2, 2)}, Ending.DONE, STEPS, ""),
    "infinite": ({"output_end": column(1, math.inf, 1, 1, 1, 1)}, Ending.LIMIT, 2, "gauge = inf left [0, 2]"),
    "blind twice, twice": ({"output_end": column(NAN, NAN, 1, NAN, NAN, 1)}, Ending.DONE, STEPS, ""),
    "blind three times": ({"output_end": column(1, NAN, NAN, NAN, 1, 1)}, Ending.SENSOR, 4, BLIND),
    "blind, over later": ({"output_end": column(NAN, NAN, NAN, 1, 9, 1)}, Ending.SENSOR, 3, BLIND),
    "over, blind later": ({"output_end": column(9, 1, NAN, NAN, NAN, 1)}, Ending.LIMIT, 1, "gauge = 9 left [0, 2]"),
    "broken twice": ({"status": np.array([0, FALLBACK, FALLBACK, 0, FALLBACK, FALLBACK])}, Ending.DONE, STEPS, ""),
    "broken three times": ({"status": np.array([0, 0, FALLBACK, FALLBACK, FALLBACK, 0])}, Ending.SOLVER, 5, BROKEN),
    "not converged is not broken": ({"status": np.full(STEPS, int(SolveStatus.NOT_CONVERGED))}, Ending.DONE, STEPS, ""),
}  # fmt: skip


@pytest.mark.parametrize("case", ENDINGS)
def test_what_ends_an_episode(case):
    changed, ending, length, message = ENDINGS[case]
    ended = ending_at(make(**({"output_start": FINE, "output_end": FINE} | changed)), [Trip("gauge", 0.0, 2.0)])
    assert (ended.ending, len(ended), ended.message) == (ending, length, message)


def test_the_first_trip_wins():
    episode = make(output_start=FINE, output_end=column(1, 1, 3, 1, 1, 1))
    ended = ending_at(episode, [Trip("gauge", upper=2.5), Trip("level", upper=0.5)])
    assert (ended.ending, len(ended), ended.message) == (Ending.LIMIT, 1, "level = 1 left [-inf, 0.5]")


def test_shorter_than_the_window_of_the_rules():
    episode = make(output_start=FINE, output_end=column(*[NAN] * STEPS)).cut(2, Ending.DONE, "")
    assert ending_at(episode, []).ending is Ending.DONE
