"""Backoffs over temperature and estimated resistance, and theta by context over a range of use."""

from dataclasses import replace

import numpy as np
import pytest

from chargetune.battery.cell.cell import default_cell
from chargetune.battery.cell.thermal import Thermal
from chargetune.battery.charging.charging_range import ChargingRange
from chargetune.battery.charging.conditions import Over, ScheduleSettings
from chargetune.battery.charging.controller import controller_of
from chargetune.battery.charging.evaluate import plant_of, run_charge
from chargetune.battery.charging.observers import Adaptive
from chargetune.battery.charging.range_settings import ChargingRangeSettings
from chargetune.battery.charging.tunables import Backoff, LimitBackoff
from chargetune.battery.studies.open_study import make_tuner
from chargetune.battery.studies.study_file import Config, problem_of_document
from chargetune.episode.stepwise import run_episode
from charging_problems import charging_problem

# Resistances grow in the cold: an activation energy of 30 kJ/mol, in the middle of what lithium-ion cells show.
WARM = replace(default_cell(), thermal=Thermal(heat_capacity_J_K=40.0, cooling_W_K=0.05, activation_J_mol=30e3))
COLD_AND_WARM = (283.15, 308.15)
CONSTANT = Backoff(nodes=2, lower_V=0.0, upper_V=0.3)


def adaptive(over, **entries):
    return charging_problem(WARM, adaptive=Adaptive(), backoff=Backoff(nodes=2, over=over), steps=120, **entries)


def bound_of_voltage(problem, state, theta):
    """The upper voltage limit of the controller's first row with this state estimated, without input."""
    controller = controller_of(problem)
    names = controller.model.state_names
    now = np.array([state.get(name, 0.0) for name in names])
    p = controller.parameters(theta, controller.model.nominal, np.zeros(0))
    limit = next(one for one in controller.limits if one.of == "voltage_V")
    y = np.array(controller.model.h(now, 0.0, p)).ravel()[controller.model.output_names.index("voltage_V")]
    return y - float(np.array(limit.rows(now, 0.0, theta, p, now, 0.0, np.zeros(0))).ravel()[0])


def test_backoff_over_temperature_and_resistance_is_multilinear():
    over = Over(temperature_K=(280.0, 320.0), temperature_nodes=3, resistance_factor=(1.0, 2.0))
    problem = adaptive(over)
    assert problem.space.dimension == 12
    assert problem.space.parameters[0].shape == (3, 2, 2)
    at = [(t, f, z) for t in (0.0, 0.5, 1.0) for f in (0.0, 1.0) for z in (0.0, 1.0)]
    table = np.array([0.02 * t + 0.03 * f + 0.01 * z + 0.04 * t * f * z for t, f, z in at])

    def backoff(kelvin, factor, soc):
        state = {"temperature_K": kelvin, "soc": soc, "resistance_log_factor": np.log(factor)}
        return bound_of_voltage(problem, state, np.zeros(12)) - bound_of_voltage(problem, state, table)

    for kelvin, factor, soc in ((280.0, 1.0, 0.0), (290.0, 1.25, 0.4), (315.0, 1.9, 0.8), (320.0, 2.0, 1.0)):
        t, f = (kelvin - 280) / 40, factor - 1
        assert backoff(kelvin, factor, soc) == pytest.approx(0.02 * t + 0.03 * f + 0.01 * soc + 0.04 * t * f * soc, abs=1e-9)
    # Held beyond its nodes.
    assert backoff(330.0, 3.0, 0.5) == pytest.approx(backoff(320.0, 2.0, 0.5), abs=1e-9)
    assert backoff(270.0, 0.5, 0.5) == pytest.approx(backoff(280.0, 1.0, 0.5), abs=1e-9)


@pytest.mark.compiled_code
def test_compiled_as_step_by_step():
    problem = adaptive(Over(temperature_K=(290.0, 320.0), resistance_factor=(0.5, 2.0)), mismatch_seed=1)
    theta = np.linspace(0.0, 0.07, 8)
    compiled = run_charge(problem, theta)
    stepwise = run_episode(controller_of(problem), plant_of(problem), steps=120, theta=theta)
    np.testing.assert_allclose(compiled.input, stepwise.input, rtol=0, atol=1e-6)
    assert np.max(np.abs(compiled.input - run_charge(problem, np.zeros(8)).input)) > 0.05


def ranged(schedule=None, **entries):
    problem = charging_problem(
        WARM, mismatch_seed=1, backoff=CONSTANT, schedule=schedule, steps=360, charge_time_to_soc=0.8, voltage_min_V=2.5, **entries
    )
    return replace(problem, range=ChargingRangeSettings(soc_start=(0.05, 0.3), ambient_K=COLD_AND_WARM))


def test_each_draw_has_the_theta_of_its_own_ambient():
    """By schedule as by the interpolated constant theta, draw by draw."""
    by_context, plain = ChargingRange(ranged(ScheduleSettings(ambient_K=COLD_AND_WARM))), ChargingRange(ranged())
    plants, table = by_context.draw(4, 0), np.array([0.2, 0.1, 0.06, 0.02])
    shares = [(by_context.values(one)["ambient_K"][0] - COLD_AND_WARM[0]) / np.ptp(COLD_AND_WARM) for one in plants]
    own = [(1 - share) * table[:2] + share * table[2:] for share in shares]
    assert np.ptp(shares) > 0.3
    for one, other in zip(by_context.run([table] * 4, plants), plain.run(own, plants), strict=True):
        np.testing.assert_allclose(one.input, other.input, rtol=0, atol=1e-9)


def test_schedule_over_ambient_beats_one_constant_backoff():
    """The smallest backoffs that keep the limit on the same twelve draws, by bisection; in the cold the resistances' errors are larger."""
    by_context, plain = ChargingRange(ranged(ScheduleSettings(ambient_K=COLD_AND_WARM))), ChargingRange(ranged())
    plants = plain.draw(12, 1)

    def verdict(use, theta):
        scores = [use.score(episode.noise_free()) for episode in use.run([np.array(theta)] * 12, plants)]
        times = [np.inf if score.metrics["t80_min"] is None else score.metrics["t80_min"] for score in scores]
        return all(score.feasible for score in scores), float(np.mean(times))

    def least(keeps, high):
        low = 0.0
        for _ in range(6):
            middle = (low + high) / 2
            low, high = (low, middle) if keeps(middle) else (middle, high)
        return high

    constant = least(lambda b: verdict(plain, [b, b])[0], 0.3)
    cold = 1.2 * constant
    warm = least(lambda b: verdict(by_context, [cold, cold, b, b])[0], constant)
    kept, time = verdict(by_context, [cold, cold, warm, warm])
    assert kept
    assert warm < 0.8 * constant
    assert time < 0.99 * verdict(plain, [constant, constant])[1]


@pytest.mark.parametrize(
    ("make", "named"),
    [
        (Over, "nothing is given"),
        (lambda: Over(temperature_K=(300.0, 290.0)), "lowest < highest"),
        (lambda: Over(resistance_factor=(0.5, 2.0), resistance_nodes=1), "resistance_nodes = 1"),
        (ScheduleSettings, "axes"),
        (lambda: ScheduleSettings(ambient_K=(300.0,)), "at least 2"),
        (lambda: ScheduleSettings(age=(0.0, 1.5)), r"age\[1\] = 1.5"),
        (
            lambda: ranged(ScheduleSettings(ambient_K=(290.0, 310.0))),
            r"ambient_K = 283.15, allowed is what the schedule spans, \[290, 310\] K",
        ),
        (lambda: ranged(ScheduleSettings(ambient_K=(280.0, 290.0))), r"ambient_K = 298.15, allowed"),
        (lambda: ranged(ScheduleSettings(age=(0.2, 1.0))), r"age = 0, allowed is what the schedule spans, \[0.2, 1\]"),
        (lambda: ranged(ScheduleSettings(ambient_K=(280.0, 310.0), parts=("x",))), r"unknown \['x'\], allowed are backoff_V"),
        (lambda: charging_problem(default_cell(), schedule=ScheduleSettings(ambient_K=(280.0, 310.0))), "ambient_K.*thermal"),
        (lambda: charging_problem(default_cell(), backoff=Backoff(over=Over(temperature_K=(280.0, 310.0)))), "temperature_K.*thermal"),
        (lambda: charging_problem(WARM, backoff=Backoff(over=Over(resistance_factor=(0.5, 2.0)))), "adaptive"),
    ],
)
def test_what_is_refused(make, named):
    with pytest.raises(ValueError, match=named):
        make()


def test_other_tuners_than_that_of_the_range_refuse_a_schedule():
    with pytest.raises(ValueError, match=r"theta.schedule.*tuner = 'twin', allowed is tuner = 'range'"):
        make_tuner("twin", 0, ranged(ScheduleSettings(ambient_K=COLD_AND_WARM)))


def test_stored_study_has_the_same_problem():
    problem = ranged(ScheduleSettings(ambient_K=COLD_AND_WARM, age=(0.0, 1.0), parts=("backoff_V",)))
    margin = LimitBackoff(-2.0, 2.0, over=Over(temperature_K=(290.0, 310.0)))
    theta = replace(problem.theta, temperature_backoff=margin)
    config = Config(controller=problem.controller, limits=replace(problem.limits, temperature_max_K=318.15), theta=theta)
    document = {**config.document(), "cell": {**Config().document()["cell"], "thermal": vars(WARM.thermal)}}
    assert problem_of_document(document) == config.problem(cell=WARM)
    assert "over" not in Config(theta=charging_problem(WARM, backoff=CONSTANT).theta).document()["theta"]["backoff"]
