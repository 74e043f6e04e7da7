"""Work on all cores gives what one core gives, in its order."""

import os
import threading

import pytest

from chargetune.episode.cores import each, usable_cores


def test_results_are_in_order_and_come_from_as_many_threads_as_there_are_cores():
    assert 1 <= usable_cores() <= (os.cpu_count() or 1)
    assert each(lambda a, b: a - b, range(100), range(0, 200, 2)) == [-k for k in range(100)]
    together = threading.Barrier(usable_cores(), timeout=10)
    # Passes only when that many are at work at once.
    assert len(each(lambda _: together.wait(), range(usable_cores()))) == usable_cores()


def test_an_exception_comes_out():
    def refuse(k):
        if k == 3:
            raise ValueError("three")
        return k

    with pytest.raises(ValueError, match="three"):
        each(refuse, range(10))
