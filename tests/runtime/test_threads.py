"""Work on all cores gives what one core gives, in its order."""

import multiprocessing
import os
import threading
from concurrent.futures import ProcessPoolExecutor

import pytest

from chargetune.runtime.threads import parallel_map, submit, usable_cores


def test_results_are_in_order_and_come_from_as_many_threads_as_there_are_cores():
    assert 1 <= usable_cores() <= (os.cpu_count() or 1)
    assert parallel_map(lambda a, b: a - b, range(100), range(0, 200, 2)) == [-k for k in range(100)]
    together = threading.Barrier(usable_cores(), timeout=10)
    # Passes only when that many are at work at once.
    assert len(parallel_map(lambda _: together.wait(), range(usable_cores()))) == usable_cores()


def test_an_exception_comes_out():
    def refuse(k):
        if k == 3:
            raise ValueError("three")
        return k

    with pytest.raises(ValueError, match="three"):
        parallel_map(refuse, range(10))


def test_within_one_of_its_threads_it_goes_on_there():
    assert parallel_map(lambda k: parallel_map(lambda n: n * k, range(3)), range(2 * usable_cores())) == [
        [0, k, 2 * k] for k in range(2 * usable_cores())
    ]


def test_what_goes_on_meanwhile_has_begun_and_says_how_it_ended():
    begun, more = threading.Event(), threading.Event()

    def work(value):
        begun.set()
        assert more.wait(timeout=10)
        return 7 // value

    good = submit(work, 2)
    assert begun.wait(timeout=10)
    assert not good.done()
    bad = submit(work, 0)
    more.set()
    assert good.result(timeout=10) == 3
    with pytest.raises(ZeroDivisionError):
        bad.result(timeout=10)


def test_meanwhile_within_one_of_its_threads_does_not_wait_for_another():
    """As many as there are threads: none of them is left to begin anything."""
    together = threading.Barrier(usable_cores(), timeout=10)

    def work(value):
        together.wait()
        done = submit(lambda: 6 // value)
        return done.result(timeout=10) if value else type(done.exception())

    assert parallel_map(work, range(usable_cores())) == [ZeroDivisionError, *(6 // k for k in range(1, usable_cores()))]


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
def test_a_forked_process_has_threads_of_its_own():
    parallel_map(abs, range(4))
    with ProcessPoolExecutor(1, multiprocessing.get_context("fork")) as pool:
        assert pool.submit(parallel_map, abs, range(-4, 0)).result(timeout=60) == [4, 3, 2, 1]
