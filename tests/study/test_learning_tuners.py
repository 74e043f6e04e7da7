import pytest
from study_toy import Toy, essence, open_study

from chargetune.learning import ConstrainedLogEI, ExpectedImprovement, Sobol
from chargetune.study.store.store import Store


# Deprecations inside of linear_operator when candidates are drawn jointly; no matter of the study.
@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("tuner", [Sobol(1), ExpectedImprovement(1, n_initial=4), ConstrainedLogEI(1, n_initial=4)])
def test_interrupted_learning_ends_with_the_trials_of_an_uninterrupted_one(store, tmp_path, tuner):
    with Store(tmp_path / "whole.db") as other, open_study(other, tuner=tuner, batch=2) as study:
        study.run(Toy(), 9)
        wanted = essence(study.trials())

    calls = []

    def interrupted(theta, seed):
        calls.append(seed)
        if len(calls) == 8:
            raise KeyboardInterrupt
        return Toy()(theta, seed)

    with open_study(store, tuner=tuner, batch=2) as study, pytest.raises(KeyboardInterrupt):
        study.run(interrupted, 9)
    with open_study(store, tuner=tuner, batch=2) as study:
        assert len(study.running()) == 1
        study.run(interrupted, 9)
        assert essence(study.trials()) == wanted
        assert len({e[1] for e in wanted}) == 9
