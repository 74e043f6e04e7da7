"""Built once a key, by one thread at a time; what is kept is had without waiting."""

import multiprocessing
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pytest

from chargetune.runtime.cache import Built, built_once


def test_threads_that_ask_at_once_get_one_and_the_same():
    kept, started, calls = Built(4), threading.Barrier(8), []

    def build():
        calls.append(threading.get_ident())
        time.sleep(0.05)
        return object()

    def ask(_):
        started.wait()
        return kept.get("key", build)

    with ThreadPoolExecutor(8) as threads:
        found = list(threads.map(ask, range(8)))
    assert len(set(map(id, found))) == 1
    assert len(calls) == 1


def test_one_builds_at_a_time_whatever_it_builds():
    inside, most = [], []

    @built_once(64)
    def build(number, kind):
        inside.append(number)
        most.append(len(inside))
        time.sleep(0.01)
        # Building one thing may need another.
        below = build(number - 1, kind) if number % 4 else 0
        inside.remove(number)
        return number + below

    with ThreadPoolExecutor(4) as threads:
        sums = list(threads.map(lambda number: build(number, number // 4), range(16)))
    assert sums == [sum(range(4 * (n // 4), n + 1)) for n in range(16)]
    # Never more than one thread's own chain of four.
    assert max(most) <= 4
    assert len(most) == 16


def test_what_is_kept_is_had_while_another_thread_builds():
    kept, building, go_on = Built(4), threading.Event(), threading.Event()
    kept.get("short", lambda: 1)

    def build():
        building.set()
        assert go_on.wait(10)
        return 2

    with ThreadPoolExecutor(1) as threads:
        long = threads.submit(kept.get, "long", build)
        assert building.wait(10)
        assert kept.get("short", lambda: 3) == 1
        assert not long.done()
        go_on.set()
        assert long.result() == 2


def test_the_one_not_asked_for_the_longest_goes_first():
    kept, made = Built(2), []

    def ask(key):
        return kept.get(key, lambda: made.append(key) or key)

    for key in ("a", "b", "a", "c", "a", "b"):
        assert ask(key) == key
    assert made == ["a", "b", "c", "b"]


def test_nothing_is_a_result_and_a_failure_is_none():
    kept, calls = Built(2), []
    for _ in range(2):
        assert kept.get("none", lambda: calls.append(0)) is None
    assert len(calls) == 1
    with pytest.raises(ZeroDivisionError):
        kept.get("bad", lambda: 1 / 0)
    assert kept.get("bad", lambda: 5) == 5


@pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="this system has no fork")
@pytest.mark.filterwarnings("ignore:.*multi-threaded.*:DeprecationWarning")
def test_a_fork_made_while_a_thread_builds_can_build():
    kept, building, go_on = Built(4), threading.Event(), threading.Event()

    def build():
        building.set()
        assert go_on.wait(30)

    with ThreadPoolExecutor(1) as threads:
        long = threads.submit(kept.get, "long", build)
        assert building.wait(10)
        child = multiprocessing.get_context("fork").Process(target=lambda: kept.get("other", int))
        child.start()
        child.join(10)
        alive = child.is_alive()
        child.kill()
        go_on.set()
        long.result()
    assert not alive
    assert child.exitcode == 0
