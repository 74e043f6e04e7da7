"""Limits as data, the estimator's settings and every part of theta, in closed loop."""

import json
from dataclasses import replace

import numpy as np
import pytest

from chargetune.battery.cell.cell import default_cell
from chargetune.battery.cell.plating import Anode
from chargetune.battery.cell.thermal import Thermal
from chargetune.battery.charging.evaluate import evaluate, run_charge
from chargetune.battery.charging.kalman import Kalman
from chargetune.battery.charging.limits import Limit
from chargetune.battery.charging.tunables import Backoff, CurrentLimit, LimitBackoff, MeasurementSpread, ResistanceRatio, Tunables
from chargetune.battery.charging.verdict import judgement, violation_mVs
from chargetune.battery.studies.study_file import load_config, problem_of_document
from charging_problems import charging_problem

CELL = default_cell()
WARM = replace(CELL, thermal=Thermal(heat_capacity_J_K=45.0, cooling_W_K=0.1, activation_J_mol=20e3))
ANODE = replace(WARM, anode=Anode((0.0, 0.5, 1.0), (0.2, 0.1, 0.06), (0.03, 0.03, 0.03)))
HOT = 312.15

pytestmark = pytest.mark.usefixtures("virtual_machine")


def scored(cell=WARM, theta=None, **changes):
    problem = charging_problem(cell, mismatch_seed=None, **changes)
    score, episode, ending = evaluate(problem, problem.space.default if theta is None else np.asarray(theta, dtype=float), 0)
    assert ending == "done"
    return score, episode


def test_a_perfect_model_keeps_voltage_temperature_and_anode_potential_and_rides_them():
    score, _ = scored(ANODE, temperature_max_K=HOT, anode_min_V=0.0)
    assert score.feasible
    assert score.metrics["solver_failures"] == 0
    assert -1e-9 <= score.metrics["current_max_excess_A"] <= 0
    # Each limit is reached somewhere: the charge is as fast as it can be.
    for name, unit in (("voltage_max_V", 1e-4), ("temperature_max_K", 0.02), ("anode_min_V", 1e-4)):
        assert -unit <= score.excess[name] <= unit, name


def test_a_limit_that_is_only_scored_is_broken_and_told():
    free, _ = scored(ANODE, temperature_max_K=HOT, anode_min_V=0.0, scored_only=("temperature_max_K", "anode_min_V"))
    kept, _ = scored(ANODE, temperature_max_K=HOT, anode_min_V=0.0)
    assert free.excess["temperature_max_K"] > 1.0
    assert free.excess["anode_min_V"] > 0.005
    assert not free.feasible
    assert free.metrics["t80_min"] < kept.metrics["t80_min"]
    assert free.metrics["temperature_max_excess_K"] == pytest.approx(free.excess["temperature_max_K"])
    assert free.metrics["anode_min_excess_mV"] == pytest.approx(1e3 * free.excess["anode_min_V"])
    assert free.metrics["temperature_max_excess_Ks"] > 0 < free.metrics["anode_min_excess_mVs"]


def test_a_hard_limit_goes_before_a_soft_one_where_both_cannot_be_kept():
    """A least current of 3 A warms the cell beyond its limit; nothing helps, so the worst of it is as small as it can be."""
    narrow = {"temperature_max_K": 305.15, "voltage_max_V": 3.9, "current_min_A": 0.5, "soc_start": 0.6, "steps": 60}
    both, _ = scored(**narrow)
    hard, _ = scored(**narrow, hard=("voltage_max_V",))
    assert hard.excess["voltage_max_V"] <= both.excess["voltage_max_V"] + 1e-6


@pytest.mark.parametrize("horizon", [1, 5])
def test_a_limit_that_cannot_be_kept_is_no_failure_of_the_solver(horizon):
    """A least current of 4 A at 60 % SOC is beyond 4.2 V: it is what is applied, and it is optimal."""
    _, episode = scored(CELL, soc_start=0.6, soc_target=0.9, steps=6, current_min_A=4.0, horizon=horizon)
    assert episode.failures == 0
    assert episode.iterations.max() <= 3
    np.testing.assert_allclose(episode.input[3:], 4.0, atol=1e-6)


def test_current_limit_holds_what_the_model_does_not_see():
    blind = {"temperature_max_K": HOT, "scored_only": ("temperature_max_K",), "current_limit": CurrentLimit(nodes=3, lower=0.1)}
    loose, _ = scored(**blind)
    tight, episode = scored(theta=[1.0, 0.5, 0.5], **blind)
    assert loose.excess["temperature_max_K"] > 1.0 > tight.excess["temperature_max_K"]
    soc = np.concatenate([[0.05], episode.signal("soc")[1][:-1]])
    allowed = 6.0 * np.interp(soc, [0.0, 0.5, 1.0], [1.0, 0.5, 0.5])
    assert np.all(episode.input[:, 0] <= allowed + 1e-9)
    assert np.max(episode.input[:, 0] - allowed) > -1e-6


def test_backoffs_of_temperature_and_anode_keep_their_distance():
    margins = {"temperature_backoff": LimitBackoff(-2.0, 5.0), "anode_backoff": LimitBackoff(-0.02, 0.05, nodes=3)}
    score, _ = scored(ANODE, theta=[2.0, 0.01, 0.01, 0.01], temperature_max_K=HOT, anode_min_V=0.0, **margins)
    assert score.excess["temperature_max_K"] == pytest.approx(-2.0, abs=0.02)
    assert score.excess["anode_min_V"] == pytest.approx(-0.01, abs=2e-4)


def test_one_scale_of_a_resistance_is_all_nodes_alike():
    one = charging_problem(CELL, mismatch_seed=1, R0=ResistanceRatio(scale=True))
    all_nodes = charging_problem(CELL, mismatch_seed=1, R0=ResistanceRatio())
    assert one.space.dimension == 1
    np.testing.assert_allclose(run_charge(one, [1.3]).input, run_charge(all_nodes, [1.3] * 9).input, atol=2e-4)


def test_the_filter_finds_a_wrong_soc_at_the_start_by_the_voltage():
    noise = {"voltage_noise_sd_V": 0.002, "temperature_noise_sd_K": 0.1}
    wrong = {"soc_start_error": 0.05, **noise, "temperature_max_K": HOT, "verdict_samples": 5}
    _, episode = scored(kalman=Kalman(voltage_sd_V=0.01, soc_start_sd=0.05), **wrong)
    error = episode.estimate[1:, 0] - episode.signal("soc", true=True)[1][:-1]
    assert abs(error[60]) < 0.01
    # A filter that does not trust the voltage keeps counting charge from the wrong start.
    _, counting = scored(kalman=Kalman(voltage_sd_V=10.0, soc_start_sd=1e-4), **wrong)
    late = counting.estimate[61, 0] - counting.signal("soc", true=True)[1][60]
    assert late == pytest.approx(0.05, abs=0.005)


def test_the_filters_spread_may_be_part_of_theta():
    problem = charging_problem(
        CELL, mismatch_seed=3, kalman=Kalman(), voltage_sd=MeasurementSpread(1e-3, 1.0), soc_start_error=0.03, steps=100
    )
    assert list(problem.space.entries) == ["voltage_sd_V"]
    fixed = {
        sd: charging_problem(CELL, mismatch_seed=3, kalman=Kalman(voltage_sd_V=sd), soc_start_error=0.03, steps=100) for sd in (0.05, 0.5)
    }
    for sd, one in fixed.items():
        np.testing.assert_allclose(run_charge(problem, [sd]).estimate, run_charge(one).estimate, atol=1e-6)
    assert np.max(np.abs(run_charge(fixed[0.05]).estimate - run_charge(fixed[0.5]).estimate)) > 1e-3


def test_the_verdict_on_noise_is_nearer_the_truth():
    plain, _ = scored(CELL, voltage_noise_sd_V=0.002)
    mean, episode = scored(CELL, voltage_noise_sd_V=0.002, verdict_samples=5)
    true = float(np.max(episode.signal("voltage_V", true=True))) - 4.2
    assert plain.excess["voltage_max_V"] > 0.005
    assert true < mean.excess["voltage_max_V"] < 0.6 * plain.excess["voltage_max_V"]


@pytest.mark.parametrize("samples", [1, 5])
@pytest.mark.parametrize("lost", [[3], [3, 4, 5], list(range(2, 9)), [0], [39]])
def test_what_was_lost_costs_the_budget_of_violation_what_is_beside_it_does(by_hand, samples, lost):
    """30 mV over the limit in every interval: the overshoot is known, and no lost sample is a kept limit."""
    problem = charging_problem(CELL, mismatch_seed=None, voltage_noise_sd_V=0.002, verdict_samples=samples)
    limit = problem.limits_by_name["voltage_max_V"]
    both = np.column_stack([np.full(40, limit.bound + 0.03), np.full(40, 0.5)])
    episode = replace(by_hand, output_start=both, output_end=both.copy(), time_s=10.0 * np.arange(40))
    whole = violation_mVs(problem, episode)
    assert whole == pytest.approx(40 * 10.0 * 1e3 * (0.03 - judgement(problem, limit)[1]))
    for one in (episode.output_start, episode.output_end):
        one[lost, 0] = np.nan
    assert violation_mVs(problem, episode) == pytest.approx(whole)
    episode.output_start[:, 0] = episode.output_end[:, 0] = np.nan
    assert violation_mVs(problem, episode) == 0.0


@pytest.mark.parametrize(
    ("cell", "changes", "said"),
    [
        (WARM, {"temperature_max_K": 45.0}, "temperature_max_K = 45.0, allowed is [250, 400] K (was it given in degC?)"),
        (ANODE, {"anode_min_V": 10.0}, "anode_min_V = 10.0"),
        (CELL, {"temperature_max_K": 318.15}, "['temperature_max_K'] cannot be measured on this cell"),
        (CELL, {"anode_min_V": 0.0}, "['anode_min_V'] cannot be measured on this cell"),
        (WARM, {"hard": ("temperature_max_K",)}, "hard names temperature_max_K, allowed are the limits that are set"),
        (WARM, {"scored_only": ("voltage",)}, "scored_only names voltage"),
        (WARM, {"verdict_samples": 0}, "verdict_samples = 0"),
        (WARM, {"tolerance_K": -1.0}, "tolerance_K = -1.0"),
        (WARM, {"soc_start_error": -0.1}, "believed SOC at the start (soc_start + soc_start_error) = -0.05"),
        (
            WARM,
            {"temperature_backoff": LimitBackoff(-1.0, 1.0)},
            "theta has temperature_backoff, allowed is one of each limit that the controller's model predicts",
        ),
        (CELL, {"R2": ResistanceRatio()}, "theta has ratios of R2, allowed are those of this cell: R0, R1"),
        (CELL, {"voltage_sd": MeasurementSpread()}, "without estimator.kalman"),
    ],
)
def test_a_bad_problem_is_refused_by_name(cell, changes, said):
    with pytest.raises(ValueError, match=r"allowed|cannot|without") as caught:
        charging_problem(cell, **changes)
    assert said in str(caught.value)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: Limit("voltage", 4.2, 0.0), "name = 'voltage'"),
        (lambda: Tunables(anode_backoff=LimitBackoff(-5.0, 1.0)), "anode_backoff: lower = -5.0"),
        (lambda: CurrentLimit(nodes=1), "nodes = 1"),
        (lambda: CurrentLimit(lower=1.0), "lower = 1.0"),
        (lambda: MeasurementSpread(lower_V=0.0), "lower_V = 0.0"),
        (lambda: charging_problem(CELL, kalman=Kalman(voltage_sd_V=5.0), voltage_sd=MeasurementSpread()), "voltage_sd_V = 5.0"),
        (lambda: Kalman(voltage_sd_V=0.0), "voltage_sd_V = 0.0"),
        (lambda: Kalman(soc_start_sd=-1.0), "soc_start_sd = -1.0"),
        (lambda: ResistanceRatio(scale=1), "scale = 1"),
    ],
)
def test_nonsense_is_refused_by_name(make, said):
    with pytest.raises(ValueError, match="allowed") as caught:
        make()
    assert said in str(caught.value)


FILE = """
[cell]
file = "cell.toml"
[plant]
model = "SPM"
ambient_K = 290.0
[estimator]
soc_start_error = 0.01
[estimator.kalman]
voltage_sd_V = 0.1
[limits]
temperature_max_K = 318.15
anode_min_V = 0.0
hard = ["temperature_max_K"]
[sensors]
voltage_noise_sd_V = 0.002
[objective]
charge_time_to_soc = 0.8
[theta.backoff]
nodes = 3
[theta.R1]
scale = true
[theta.current_limit]
nodes = 4
[theta.temperature_backoff]
lower = -1.0
upper = 4.0
[theta.voltage_sd]
"""


def test_the_file_says_all_of_it_and_the_store_gives_it_back(tmp_path):
    from chargetune.battery.identification.pulse_fit import cell_toml

    (tmp_path / "cell.toml").write_text(cell_toml(WARM))
    (tmp_path / "study.toml").write_text(FILE)
    config = load_config(tmp_path / "study.toml")
    problem = config.problem(tmp_path)
    assert [(limit.name, limit.kind) for limit in problem.limits_by_name.values()] == [
        ("voltage_max_V", "soft"),
        ("voltage_min_V", "soft"),
        ("temperature_max_K", "hard"),
        ("anode_min_V", "scored"),
    ]
    names = ["backoff_V", "R1_scale", "temperature_backoff_K", "current_limit", "voltage_sd_V"]
    assert [p.name for p in problem.space.parameters] == names
    assert problem.space.default[-1] == pytest.approx(0.1)
    assert (problem.plant.model, problem.plant.ambient_K) == ("SPM", 290.0)
    assert problem.theta.backoff == Backoff(nodes=3)
    assert problem.objective.charge_time_to_soc == 0.8
    document = json.loads(json.dumps(config.document(tmp_path)))
    assert problem_of_document(document) == problem
    # Studies that are older than this choice resume.
    (tmp_path / "study.toml").write_text(FILE.replace("charge_time_to_soc = 0.8", ""))
    assert "charge_time_to_soc" not in load_config(tmp_path / "study.toml").document(tmp_path)["objective"]


def test_a_charge_on_an_electrochemical_plant_within_its_limits():
    cell = replace(WARM, capacity_Ah=5.1, current_max_A=10.0)
    problem = charging_problem(
        cell,
        mismatch_seed=None,
        plant=_spm(),
        current_max_A=10.0,
        temperature_max_K=318.15,
        anode_min_V=0.0,
        kalman=Kalman(0.2),
        steps=40,
    )
    score, episode, ending = evaluate(problem, problem.space.default, 0)
    assert ending == "done"
    assert set(score.excess) == {"voltage_max_V", "voltage_min_V", "temperature_max_K", "anode_min_V"}
    assert score.metrics["soc_end"] > 0.1
    assert episode.true_start is not None


def _spm():
    from chargetune.battery.plants.electrochemical import Electrochemical

    return Electrochemical(model="SPM")
