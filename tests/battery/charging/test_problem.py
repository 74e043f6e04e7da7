"""The charging problem: known figures of the case study, the score by hand, refusals, and its way to a worker."""

import math
import pickle
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context

import numpy as np
import pytest

from chargetune.battery.cell.cell import default_cell, mismatched
from chargetune.battery.charging.controller import controller_of
from chargetune.battery.charging.evaluate import Evaluation, evaluate, outcome, run_charge
from chargetune.battery.charging.tunables import Backoff, ResistanceRatio
from chargetune.battery.charging.verdict import charge_time, score_episode
from chargetune.episode.episode import Ending
from charging_problems import changed, charging_problem

pytestmark = pytest.mark.usefixtures("virtual_machine")

CELL = default_cell()
NAN, INF = math.nan, math.inf


def problem(**changes):
    return charging_problem(CELL, **changes)


def score_of(p, theta=None, seed=0):
    score, _, ending = evaluate(p, p.space.default if theta is None else theta, seed)
    assert ending == "done"
    return score


def test_the_oracle():
    score = score_of(problem(mismatch_seed=None))
    assert score.metrics["t80_min"] == pytest.approx(23.4, abs=0.05)
    assert score.metrics["t95_min"] == pytest.approx(36.24, abs=0.005)
    assert score.metrics["overshoot_mV"] <= 1e-3
    assert score.feasible
    assert score.metrics["solver_failures"] == 0


def test_the_objective_may_be_the_time_of_charge():
    score = score_of(problem(mismatch_seed=None, charge_time_to_soc=0.95))
    # 360 steps of 10 s are 60 min.
    assert score.objective == pytest.approx(-score.metrics["t95_min"] / 60, abs=1e-12)
    assert score.performance == score_of(problem(mismatch_seed=None)).performance


@pytest.mark.parametrize(("mark", "name"), [(None, "t95"), (0.8, "t80"), (0.85, "t85")])
def test_the_charging_time_that_is_told_is_the_one_that_is_the_objective(mark, name):
    p = problem(mismatch_seed=None, charge_time_to_soc=mark)
    episode = run_charge(p)
    start, end = p.episode.soc_start, episode.signal("soc")[1]
    crossing = np.interp(mark or 0.95, [start, *end], np.arange(end.size + 1)) * p.controller.sampling_time_s / 60
    assert charge_time(p, score_of(p)) == (name, pytest.approx(crossing, abs=1e-9))
    late = changed(p, soc_start=0.05, steps=60)
    assert charge_time(late, score_of(late)) == (name, None)


def test_a_charge_that_does_not_get_there_is_worse_the_less_it_charges():
    found = [score_of(problem(mismatch_seed=None, charge_time_to_soc=0.9, soc_start=soc, steps=120)) for soc in (0.05, 0.2, 0.3, 0.7, 0.8)]
    assert [s.metrics["t90_min"] is None for s in found] == [True, True, True, False, False]
    for score in found[:3]:
        assert score.objective == pytest.approx(-1 - 0.9 + score.metrics["soc_end"], abs=1e-12)
    assert [s.objective for s in found] == sorted(s.objective for s in found)


@pytest.mark.parametrize("value", [0.05, 1.01, NAN])
def test_the_time_of_charge_ends_above_the_start(value):
    with pytest.raises(ValueError, match="charge_time_to_soc"):
        problem(charge_time_to_soc=value)


# Member study, section 4: untuned overshoot in mV and t95 in minutes.
UNTUNED = {0: (38, 39.7), 1: (62, 35.8), 2: (45, 34.5), 3: (113, 37.4), 4: (42, 41.7), 5: (95, 31.8), 6: (58, 37.8), 7: (94, 41.1)}


@pytest.mark.parametrize("seed", UNTUNED)
def test_the_untuned_controller(seed):
    metrics = score_of(problem(mismatch_seed=seed)).metrics
    overshoot, t95 = UNTUNED[seed]
    assert metrics["overshoot_mV"] == pytest.approx(overshoot, abs=0.51)
    assert metrics["t95_min"] == pytest.approx(t95, abs=0.0501)


@pytest.mark.parametrize("kind", ["open_loop", "exact"])
def test_no_step_of_twenty_mismatches_is_left_unsolved(kind):
    found = {seed: score_of(problem(mismatch_seed=seed, kind=kind)).metrics for seed in range(20)}
    assert {seed: m["solver_failures"] for seed, m in found.items()} == dict.fromkeys(range(20), 0.0)
    # The voltage limit is met by every one of them, so the solver had something to do.
    assert min(m["overshoot_mV"] for m in found.values()) > -1.0


def test_theta_is_backoff_first_then_the_ratios():
    p = problem(backoff=Backoff(nodes=3), R1=ResistanceRatio(), R0=ResistanceRatio(0.5, 2.0))
    expected = [*(f"backoff_V[{i}]" for i in range(3)), *(f"R0_ratio[{i}]" for i in range(9)), *(f"R1_ratio[{i}]" for i in range(9))]
    assert list(p.space.entries) == expected
    np.testing.assert_array_equal(p.space.default, [0.0] * 3 + [1.0] * 18)
    assert p.space.lower.tolist() == [-0.25] * 3 + [0.5] * 9 + [0.1] * 9
    # The middle of the logarithm: ratios are as often halved as doubled.
    np.testing.assert_allclose(p.space.from_unit(np.full(21, 0.5))[3:12], 1.0, rtol=1e-12)


def test_the_untuned_theta_is_the_untuned_controller():
    plain = run_charge(problem(mismatch_seed=3))
    tuned = run_charge(problem(mismatch_seed=3, backoff=Backoff(), R0=ResistanceRatio(), R1=ResistanceRatio()))
    np.testing.assert_allclose(tuned.input, plain.input, rtol=0, atol=2e-4)


def test_the_right_ratios_undo_the_mismatch():
    p = problem(mismatch_seed=2, R0=ResistanceRatio(0.1, 10.0), R1=ResistanceRatio(0.1, 10.0))
    wrong = mismatched(CELL, 2)
    right = np.concatenate([np.array(CELL.R0_ohm) / wrong.R0_ohm, np.array(CELL.R1_ohm) / wrong.R1_ohm])
    # C1 stays wrong, so a little is left.
    assert score_of(p, right).metrics["overshoot_mV"] < score_of(p).metrics["overshoot_mV"] / 4


def test_a_backoff_of_50_mV_keeps_50_mV():
    p = problem(mismatch_seed=None, backoff=Backoff())
    score = score_of(p, np.full(7, 0.05))
    assert score.metrics["overshoot_mV"] == pytest.approx(-50.0, abs=0.01)
    assert score.excess["voltage_max_V"] == pytest.approx(-0.05, abs=1e-5)


def test_backoff_at_the_predicted_soc_differs_from_the_measured_one():
    theta = np.linspace(0.1, -0.1, 7)
    measured, predicted = (run_charge(problem(mismatch_seed=1, backoff=Backoff(at=at)), theta).input for at in ("measured", "predicted"))
    difference = np.max(np.abs(measured - predicted))
    assert 1e-3 < difference < 1.0
    flat = np.full(7, 0.03)
    same = [run_charge(problem(mismatch_seed=1, backoff=Backoff(at=at)), flat).input for at in ("measured", "predicted")]
    np.testing.assert_allclose(*same, rtol=0, atol=6e-4)


def test_lower_current_limit_and_own_limits_are_kept():
    p = problem(mismatch_seed=0, current_max_A=4.0, current_min_A=0.5, voltage_max_V=4.1)
    episode = run_charge(p)
    assert 0.5 <= episode.input.min() < episode.input.max() <= 4.0
    assert score_episode(p, episode).excess["voltage_max_V"] == pytest.approx(np.max(episode.signal("voltage_V")) - 4.1)


def test_score_by_hand(by_hand):
    p = problem(mismatch_seed=None, soc_start=0.7, soc_target=1.0, c1=0.01, voltage_min_V=4.0, tolerance_V=0.01, soc_windows=10)
    score = score_episode(p, by_hand)
    # SOC 0.70, 0.75, 0.85, 0.90, 0.98; the larger voltages 4.21, 4.24, 4.15, 4.205.
    deficit = 0.30**2 + 0.25**2 + 0.15**2 + 0.10**2 + 0.02**2
    assert score.objective == pytest.approx(-deficit / 5)
    assert score.performance == pytest.approx(-0.01 * deficit - (0.01**2 + 0.04**2 + 0.005**2))
    assert score.excess == pytest.approx({"voltage_max_V": 0.04, "voltage_min_V": -0.1})
    assert score.tolerance == {"voltage_max_V": 0.01, "voltage_min_V": 0.01}
    assert not score.feasible
    assert replace(score, tolerance={"voltage_max_V": 0.0401, "voltage_min_V": 0.0}).feasible
    assert score.metrics["overshoot_mV"] == pytest.approx(40.0)
    window = score.profile["voltage_max_V"]
    assert len(window) == 10
    assert window[:7] == (None,) * 7
    assert window[7:] == pytest.approx((0.01, 0.04, 0.005))


def test_profile_has_the_worst_excess():
    score = score_of(problem(mismatch_seed=3))
    assert max(v for v in score.profile["voltage_max_V"] if v is not None) == score.excess["voltage_max_V"]


@pytest.mark.parametrize("field", ["output_start", "output_end"])
@pytest.mark.parametrize("value", [NAN, INF, -INF])
def test_no_score_from_a_missing_measurement(by_hand, field, value):
    broken = getattr(by_hand, field).copy()
    broken[2, 0] = value
    with pytest.raises(ValueError, match="no score: a measurement of voltage_V, soc is missing or not finite"):
        score_episode(problem(soc_start=0.7), replace(by_hand, **{field: broken}))


def test_no_score_from_an_episode_without_intervals(by_hand):
    with pytest.raises(ValueError, match="no score"):
        score_episode(problem(soc_start=0.7), by_hand.cut(0, Ending.DONE, ""))


def test_a_call_without_score_keeps_the_episode(by_hand):
    broken = by_hand.output_end.copy()
    broken[2, 0] = NAN
    p = problem(soc_start=0.7)
    for episode, said in (
        (replace(by_hand, output_end=broken), "sensor: the episode has no score: a measurement of voltage_V, soc is missing or not finite"),
        (by_hand.cut(2, Ending.SOLVER, "no input"), "solver: no input"),
    ):
        assert outcome(p, episode) == (None, episode, said)


def test_noise_comes_from_the_seed_alone():
    p = problem(steps=30, voltage_noise_sd_V=2e-3, soc_noise_sd=1e-3)
    one, again, other = (run_charge(p, seed=s) for s in (1, 1, 2))
    np.testing.assert_array_equal(one.output_end, again.output_end)
    assert not np.array_equal(one.output_end, other.output_end)


TUNED = {"mismatch_seed": 3, "backoff": Backoff(), "R1": ResistanceRatio(), "steps": 60}


def test_it_pickles_small_also_after_use():
    p = problem(**TUNED)
    run_charge(p)
    assert controller_of(p) is controller_of(p)
    data = pickle.dumps(p)
    assert len(data) < 5_000
    again = pickle.loads(data)  # noqa: S301 - made two lines above
    assert again == p
    np.testing.assert_array_equal(run_charge(again).input, run_charge(p).input)


def test_a_worker_gives_the_same_score_to_the_last_bit():
    p = problem(**TUNED)
    thetas = [p.space.default, p.space.from_unit(np.full(16, 0.4))]
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as workers:
        futures = [workers.submit(Evaluation(p), theta, 5) for theta in thetas]
        for theta, future in zip(thetas, futures, strict=True):
            score, episode, ending = future.result(timeout=120)
            here = evaluate(p, theta, 5)
            assert (score, ending) == (here[0], here[2])
            for name, array in here[1].arrays().items():
                np.testing.assert_array_equal(episode.arrays()[name], array, err_msg=name)


# Field, value -> what the message must say.
REFUSED = [
    ({"sampling_time_s": 0.0}, ("sampling_time_s = 0.0", "[0.001, 3600] s")),
    ({"sampling_time_s": -10.0}, ("sampling_time_s = -10.0", "[0.001, 3600] s")),
    ({"sampling_time_s": NAN}, ("sampling_time_s = nan", "[0.001, 3600] s")),
    ({"sampling_time_s": "10"}, ("sampling_time_s = '10'", "[0.001, 3600] s")),
    ({"sampling_time_s": 600.0}, ("the time constant R1 C1 = 22 s", "sampling_time_s = 600 s", "at least a twentieth, 30 s")),
    ({"horizon": 0}, ("horizon = 0", "integer in [1, 50]")),
    ({"horizon": 51}, ("horizon = 51", "integer in [1, 50]")),
    ({"horizon": 5.0}, ("horizon = 5.0", "integer in [1, 50]")),
    ({"horizon": True}, ("horizon = True", "integer in [1, 50]")),
    ({"steps": 0}, ("steps = 0", "integer in [1, 1000000]")),
    ({"steps": True}, ("steps = True", "integer in [1, 1000000]")),
    ({"soc_windows": 0}, ("soc_windows = 0", "integer in [1, 50]")),
    ({"penalty_per_V": 0.0}, ("penalty_per_V = 0.0", "(0, 1e+09]")),
    ({"penalty_per_V": -1.0}, ("penalty_per_V = -1.0", "(0, 1e+09]")),
    ({"c1": -1e-5}, ("c1 = -1e-05", "(0, 1]")),
    ({"c1": INF}, ("c1 = inf", "(0, 1]")),
    ({"tolerance_V": -1e-3}, ("tolerance_V = -0.001", "[0, 0.1] V")),
    ({"tolerance_V": 0.5}, ("tolerance_V = 0.5", "[0, 0.1] V")),
    ({"soc_start": -0.1}, ("soc_start = -0.1", "[0, 1]")),
    ({"soc_start": 5.0}, ("soc_start = 5.0", "[0, 1]")),
    ({"soc_target": 80.0}, ("soc_target = 80.0", "[0, 1]")),
    ({"soc_start": 0.5, "soc_target": 0.5}, ("soc_target = 0.5 must be more than soc_start = 0.5",)),
    ({"soc_start": 0.5, "soc_target": 0.4}, ("soc_target = 0.4 must be more than soc_start = 0.5",)),
    ({"soc_start": 0.9, "voltage_max_V": 4.0}, ("soc_start = 0.9", "resting voltage", "not below voltage_max_V = 4")),
    ({"current_max_A": 0.0}, ("current_max_A = 0.0", "(0, 6] A")),
    ({"current_max_A": -2.0}, ("current_max_A = -2.0", "(0, 6] A")),
    ({"current_max_A": 7.0}, ("current_max_A = 7.0", "(0, 6] A")),
    ({"current_min_A": -7.0}, ("current_min_A = -7.0", "[-6, 6] A")),
    ({"current_min_A": 3.0, "current_max_A": 3.0}, ("current_min_A = 3 must be less than current_max_A = 3",)),
    ({"voltage_max_V": 4.25}, ("voltage_max_V = 4.25", "(2.5, 4.2] V")),
    ({"voltage_max_V": 4200.0}, ("voltage_max_V = 4200.0", "(2.5, 4.2] V")),
    ({"voltage_max_V": NAN}, ("voltage_max_V = nan", "(2.5, 4.2] V")),
    ({"voltage_max_V": 2.5}, ("voltage_max_V = 2.5", "(2.5, 4.2] V")),
    ({"voltage_min_V": 2.0}, ("voltage_min_V = 2.0", "[2.5, 4.2] V")),
    ({"voltage_min_V": 4.0, "voltage_max_V": 3.9}, ("voltage_min_V = 4 must be less than voltage_max_V = 3.9",)),
    ({"mismatch_seed": -1}, ("mismatch_seed = -1", "integer >= 0")),
    ({"mismatch_seed": 1.0}, ("mismatch_seed = 1.0", "integer >= 0")),
    ({"mismatch_seed": True}, ("mismatch_seed = True", "integer >= 0")),
    ({"kind": "measured"}, ("kind = 'measured'", "open_loop, exact")),
    ({"backoff": Backoff(upper_V=0.95), "voltage_max_V": 4.1}, ("upper_V = 0.95 V forbids any charging", "less than 0.923 V")),
]


@pytest.mark.parametrize(("changes", "said"), REFUSED, ids=[" ".join(changes) + f" {i}" for i, (changes, _) in enumerate(REFUSED)])
def test_refuses(changes, said):
    with pytest.raises(ValueError) as refused:  # noqa: PT011 - what it says is checked below
        problem(**changes)
    for part in said:
        assert part in str(refused.value)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: Backoff(nodes=1), ("backoff: nodes = 1", "integer in [2, 50]")),
        (lambda: Backoff(nodes=51), ("backoff: nodes = 51", "integer in [2, 50]")),
        (lambda: Backoff(nodes=True), ("backoff: nodes = True", "integer in [2, 50]")),
        (lambda: Backoff(nodes=(0.0, 0.5, 1.0)), ("backoff: nodes = (0.0, 0.5, 1.0)", "integer in [2, 50]")),
        (lambda: Backoff(lower_V=0.1), ("backoff: lower_V = 0.1", "[-1, 0] V")),
        (lambda: Backoff(lower_V=NAN), ("backoff: lower_V = nan", "[-1, 0] V")),
        (lambda: Backoff(lower_V=-250.0), ("backoff: lower_V = -250.0", "[-1, 0] V")),
        (lambda: Backoff(upper_V=0.0), ("backoff: upper_V = 0.0", "(0, 1] V")),
        (lambda: Backoff(upper_V=200), ("backoff: upper_V = 200", "(0, 1] V")),
        (lambda: Backoff(upper_V="0,2"), ("backoff: upper_V = '0,2'", "(0, 1] V")),
        (lambda: Backoff(at="start"), ("backoff: at = 'start'", "'measured' or 'predicted'")),
        (lambda: ResistanceRatio(lower=0.0), ("resistance ratio: lower = 0.0", "[0.001, 0.999]")),
        (lambda: ResistanceRatio(lower=1.0), ("resistance ratio: lower = 1.0", "[0.001, 0.999]")),
        (lambda: ResistanceRatio(lower=-0.1), ("resistance ratio: lower = -0.1", "[0.001, 0.999]")),
        (lambda: ResistanceRatio(upper=0.9), ("resistance ratio: upper = 0.9", "[1.001, 100]")),
        (lambda: ResistanceRatio(upper=INF), ("resistance ratio: upper = inf", "[1.001, 100]")),
        (lambda: ResistanceRatio(upper="6"), ("resistance ratio: upper = '6'", "[1.001, 100]")),
    ],
)
def test_refuses_a_bad_theta(make, said):
    with pytest.raises(ValueError) as refused:  # noqa: PT011 - what it says is checked below
        make()
    for part in said:
        assert part in str(refused.value)


@pytest.mark.parametrize(
    ("theta", "message"),
    [
        (np.zeros(6), r"theta has shape \(6,\), expected \(7,\): backoff_V\[0\]"),
        (np.array([0.0] * 6 + [0.3]), r"theta: backoff_V\[6\] = 0.3, allowed is \[-0.25, 0.25\] V"),
        (np.array([0.0] * 6 + [NAN]), r"theta: backoff_V\[6\] = nan, allowed is"),
    ],
)
def test_refuses_theta_outside_its_domain(theta, message):
    with pytest.raises(ValueError, match=message):
        evaluate(problem(backoff=Backoff(), steps=60), theta, 0)
