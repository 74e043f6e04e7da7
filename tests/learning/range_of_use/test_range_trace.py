"""What a trial over a range of use keeps, through the store and back."""

import numpy as np
import pytest

from chargetune.episode.episode import Ending, Episode
from chargetune.learning.range_of_use.range_trace import RangeTrace
from chargetune.study.store.trace import decode, encode


def episode(first, *, with_state=True):
    """Three intervals of one signal."""
    column = first + np.arange(3.0)[:, None]
    return Episode(
        sampling_time_s=2.0, input_names=("u",), output_names=("T",), input_units=("W",), output_units=("K",), estimate_names=(),
        time_s=2.0 * np.arange(3), input=-column, output_start=column, output_end=column + 1, estimate=np.zeros((3, 0)),
        status=np.zeros(3, dtype=np.int64), kkt=np.zeros(3), iterations=np.ones(3, dtype=np.int64), ending=Ending.DONE,
        state=np.zeros((4, 1)) if with_state else None,
    )  # fmt: skip


@pytest.mark.parametrize("with_state", [True, False])
def test_it_comes_back_from_the_bytes_of_a_store(with_state):
    three = [episode(first, with_state=with_state) for first in (30.0, 20.0, 10.0)]
    plants = {"objective": np.array([1.0, np.nan, 3.0]), "excess of T": np.array([0.1, np.nan, -0.2])}
    trace = RangeTrace(*three, places={"worst": 0, "median": 2, "best": 2}, plants=plants)
    arrays, meta = decode(encode(trace.arrays(), trace.meta()))
    again = RangeTrace.from_arrays(arrays, meta)
    assert again.places == trace.places
    assert list(again.plants) == list(plants)
    for name, values in plants.items():
        np.testing.assert_array_equal(again.plants[name], values)
    # Whoever reads an episode finds the worst plant's.
    for found, stored in zip([again.worst, again.median, again.best, Episode.from_arrays(arrays, meta)], [*three, three[0]], strict=True):
        assert found.meta() == stored.meta()
        assert found.arrays().keys() == stored.arrays().keys()
        np.testing.assert_array_equal(found.output_end, stored.output_end)
        np.testing.assert_array_equal(found.input, stored.input)


def test_the_trace_of_one_episode_is_none():
    arrays, meta = decode(encode(episode(1.0).arrays(), episode(1.0).meta()))
    assert RangeTrace.from_arrays(arrays, meta) is None
