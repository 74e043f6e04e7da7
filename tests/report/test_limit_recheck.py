from dataclasses import replace

import numpy as np
import pytest

from chargetune.battery.case_study.configurations import case_study
from chargetune.battery.charging.evaluate import run_charge
from chargetune.battery.charging.verdict import score_episode
from chargetune.report import read_study
from chargetune.report.limit_recheck import recheck
from charging_problems import changed


@pytest.mark.parametrize("kind", ["mixed", "violating", "ei"])
def test_stored_scores_are_confirmed(stores, kind):
    view = read_study(stores[kind], "charge")
    for trial, episode in view.episodes(t for t in view.trials if t.score is not None):
        checks = {c.name: c for c in recheck(view.problem, episode, trial.score)}
        assert list(checks) == ["current_min_A", "current_max_A", "voltage_max_V", "voltage_min_V"]
        assert all(c.agrees for c in checks.values())
        assert all(checks[n].kept for n in trial.score.excess) == trial.feasible
        assert checks["current_max_A"].kept
        highest = max(v.max() for v in episode.signal("voltage_V"))
        assert checks["voltage_max_V"].reached == highest
        assert checks["voltage_max_V"].excess == pytest.approx(trial.score.excess["voltage_max_V"], abs=1e-12)
        start, end = episode.signal("voltage_V")
        at = checks["voltage_max_V"].at_s
        assert highest in (start[episode.time_s == at].tolist() + end[episode.time_s + 10 == at].tolist())


def test_noise_is_judged_as_the_score_judges_it():
    problem = changed(case_study("backoff", 0).problem(), steps=60, voltage_noise_sd_V=2e-3, verdict_samples=6)
    episode = run_charge(problem, None, seed=3)
    score = score_episode(problem, episode)
    check = next(c for c in recheck(problem, episode, score) if c.name == "voltage_max_V")
    assert check.agrees
    assert check.judged == "mean of 6 intervals"
    assert check.excess < max(v.max() for v in episode.signal("voltage_V")) - 4.2, "a mean is below the largest sample"
    true = max(v.max() for v in episode.signal("voltage_V", true=True))
    assert check.true_excess == pytest.approx(true - 4.2, abs=1e-12)


def test_disagreement_and_a_current_beyond_its_bound(stores):
    view = read_study(stores["mixed"], "charge")
    episode = view.episode(view.tuned)
    score = replace(view.tuned.score, excess={**view.tuned.score.excess, "voltage_min_V": -1.0})
    verdicts = {c.name: c.agrees for c in recheck(view.problem, episode, score)}
    assert verdicts == {"current_min_A": True, "current_max_A": True, "voltage_max_V": True, "voltage_min_V": False}
    more = replace(episode, input=episode.input + 0.5)
    assert next(c.name for c in recheck(view.problem, more, None) if not c.kept) == "current_max_A"
    assert recheck(view.problem, episode.cut(0, episode.ending, ""), None) == []
    assert np.isfinite([c.excess for c in recheck(view.problem, episode, None)]).all()


def test_a_lost_sample_hides_no_other():
    problem = changed(case_study("backoff", 0).problem(), steps=60, voltage_noise_sd_V=2e-3, verdict_samples=6)
    episode = run_charge(problem, None, seed=3)
    whole = {c.name: c for c in recheck(problem, episode, None)}
    episode.output_end[20, 0] = np.nan
    found = {c.name: c for c in recheck(problem, episode, None)}
    assert found["voltage_max_V"].excess == pytest.approx(whole["voltage_max_V"].excess, abs=2e-3)
    assert found["voltage_max_V"].kept == whole["voltage_max_V"].kept
    episode.output_start[:, 0] = episode.output_end[:, 0] = np.nan
    assert not any(c.kept for c in recheck(problem, episode, None) if c.name.startswith("voltage")), "nothing measured is nothing kept"
