"""A study under any sequence of ask, hand out, tell, fail, crash, take-over and resume, against a plain list."""

import itertools
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule, run_state_machine_as_test
from sqlalchemy import event
from study_toy import Toy, ToyEpisode, open_study

from chargetune.episode.score import Score
from chargetune.study.evaluation import evaluate_trial
from chargetune.study.store.store import Store, StoreError
from chargetune.study.store.trace import decode, encode
from chargetune.study.study import StudyError

SCORES = st.builds(
    lambda value, excess: Score(value, value - max(0.0, excess), {"v": excess}, {"v": 0.0}), st.floats(-9, 9), st.floats(-1, 1)
)
EPISODES = st.none() | st.lists(st.floats(), max_size=4).map(lambda v: ToyEpisode(np.array(v)))
WHICH = st.integers(0, 1000)
names = (f"study {k}" for k in itertools.count())


class Crash(BaseException):
    """The process ends here."""


@dataclass
class Entry:
    """What the list remembers of a trial."""

    theta: tuple
    seed: int
    attempt: int = 0
    result: tuple | None = None  # (score or None, ending, encoded trace or None)


class States(RuleBasedStateMachine):
    def __init__(self, location):
        super().__init__()
        self.location = location

    @initialize(batch=st.integers(1, 3), hardware=st.booleans())
    def begin(self, batch, hardware):
        self.how = {"name": next(names), "batch": batch, "hardware": hardware}
        self.list = []
        self.store = self.study = None
        self.open()

    def open(self):
        if self.store is not None:
            # Neither study nor store is closed: what is stored is all that a dead process leaves.
            self.store._engine.dispose()
        self.store = Store(self.location)
        self.study = open_study(self.store, **self.how)

    def teardown(self):
        if getattr(self, "study", None) is not None:
            self.study.close()
            self.store.close()

    def running(self):
        return [k for k, entry in enumerate(self.list) if entry.result is None]

    def told(self):
        return [k for k, entry in enumerate(self.list) if entry.result is not None]

    @rule(n=st.integers(1, 3))
    def ask(self, n):
        trials = self.study.ask(n)
        assert [t.number for t in trials] == list(range(len(self.list), len(self.list) + n))
        self.list += [Entry(t.theta, t.seed) for t in trials]

    @precondition(lambda self: self.running())
    @rule(which=WHICH, times=st.integers(1, 3))
    def hand_out(self, which, times):
        number = self.running()[which % len(self.running())]
        entry = self.list[number]
        for _ in range(times):
            trial = self.study.trials()[number]
            if self.how["hardware"] and entry.attempt:
                with pytest.raises(StoreError, match="on hardware that happens once"):
                    self.study.hand_out([trial])
                return
            (handed,) = self.study.hand_out([trial])
            entry.attempt += 1
            assert (handed.number, handed.attempt) == (number, entry.attempt)
            with pytest.raises(StoreError, match="was given up, its late result is refused"):
                self.study.fail(number, "late", attempt=entry.attempt - 1)

    @precondition(lambda self: self.running())
    @rule(which=WHICH, score=SCORES | st.none(), episode=EPISODES, named=st.booleans())
    def finish(self, which, score, episode, named):
        number = self.running()[which % len(self.running())]
        trace = None if episode is None else encode(episode.arrays(), episode.meta())
        self.list[number].result = (score, "done" if score else "lost", trace)
        self.say(number, attempt=self.list[number].attempt if named else None)

    def say(self, number, **how):
        score, ending, trace = self.list[number].result
        return self.study.finish(number, score, trace, ending, **how)

    @precondition(lambda self: self.told())
    @rule(which=WHICH)
    def repeat_and_contradict(self, which):
        number = self.told()[which % len(self.told())]
        before = self.study.trials()[number]
        assert self.say(number) == before
        with pytest.raises(StoreError, match="another result"):
            self.study.fail(number, "no, it was like this")
        with pytest.raises(StoreError, match="is not running"):
            self.study.hand_out([before])

    @rule(unknown=st.integers(0, 3))
    def tell_what_was_not_asked(self, unknown):
        with pytest.raises(StoreError, match="no trial"):
            self.study.fail(len(self.list) + unknown, "why")

    @rule()
    def crash_and_resume(self):
        self.open()

    @rule(statement=st.integers(0, 12), act=st.sampled_from(["ask", "hand_out", "finish"]), which=WHICH)
    def crash_inside_a_transaction(self, statement, act, which):
        """Nothing of what was not finished stays; what was finished stays whole."""
        count = itertools.count()

        def stop(*_):
            if next(count) == statement:
                raise Crash

        event.listen(self.store._engine, "before_cursor_execute", stop)
        event.listen(self.store._engine, "commit", stop)
        try:
            if act == "ask":
                self.ask(2)
            elif self.running() and act == "hand_out":
                self.hand_out(which, 1)
            elif self.running():
                number = self.running()[which % len(self.running())]
                self.study.finish(number, None, encode({"v": np.arange(3.0)}, {}), "crash")
                self.list[number].result = (None, "crash", encode({"v": np.arange(3.0)}, {}))
        except Crash:
            pass
        finally:
            event.remove(self.store._engine, "before_cursor_execute", stop)
            event.remove(self.store._engine, "commit", stop)
        self.open()

    @rule()
    def taken_over(self):
        """As after a lock that a network lost: both believe that they hold the study."""
        before, store = self.study, self.store
        self.store = None
        self.open()
        for act in (before.ask, lambda: before.fail(len(self.list) - 1, "lost")):
            with pytest.raises(StoreError, match="was taken over by process"):
                act()
        before.close()
        store.close()

    @rule()
    def other_config(self):
        with pytest.raises(StudyError, match=r"config\.a: "):
            open_study(self.store, **self.how, config={"a": 1})

    @precondition(lambda self: len(self.list) < 20)
    @rule(more=st.integers(0, 4))
    def run(self, more):
        limit = max(1, len(self.list) + more)
        begun = [k for k in self.running() if self.list[k].attempt]
        if self.how["hardware"] and begun:
            with pytest.raises(StudyError, match="on hardware nothing is repeated"):
                self.study.run(Toy(), limit)
            return
        self.study.run(Toy(), limit)
        trials = self.study.trials()
        assert len(trials) == limit
        self.list += [Entry(t.theta, t.seed) for t in trials[len(self.list) :]]
        for entry in self.list:
            if entry.result is None:
                entry.attempt += 1
                outcome = evaluate_trial(Toy(), entry.theta, entry.seed)
                entry.result = (outcome.score, outcome.ending, outcome.trace)

    @invariant()
    def store_agrees(self):
        if getattr(self, "study", None) is None:
            return
        trials = self.study.trials()
        assert [(t.number, t.theta, t.seed, t.attempt) for t in trials] == [
            (k, entry.theta, entry.seed, entry.attempt) for k, entry in enumerate(self.list)
        ]
        assert [t.number for t in self.study.running()] == self.running()
        for trial, entry in zip(trials, self.list, strict=True):
            score, ending, _ = entry.result or (None, None, None)
            assert (trial.score, trial.ending) == (score, ending)
            assert trial.status == ("running" if entry.result is None else "done" if score else "failed")
        objectives = [t.score.objective for t in trials if t.feasible]
        best = self.study.best()
        assert (best.score.objective if best else None) == max(objectives, default=None)
        if trials:
            self.trace_agrees(len(trials) // 2)
            self.trace_agrees(len(trials) - 1)

    def trace_agrees(self, number):
        stored, entry = self.study.trace(number), self.list[number]
        wanted = None if entry.result is None or entry.result[2] is None else decode(entry.result[2])
        assert (stored is None) == (wanted is None)
        if stored is not None:
            assert stored[1] == wanted[1]
            for name, values in wanted[0].items():
                np.testing.assert_array_equal(stored[0][name], values)


def test_any_sequence(location):
    # Both kinds of store have one text of SQL, and a server takes five times as long to connect to as a file to open.
    examples = 4 if location.startswith("postgres") else 10
    run_state_machine_as_test(lambda: States(location), settings=settings(max_examples=examples, stateful_step_count=20, deadline=None))
