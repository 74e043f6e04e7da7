import numpy as np
import pytest
from report_studies import other_study

from chargetune.battery.charging.evaluate import evaluate
from chargetune.report import read_study
from chargetune.report.best_possible import best_possible
from chargetune.report.sensitivity import STEP, again, finite_differences, importance, rank_correlations


@pytest.fixture(scope="module")
def view(stores):
    return read_study(stores["mixed"], "charge")


def test_finite_differences_are_changes_of_the_score(view):
    calls = []
    found = {s.entry: s for s in finite_differences(view, view.tuned, lambda: calls.append(1))}
    assert list(found) == list(view.space.entries)
    assert len(calls) == view.space.dimension
    entry = "R1_ratio[2]"
    i = view.space.entries.index(entry)
    theta = np.array(view.tuned.theta)
    # On the logarithmic scale of a ratio 2 % of the range is a factor.
    theta[i] *= (6.0 / 0.1) ** STEP
    score, _, _ = evaluate(view.problem, theta, view.tuned.seed)
    assert found[entry].objective[1] == pytest.approx(score.objective - view.tuned.score.objective, abs=1e-9)
    assert found[entry].excess[1] == pytest.approx(max(score.excess.values()) - max(view.tuned.score.excess.values()), abs=1e-9)


def test_a_step_beyond_a_bound_is_left_out(view):
    # The untuned backoff of zero is not at a bound, the trial made here is.
    from dataclasses import replace

    theta = np.array(view.tuned.theta)
    theta[0] = view.space.lower[0]
    first = finite_differences(view, replace(view.tuned, theta=tuple(theta)))[0]
    assert first.objective[0] is None
    assert first.objective[1] is not None


def test_another_system_cannot_be_evaluated(tmp_path):
    view = read_study(other_study(tmp_path / "o.sqlite", "crane"), "crane")
    with pytest.raises(ValueError, match="not one of battery charging"):
        finite_differences(view, view.trials[0])


def test_evaluated_again_gives_the_same(view):
    assert again(view, view.tuned) < 1e-9
    assert again(view, view.trials[6]) is None


def test_rank_correlation_by_hand(tmp_path):
    view = read_study(other_study(tmp_path / "o.sqlite", "crane"), "crane")
    scored = [t for t in view.trials if t.score is not None]
    ranks = rank_correlations(view)
    for i, entry in enumerate(("gain", "shift")):
        x = np.argsort(np.argsort([t.theta[i] for t in scored], kind="stable"), kind="stable")
        y = np.argsort(np.argsort([t.score.objective for t in scored]))
        # Spearman's formula for ranks without ties.
        n = len(scored)
        assert ranks[entry][0] == pytest.approx(1 - 6 * np.sum((x - y) ** 2) / (n * (n**2 - 1)), abs=1e-12)
    assert ranks["gain"][1] == pytest.approx(ranks["gain"][0]), "here the excess falls as the objective does"


def test_too_few_trials_have_no_correlation(stores):
    assert rank_correlations(read_study(stores["mixed"], "charge", trials=7)) == {}


def test_importance_is_what_putting_back_loses(view):
    found = {one.entry: one for one in importance(view, view.tuned)}
    assert set(found) == {*view.space.entries, "backoff_V[all]", "R0_ratio[all]", "R1_ratio[all]"}
    theta = np.array(view.tuned.theta)
    theta[view.space.slices["R1_ratio"]] = 1.0
    score, _, _ = evaluate(view.problem, theta, view.tuned.seed)
    assert found["R1_ratio[all]"].lost == pytest.approx(view.tuned.score.objective - score.objective, abs=1e-9)
    sizes = [abs(one.lost) for one in importance(view, view.tuned)]
    assert sizes == sorted(sizes, reverse=True)


def test_nothing_is_better_than_the_best_possible(view, tmp_path):
    possible = best_possible(view)
    kept = [-t.score.objective for t in view.trials if t.score is not None and t.feasible]
    assert len(kept) > 1
    assert 0 < possible <= min(kept) + 1e-9
    assert best_possible(read_study(other_study(tmp_path / "o.sqlite", "crane"), "crane")) is None
