import os
import shutil
import time

import pytest
from report_studies import charging, run_charging

from chargetune.study.store.store import Store, StoreError
from chargetune.study.trial import Trial
from chargetune.web.watch import StoreWatch


@pytest.fixture
def path(tmp_path):
    return run_charging(tmp_path / "s.sqlite", charging())


def settle(path):
    """As if the last change were a minute ago."""
    then = time.time() - 60
    for file in path.parent.glob(path.name + "*"):
        os.utime(file, (then, then))


def test_an_unchanged_store_is_read_once(path):
    watch = StoreWatch(path)
    settle(path)
    assert watch.study(1) is watch.study(1)
    assert watch.studies()[0] is watch.studies()[0]
    assert watch.study(2) is None


def test_every_change_is_seen_at_once_however_fast(path):
    watch = StoreWatch(path)
    settle(path)
    with Store(path) as opened:
        for number in range(10, 40):
            before = watch.study(1)
            opened.add_trials(1, [Trial(number, before.trials[0].theta)])
            assert len(watch.study(1).trials) == number + 1


def test_a_store_may_go_and_come_back(path, tmp_path):
    watch = StoreWatch(path)
    settle(path)
    watch.studies()
    shutil.move(path, tmp_path / "away")
    with pytest.raises(StoreError, match="no such store"):
        watch.studies()
    shutil.move(tmp_path / "away", path)
    assert len(watch.studies()) == 1


def test_a_store_on_a_server_is_watched_as_well(postgres):
    run_charging(postgres, charging())
    watch = StoreWatch(postgres)
    assert watch.study(1) is watch.study(1)
    with Store(postgres) as opened:
        for number in range(10, 13):
            before = watch.study(1)
            opened.add_trials(1, [Trial(number, before.trials[0].theta)])
            assert len(watch.study(1).trials) == number + 1
            opened.hand_out(1, opened.trials(1)[-1:], "w")
            assert watch.study(1).trials[-1].attempt == 1
