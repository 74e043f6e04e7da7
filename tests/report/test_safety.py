"""What a report says of safe mode."""

import numpy as np
import pytest
from report_studies import Given

from chargetune.battery.charging.evaluate import Evaluation
from chargetune.battery.charging.settings import ControllerSettings, EpisodeSettings, SafetySettings
from chargetune.battery.charging.tunables import ResistanceRatio, Tunables
from chargetune.battery.charging.verdict import violation_mVs
from chargetune.battery.studies.study_file import Config, StudyTable
from chargetune.report import read_study, report_page
from chargetune.report.safety import predicted_probabilities, spent_mVs
from chargetune.study.store.store import Store
from chargetune.study.study import Study

pytestmark = pytest.mark.usefixtures("virtual_machine")


@pytest.fixture(scope="module")
def safe(tmp_path_factory):
    """A declared start that keeps the limit, then a theta far over it."""
    config = Config(
        study=StudyTable(name="safe", tuner="twin"),
        controller=ControllerSettings(mismatch_seed=0, horizon=3),
        episode=EpisodeSettings(steps=60),
        theta=Tunables(R0=ResistanceRatio(0.1, 4.0)),
        safety=SafetySettings(budget_mVs=500.0, start={"R0_ratio": 3.0}),
    )
    problem, path = config.problem(), tmp_path_factory.mktemp("safe") / "s.sqlite"
    start = problem.safe_start
    with (
        Store(path) as store,
        Study.create_or_resume(
            store, "safe", config=config.document(), space=problem.space, tuner=Given((tuple(start), tuple(0.2 * np.ones_like(start))))
        ) as study,
    ):
        study.run(Evaluation(problem), 2)
    return read_study(path, "safe")


def test_start_is_declared_and_the_budget_adds_up(safe):
    assert safe.start_label == "declared start"
    assert safe.start.number == 0
    first, second = predicted_probabilities(safe)
    assert first.probability is None
    assert second.probability < 0.5, "the twin of the first trial would not have let it pass"
    spent = spent_mVs(safe)
    assert spent[0] == 0
    # A limit ended it: what it spent is read from its trace.
    assert safe.trials[1].score is None
    assert spent[1] == pytest.approx(violation_mVs(safe.problem, safe.episode(safe.trials[1])))
    assert spent[1] > 0
    assert second.total == pytest.approx(sum(spent.values()))


def test_page_tells_it(safe):
    page = report_page(safe)
    assert "of a budget of 500 mV s" in page
    assert "<td>declared</td>" in page
    assert "; untuned:" not in page
