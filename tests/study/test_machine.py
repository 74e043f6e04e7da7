"""A study under any sequence of ask, tell, fail, crash and resume, against a plain dictionary."""

import shutil
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import Bundle, RuleBasedStateMachine, consumes, initialize, invariant, multiple, precondition, rule
from study_toy import Toy, ToyEpisode, essence, open_study

from chargetune.episode.score import Score
from chargetune.study.store import Store, StoreError
from chargetune.study.study import StudyError

SCORES = st.builds(
    lambda value, excess: Score(value, value - max(0.0, excess), {"v": excess}, {"v": 0.0}), st.floats(-9, 9), st.floats(-1, 1)
)
EPISODES = st.none() | st.lists(st.floats(), max_size=4).map(lambda v: ToyEpisode(np.array(v)))


class Life(RuleBasedStateMachine):
    pending = Bundle("pending")
    told = Bundle("told")

    @initialize(batch=st.integers(1, 3))
    def begin(self, batch):
        self.folder = Path(tempfile.mkdtemp())
        self.batch = batch
        self.asked, self.results = {}, {}
        self.open()

    def open(self):
        self.store = Store(self.folder / "s.db")
        self.study = open_study(self.store, batch=self.batch)

    def teardown(self):
        if hasattr(self, "folder"):
            self.study.close()
            self.store.close()
            shutil.rmtree(self.folder)

    @rule(target=pending, n=st.integers(1, 3))
    def ask(self, n):
        trials = self.study.ask(n)
        assert [t.number for t in trials] == list(range(len(self.asked), len(self.asked) + n))
        self.asked |= {t.number: (t.theta, t.seed) for t in trials}
        return multiple(*(t.number for t in trials))

    @rule(target=told, number=consumes(pending), score=SCORES | st.none(), episode=EPISODES)
    def finish(self, number, score, episode):
        if number in self.results:
            return number  # told by `run`
        self.results[number] = (score, episode)
        self.say(number)
        return number

    def say(self, number):
        score, episode = self.results[number]
        return self.study.fail(number, "lost", episode) if score is None else self.study.tell(number, score, episode)

    @rule(number=told)
    def repeat(self, number):
        if self.results[number] != "run":
            before = self.study.trials()[number]
            assert self.say(number) == before

    @rule(number=told)
    def contradict(self, number):
        with pytest.raises(StoreError, match="another result"):
            self.study.fail(number, "no, it was like this")

    @rule(unknown=st.integers(0, 3))
    def tell_what_was_not_asked(self, unknown):
        with pytest.raises(StoreError, match="no trial"):
            self.study.fail(len(self.asked) + unknown, "why")

    @rule()
    def crash_and_resume(self):
        # Neither the study nor the store is closed: the file is all that a dead process leaves.
        old = self.store
        self.open()
        old._engine.dispose()

    @rule()
    def other_config(self):
        with pytest.raises(StudyError, match=r"config\.a: "):
            open_study(self.store, batch=self.batch, config={"a": 1})

    @precondition(lambda self: len(self.asked) < 20)
    @rule(more=st.integers(0, 4))
    def run(self, more):
        limit = max(1, len(self.asked) + more)
        self.study.run(Toy(), limit)
        trials = self.study.trials()
        assert len(trials) == max(limit, len(self.asked))
        for trial in trials:
            self.asked.setdefault(trial.number, (trial.theta, trial.seed))
            self.results.setdefault(trial.number, "run")

    @invariant()
    def store_agrees(self):
        if not hasattr(self, "folder"):
            return
        trials = self.study.trials()
        assert {t.number: (t.theta, t.seed) for t in trials} == self.asked
        assert {t.number for t in trials if t.status != "running"} == set(self.results)
        assert self.study.running() == [t for t in trials if t.number not in self.results]
        scored = [t for t in trials if t.score is not None and t.score.feasible]
        best = self.study.best()
        assert (best is None) == (not scored)
        assert best is None or best.score.objective == max(t.score.objective for t in scored)
        for number, result in self.results.items():
            if result != "run":
                score, episode = result
                assert trials[number].score == score
                assert (self.study.trace(number) is None) == (episode is None)
        assert len(essence(trials)) == len(self.asked)


TestLife = Life.TestCase
TestLife.settings = settings(max_examples=15, stateful_step_count=20, deadline=None)
