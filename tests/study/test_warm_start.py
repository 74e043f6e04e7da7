"""A new study that begins with the trials of earlier ones."""

from dataclasses import dataclass, field

import numpy as np
import pytest
from sqlalchemy import text
from study_toy import SPACE, Halfway, Toy, essence, open_study

from chargetune.learning import ConstrainedLogEI
from chargetune.model.parameter_space import ParameterSpace
from chargetune.study.store.store import Store, StoreError
from chargetune.study.study import StudyError
from chargetune.study.warm_start import Earlier


@dataclass(frozen=True)
class Watching:
    """Remembers what it was given."""

    seen: list = field(default_factory=list, compare=False, repr=False)

    def ask(self, space, trials, n=1):
        self.seen.append([(t.number, t.theta, t.status, t.score) for t in trials])
        return Halfway().ask(space, trials, n)


@pytest.fixture
def old(tmp_path):
    with Store(tmp_path / "old.db") as store:
        for name, seed in (("a", 1), ("b", 2)):
            with open_study(store, name, seed=seed, tuner=Halfway(seed)) as study:
                study.run(Toy(), 5)
                study.ask()
        yield store


def test_the_tuner_gets_them_before_the_studys_own(old, location):
    with Store(location) as store:
        tuner = Watching()
        with open_study(store, tuner=tuner, earlier=[Earlier(old.location, "b"), Earlier(old.location, "a")]) as study:
            study.run(Toy(), 3)
            own = study.trials()
            assert [t.number for t in own] == [0, 1, 2]
            assert study.best() in [*own, None]
        before = [(t.theta, t.status, t.score) for n in (2, 1) for t in old.trials(n)[:5]]
        assert [s[1:] for s in tuner.seen[0]] == before
        assert [s[0] for s in tuner.seen[0]] == list(range(-10, 0))
        assert [s[0] for s in tuner.seen[2]] == list(range(-10, 2))
        found = store.earlier(1)
        assert found[5].provenance["origin"] == {"store": old.label, "study": "a", "number": 0}
        for trial, source in zip(found, [*old.trials(2)[:5], *old.trials(1)[:5]], strict=True):
            assert (trial.trace_sha256, trial.attempt, trial.told_at) == (source.trace_sha256, source.attempt, source.told_at)
            assert (store.trace(1, trial.number) is None) == (trial.trace_sha256 is None)
        assert store.studies()[0].trial_count == 3
        with pytest.raises(StoreError, match="no trial -1 in this study"):
            store.finish_trial(1, -1, score=found[-1].score, ending="done", trace=None, provenance={})


def test_resume_needs_the_old_store_no_more_and_gives_the_same_trials(old, tmp_path):
    earlier = [Earlier(old.location, "a")]
    with Store(tmp_path / "whole.db") as store, open_study(store, earlier=earlier) as study:
        study.run(Toy(), 6)
        wanted = essence(study.trials())
    with Store(tmp_path / "new.db") as store:
        with open_study(store, earlier=earlier) as study:
            study.run(Toy(), 3)
        old.close()
        (tmp_path / "old.db").unlink()
        with open_study(store, earlier=earlier) as study:
            study.run(Toy(), 6)
            assert essence(study.trials()) == wanted
        for other in ([], [Earlier(old.location, "b")]):
            with pytest.raises(StudyError, match="earlier"):
                open_study(store, earlier=other)


def test_a_learning_tuner_needs_no_initial_design(old, tmp_path):
    tuner = ConstrainedLogEI(1, n_initial=5)
    with Store(tmp_path / "warm.db") as store, open_study(store, tuner=tuner, earlier=[Earlier(old.location, "a")]) as study:
        (first,) = study.ask()
    with Store(tmp_path / "cold.db") as store, open_study(store, tuner=tuner) as study:
        (default,) = study.ask()
    assert default.theta == tuple(SPACE.default)
    assert first.theta != default.theta


@pytest.mark.parametrize(
    ("earlier", "space", "message"),
    [
        (("old.db", "c"), SPACE, "no study 'c'; there are: a, b"),
        (("none.db", "a"), SPACE, "none.db: no such store"),
        (("old.db", "a"), ParameterSpace(SPACE.parameters[:1]), r"the earlier study 'a' tunes x \(1 x 1\), r \(1 x 1\), allowed is x"),
        (
            ("old.db", "a"),
            ParameterSpace((SPACE.parameters[0].__class__("x", 0.0, 0.1, 0.05), SPACE.parameters[1])),
            "trial .* x = .* allowed",
        ),
    ],
)
def test_what_does_not_fit_is_refused_before_the_study_is_begun(old, tmp_path, earlier, space, message):
    with Store(tmp_path / "new.db") as store:
        with pytest.raises((StoreError, StudyError), match=message):
            open_study(store, space=space, earlier=[Earlier(tmp_path / earlier[0], earlier[1])])
        assert store.studies() == []


def test_a_damaged_trace_is_left_behind(old, tmp_path):
    number = next(t.number for t in old.trials(1) if t.trace_sha256)
    with old._engine.execution_options(writing=True).begin() as connection:
        connection.execute(text("UPDATE trace SET data = x'00' WHERE study_id = 1 AND number = :n"), {"n": number})
    with Store(tmp_path / "new.db") as store, open_study(store, earlier=[Earlier(old.location, "a")]) as study:
        found = store.earlier(study.record.id)
        assert found[number].trace_sha256 is None
        assert found[number].score == old.trials(1)[number].score
        study.run(Toy(), 2)
        assert np.isfinite(study.trials()[-1].score.objective)
