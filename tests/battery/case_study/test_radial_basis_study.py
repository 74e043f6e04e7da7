"""What `chargetune reproduce rbf` says of its rows."""

import numpy as np
import pytest

from chargetune.battery.case_study.configurations import case_study
from chargetune.battery.case_study.radial_basis import by_way, decide_claims, oracle, safe_study
from chargetune.battery.charging.evaluate import evaluate

pytestmark = pytest.mark.usefixtures("virtual_machine")


def figures(mV, t80=None, t95=None):
    return {"overshoot_mV": mV, "t80_min": t80, "t95_min": t95}


def row(tuned, violating, twin, twin_violating):
    return {
        "untuned": figures(60.0, 24.0, 36.0),
        "offset_free": figures(-4.0, 24.1, 37.0),
        "cautious": figures(-90.0),
        "tuned": tuned,
        "violating_trials": violating,
        "trials": 40,
        "safe_twin": twin,
        "safe_twin_violating": twin_violating,
        "safe_twin_trials": 5,
        "oracle": figures(0.0, 23.4, 36.2),
    }


ROWS = [row(figures(0.2, 28.0, 44.0), 20, figures(0.1, 27.0, 42.0), 0), row(None, 35, figures(1.5, 27.5), 1)]


def test_claims_by_hand():
    assert [claim["holds"] for claim in decide_claims(ROWS)] == [1, 0, 1, 1, 1, 2]
    assert all(claim["of"] == 2 for claim in decide_claims(ROWS))


def test_ways_by_hand():
    ways = {way["name"]: way for way in by_way(ROWS, "default")}
    assert ways["untuned"]["safe"] == 0
    assert (ways["weights, default"]["safe"], ways["weights, default"]["violating_trials"]) == (1, 55)
    assert ways["weights, default"]["t80_min_median"] is None
    twin = ways["weights, safe twin"]
    assert (twin["safe"], twin["worst_mV"], twin["t80_min_median"], twin["t95_min_median"]) == (1, 1.5, 27.25, None)


def test_the_twin_begins_with_a_cost_that_keeps_the_limit_on_twenty_seeds():
    worst = []
    for seed in range(20):
        problem = safe_study(seed).problem()
        score, _, _ = evaluate(problem, problem.safe_start, 0)
        worst.append(score.metrics["overshoot_mV"])
    assert max(worst) < -10


def test_both_learn_the_same_weights():
    one, other = case_study("rbf", 3).problem(), safe_study(3).problem()
    assert one.space == other.space
    assert one.space.dimension == 16
    assert np.isfinite(oracle(one)["t95_min"])
