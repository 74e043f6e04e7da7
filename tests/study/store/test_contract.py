"""What a store promises, on every kind of database below it."""

import itertools
import multiprocessing
import os
import signal
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from sqlalchemy import Engine, event, text
from study_toy import CONFIG, Toy, ToyEpisode, essence, open_study, told_by_another_process

from chargetune.episode.score import Score
from chargetune.study.store.store import Store, StoreError
from chargetune.study.store.trace import encode
from chargetune.study.study import StudyError
from chargetune.study.trial import Trial, TrialStatus

FORK = multiprocessing.get_context("fork")
SCORE = Score(-1.0, -1.5, {"v": 0.1}, {"v": 0.0}, {"t80_min": None})
TRACE = encode({"v": np.arange(5.0)}, {"units": {"v": "V"}, "sampling_time_s": 10.0})


def a_study(store, trials=2, name="a", **how):
    record = store.add_study(name, {"config": CONFIG}, **how)
    store.add_trials(record.id, [Trial(k, (0.1 * k, 1.0), seed=k, asked_at="t") for k in range(trials)])
    return record.id


def finish(store, study, number, score=SCORE, ending="done", trace=TRACE, **how):
    return store.finish_trial(study, number, score=score, ending=ending, trace=trace, provenance={"by": "test"}, **how)


def change(store, statement):
    with store._engine.execution_options(writing=True).begin() as connection:
        if "postgresql" in store.location:
            connection.execute(text("SET LOCAL search_path TO chargetune"))
        result = connection.execute(text(statement))
        return result.scalar() if result.returns_rows else None


@pytest.fixture
def opened(location):
    with Store(location) as store:
        yield store


class TestContract:
    def test_what_is_told_is_read_back_after_reopening(self, opened):
        study = a_study(opened)
        finish(opened, study, 0)
        finish(opened, study, 1, score=None, ending="RuntimeError: x", trace=None)
        opened.close()
        with Store(opened.location, read_only=True) as again:
            assert [(r.name, r.trial_count, r.identity) for r in again.studies()] == [("a", 2, {"config": CONFIG})]
            done, failed = again.trials(study)
            assert (done.status, done.score, done.theta, done.ending, done.seed) == (TrialStatus.DONE, SCORE, (0.0, 1.0), "done", 0)
            assert (failed.status, failed.score, failed.ending, failed.trace_sha256) == (TrialStatus.FAILED, None, "RuntimeError: x", None)
            assert done.provenance == {"by": "test"}
            arrays, meta = again.trace(study, 0)
            np.testing.assert_array_equal(arrays["v"], np.arange(5.0))
            assert meta == {"units": {"v": "V"}, "sampling_time_s": 10.0}
            assert again.trace(study, 1) is None

    def test_units_and_sampling_time_lie_beside_the_trace(self, opened):
        finish(opened, a_study(opened), 0)
        with opened._engine.connect() as connection:
            prefix = "chargetune." if "postgresql" in opened.location else ""
            row = connection.execute(text(f"SELECT units, sampling_time_s FROM {prefix}trace")).one()  # noqa: S608
        assert tuple(row) == ('{"v":"V"}', 10.0)

    def test_studies_of_one_store_are_apart(self, opened):
        a, b = a_study(opened, 2, "a"), a_study(opened, 3, "b")
        finish(opened, b, 1)
        assert [t.status for t in opened.trials(a)] == ["running"] * 2
        assert [t.status for t in opened.trials(b)] == ["running", "done", "running"]
        with pytest.raises(StoreError, match="a study 'a' already"):
            a_study(opened, 1, "a")
        with pytest.raises(StoreError, match="no study 'c'; there are: a, b"):
            opened.study("c")

    def test_theta_and_score_keep_every_bit(self, opened):
        values = (0.1 + 0.2, 1e-308, -0.0, np.nextafter(1.0, 2.0))
        study = opened.add_study("a", {}).id
        opened.add_trials(study, [Trial(0, values, seed=2**53 - 1)])
        score = Score(values[0], values[3], {"v": values[1]}, {"v": values[2]})
        finish(opened, study, 0, score=score, ending="Größe µ 电池 \\ ' \" \n")
        (trial,) = opened.trials(study)
        assert [v.hex() for v in trial.theta] == [float(v).hex() for v in values]
        assert (trial.score, trial.seed, trial.ending) == (score, 2**53 - 1, "Größe µ 电池 \\ ' \" \n")

    def test_tell_twice(self, opened):
        study = a_study(opened)
        first = finish(opened, study, 0)
        assert finish(opened, study, 0) == first
        for other in ({"score": None}, {"ending": "other"}, {"trace": None}, {"score": Score(-1.0, -1.5, {}, {})}):
            with pytest.raises(StoreError, match="trial 0 is done already, with another result"):
                finish(opened, study, 0, **other)
        assert opened.trials(study)[0] == first
        with pytest.raises(StoreError, match="no trial 7"):
            finish(opened, study, 7)

    @pytest.mark.parametrize("numbers", [[0], [3], [2, 2], [2, 4], [3, 2]])
    def test_numbers_go_on_without_gaps_or_nothing_is_stored(self, opened, numbers):
        study = a_study(opened, 2)
        with pytest.raises(StoreError, match="do not follow the 2 stored"):
            opened.add_trials(study, [Trial(k, (0.0,)) for k in numbers])
        assert len(opened.trials(study)) == 2

    def test_damaged_trace_is_that_trials_trouble_only(self, opened):
        study = a_study(opened, 3)
        for number in range(3):
            finish(opened, study, number)
        other = encode({"v": np.arange(6.0)}, {}).hex()
        value = f"'\\x{other}'" if "postgresql" in opened.location else f"x'{other}'"
        change(opened, f"UPDATE trace SET data = {value} WHERE number = 0")  # noqa: S608
        change(opened, "DELETE FROM trace WHERE number = 1")
        for number, why in ((0, "its SHA-256 is not the stored one"), (1, "it is missing")):
            with pytest.raises(StoreError, match=f"trace of trial {number} is damaged \\({why}"):
                opened.trace(study, number)
        assert opened.trace(study, 2) is not None
        assert len(opened.trials(study)) == 3

    def test_newer_schema_is_refused(self, opened):
        change(opened, "UPDATE chargetune_store SET schema_version = 99")
        for read_only in (False, True):
            with pytest.raises(StoreError, match=r"schema version 99, this program knows version"):
                Store(opened.location, read_only=read_only)

    def test_read_only_reads_while_another_writes_and_changes_nothing(self, opened):
        study = a_study(opened)
        with Store(opened.location, read_only=True) as reader:
            finish(opened, study, 0)
            assert reader.trials(study)[0].status == "done"
            for do in (lambda: finish(reader, study, 1), lambda: reader.add_study("b", {}), lambda: open_study(reader)):
                with pytest.raises(StoreError, match="read-only"):
                    do()
        assert [r.name for r in opened.studies()] == ["a"]

    def test_long_lock_ends_in_a_message_that_names_the_holder(self, location):
        with Store(location, busy_timeout_s=0.2) as store, open_study(store) as study, Store(location) as other:
            trial = study.ask()[0]
            with other._engine.execution_options(writing=True).begin():
                start = time.monotonic()
                with pytest.raises(StoreError, match=rf"locked by another .* let go in time.*last holder: process {os.getpid()} on "):
                    study.tell(trial.number, SCORE)
                assert 0.1 < time.monotonic() - start < 5
            assert study.tell(trial.number, SCORE).status == "done"

    def test_nothing_of_an_interrupted_transaction_stays(self, opened):
        study = a_study(opened)

        def stop(_connection, _cursor, sql, *_):
            if sql.startswith("UPDATE"):
                raise KeyboardInterrupt

        event.listen(Engine, "before_cursor_execute", stop)
        try:
            with pytest.raises(KeyboardInterrupt):
                finish(opened, study, 0)
        finally:
            event.remove(Engine, "before_cursor_execute", stop)
        assert opened.trials(study)[0].status == "running"
        assert change(opened, "SELECT count(*) FROM trace") == 0
        assert finish(opened, study, 0).status == "done"
        assert opened.trace(study, 0) is not None

    def test_writers_at_the_same_time_wait_for_each_other(self, opened):
        study = a_study(opened, 0)
        failures = []

        def write(name):
            try:
                with Store(opened.location) as store:
                    for _ in range(8):
                        a_study(store, 1, f"{name} {time.monotonic_ns()}")
                        for _attempt in range(50):
                            try:
                                store.add_trials(study, [Trial(len(store.trials(study)), (0.5,), provenance={"by": name})])
                                break
                            except StoreError:
                                continue
            except Exception as error:  # noqa: BLE001 - a thread must not swallow what fails in it
                failures.append(error)

        threads = [threading.Thread(target=write, args=(n,)) for n in ("x", "y", "z")]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert failures == []
        trials = opened.trials(study)
        assert [t.number for t in trials] == list(range(24))
        assert sorted(t.provenance["by"] for t in trials) == ["x"] * 8 + ["y"] * 8 + ["z"] * 8
        assert len(opened.studies()) == 25

    def test_a_study_runs_and_resumes_as_on_any_store(self, opened, tmp_path):
        with open_study(opened, batch=2) as study:
            study.run(Toy(), 5)
        opened.close()
        with Store(opened.location) as store, open_study(store, batch=2) as study:
            study.run(Toy(), 9)
            found = essence(study.trials())
        with Store(tmp_path / "whole.db") as store, open_study(store, batch=2) as study:
            study.run(Toy(), 9)
            assert essence(study.trials()) == found

    def test_a_wall_clock_that_jumps_changes_nothing(self, opened, tmp_path, monkeypatch):
        jumps = itertools.cycle(["2031-01-01T00:00:00.000+00:00", "1999-12-31T23:59:59.999+00:00", "2026-06-01T12:00:00.000+00:00"])
        for module in ("store.store", "study"):
            monkeypatch.setattr(f"chargetune.study.{module}.utc_now", lambda: next(jumps))
        for trials in (3, 7):
            with open_study(opened, batch=2) as study:
                study.run(Toy(), trials)
        found = opened.trials(1)
        monkeypatch.undo()
        assert any(t.told_at < t.asked_at for t in found)
        with Store(tmp_path / "whole.db") as store, open_study(store, batch=2) as study:
            study.run(Toy(), 7)
            assert essence(study.trials()) == essence(found)
        with pytest.raises(StoreError, match="is done already, with another result"):
            finish(opened, 1, 0)

    def test_two_thousand_trials_are_listed_by_a_few_statements(self, opened):
        """Not by one for each trial; benchmarks/store.py has the seconds."""
        study = opened.add_study("a", {}).id
        theta = tuple(np.random.default_rng(0).random(16))
        opened.add_trials(study, [Trial(k, theta, provenance={"versions": {"numpy": "2.0"}}) for k in range(2000)])
        statements = []

        @event.listens_for(Engine, "before_cursor_execute")
        def note(_connection, _cursor, statement, *_):
            statements.append(statement)

        try:
            with Store(opened.location, read_only=True) as reader:
                assert len(reader.trials(study)) == 2000
        finally:
            event.remove(Engine, "before_cursor_execute", note)
        assert 1 <= len(statements) <= 20


class TestAttempts:
    def test_the_late_result_of_an_attempt_given_up_is_refused(self, opened):
        study = a_study(opened)
        running = opened.trials(study)
        (first,) = opened.hand_out(study, running[:1], "worker 1")
        assert first.attempt == 1
        (second,) = opened.hand_out(study, [first], "worker 2")
        assert second.attempt == 2
        with pytest.raises(StoreError, match="trial 0: attempt 1 was given up, its late result is refused; attempt 2 is with worker 2"):
            finish(opened, study, 0, attempt=1)
        assert opened.trials(study)[0] == second
        told = finish(opened, study, 0, attempt=2)
        assert (told.status, told.attempt) == ("done", 2)
        # The same result is no contradiction, whoever brings it; another one is.
        assert finish(opened, study, 0, attempt=1) == told
        with pytest.raises(StoreError, match="done already, with another result"):
            finish(opened, study, 0, attempt=1, ending="late")

    def test_two_who_read_the_same_trial_do_not_both_get_it(self, opened):
        study = a_study(opened, 3)
        read = opened.trials(study)
        opened.hand_out(study, read[1:2], "worker 1")
        with pytest.raises(StoreError, match=r"trial 1 was handed out to worker 1 at .* already"):
            opened.hand_out(study, read, "worker 2")
        assert [t.attempt for t in opened.trials(study)] == [0, 1, 0]  # all or none

    def test_what_is_told_is_not_handed_out(self, opened):
        study = a_study(opened)
        read = opened.trials(study)
        finish(opened, study, 0)
        with pytest.raises(StoreError, match="trial 0 is not running"):
            opened.hand_out(study, read, "w")
        with pytest.raises(StoreError, match="trial 7 is not running"):
            opened.hand_out(study, [replace(read[1], number=7)], "w")

    def test_on_hardware_a_trial_is_handed_out_once(self, opened):
        study = a_study(opened, hardware=True)
        (handed,) = opened.hand_out(study, opened.trials(study)[:1], "cycler 1")
        for again in (handed, replace(handed, attempt=0)):
            with pytest.raises(
                StoreError, match=r"trial 0 was handed out to cycler 1 at .*; on hardware that happens once\. Look at the cell"
            ):
                opened.hand_out(study, [again], "cycler 2")
        assert finish(opened, study, 0, score=None, ending="the operator: cable fell off").status == "failed"

    def test_a_study_on_hardware_never_repeats_a_trial_by_itself(self, opened):
        runs = []

        def plug_pulled(theta, seed):
            runs.append(seed)
            raise KeyboardInterrupt

        with open_study(opened, batch=3, hardware=True) as study, pytest.raises(KeyboardInterrupt):
            study.run(plug_pulled, 3)
        with pytest.raises(StudyError, match="hardware: true -> \\(absent\\)"):
            open_study(opened, batch=3)
        with open_study(opened, batch=3, hardware=True) as study:
            assert [t.attempt for t in study.trials()] == [1, 0, 0]
            with pytest.raises(StudyError, match=r"trials \[0\] were begun .* on hardware nothing is repeated"):
                study.run(plug_pulled, 3)
            assert len(runs) == 1
            study.fail(0, "the operator: not run to its end")
            study.run(Toy(), 3)
            assert [t.attempt for t in study.trials()] == [1, 1, 1]

    def test_a_simulation_is_evaluated_again(self, opened):
        def stop(theta, seed):
            raise KeyboardInterrupt

        for attempts in (1, 2):
            with open_study(opened) as study, pytest.raises(KeyboardInterrupt):
                study.run(stop, 1)
            assert [t.attempt for t in opened.trials(1)] == [attempts]
        with open_study(opened) as study:
            study.run(Toy(), 1)
            assert [(t.status, t.attempt) for t in study.trials()] == [("done", 3)]


class TestHolder:
    def test_whoever_held_the_study_before_writes_nothing(self, opened):
        before = open_study(opened)
        (trial,) = before.ask()
        # As after a lock that a network lost: both believe that they hold it.
        with Store(opened.location) as other, open_study(other) as now:
            for act in (
                before.ask,
                lambda: before.hand_out([trial]),
                lambda: before.tell(0, SCORE, ToyEpisode(np.arange(3.0))),
                lambda: before.fail(0, "lost"),
            ):
                with pytest.raises(StoreError, match=rf"taken over by process {os.getpid()} on .*; nothing is written on behalf"):
                    act()
            assert [t.status for t in now.trials()] == ["running"]
            now.tell(0, SCORE)
        before.close()

    def test_a_second_process_is_refused_until_the_first_is_dead(self, location):
        here, there = FORK.Pipe()
        process = FORK.Process(target=hold, args=(location, there))
        process.start()
        holder = here.recv()
        with Store(location) as store:
            with pytest.raises(StudyError, match=rf"study 'toy' is held by process {holder} on .* since "):
                open_study(store)
            open_study(store, "other").close()
            os.kill(process.pid, signal.SIGKILL)
            process.join()
            until = time.monotonic() + 10
            while True:  # a server notices within moments
                try:
                    open_study(store).close()
                    break
                except StudyError:
                    assert time.monotonic() < until
                    time.sleep(0.05)

    def test_a_process_may_hold_a_study_several_times(self, location):
        with Store(location) as store:
            one, other = open_study(store), open_study(store)
            one.close()
            assert not free_for_others(location)
            other.close()
            other.close()
            assert free_for_others(location)


def hold(location, connection):
    with Store(location) as store, open_study(store):
        connection.send(os.getpid())
        connection.recv()


def try_hold(location, connection):
    with Store(location) as store:
        try:
            open_study(store).close()
        except StudyError:
            connection.send(False)
        else:
            connection.send(True)


def free_for_others(location):
    return told_by_another_process(try_hold, location)


class TestMark:
    def test_it_differs_after_every_change(self, opened):
        def mark():
            found, settled = opened.database.mark()
            return found if settled else object()  # what is not settled is not compared

        seen = [mark()]
        study = a_study(opened)
        seen.append(mark())
        opened.hand_out(study, opened.trials(study)[:1], "w")
        seen.append(mark())
        finish(opened, study, 0)
        seen.append(mark())
        finish(opened, study, 1, score=None, trace=None)
        seen.append(mark())
        opened.change_study(study, {"config": {}})
        seen.append(mark())
        opened.add_study("b", {})
        seen.append(mark())
        assert len({repr(m) for m in seen}) == len(seen)
