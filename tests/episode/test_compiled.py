"""The whole episode as one function: the same as step by step, compiled or not, cached by content."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator

from chargetune.battery.charging.controller import controller_of
from chargetune.battery.charging.evaluate import plant_of
from chargetune.control.estimators import ExactState, Propagated
from chargetune.control.kalman import ExtendedKalman
from chargetune.episode.compiled import compiled_episode, simulate
from chargetune.episode.episode import BLIND_MAX, Ending, Trip
from chargetune.episode.lookup_table import LookupTable
from chargetune.episode.stepwise import run_episode
from chargetune.model.model import Model
from chargetune.plants.sensors import Sensors
from chargetune.plants.simulated import SimulatedPlant
from chargetune.runtime.compiler import find_compiler

NOISY = Sensors({"voltage_V": 2e-3, "soc": 1e-3}, {"voltage_V": 5e-3}, {"voltage_V": 1e-3, "soc": 1e-4})
KALMAN = ExtendedKalman(("voltage_V", "soc"), (5e-3, 1e-3), (1e-4, 1e-3), (1e-2, 1e-2))
SOC = Propagated(("soc",))

# What changes the loop: estimator, sensors, process noise.
LOOPS = {
    "ideal": (SOC, Sensors(), {}),
    "noise": (SOC, Sensors(noise_sd={"voltage_V": 2e-3, "soc": 1e-3}), {}),
    "bias": (SOC, Sensors(bias={"soc": 0.02}), {}),
    "quantised": (SOC, Sensors(resolution={"soc": 0.01, "voltage_V": 5e-3}), {}),
    "all of these": (SOC, NOISY, {}),
    "delay 1": (SOC, Sensors(delay_steps=1), {}),
    "delay 3, noise": (SOC, replace(NOISY, delay_steps=3), {}),
    "process noise": (SOC, Sensors(), {"soc": 1e-3, "overpotential_V": 2e-3}),
    "exact state": (ExactState(), Sensors(), {}),
    "exact state, delay 3": (ExactState(), Sensors({"overpotential_V": 1e-3}, delay_steps=3), {}),
    "open loop": (Propagated(()), Sensors(), {"soc": 1e-3}),
    "Kalman filter": (KALMAN, NOISY, {"soc": 1e-4}),
    "Kalman filter, delay 1": (KALMAN, replace(NOISY, delay_steps=1), {}),
}
THETA = (0.05, -0.02, 0.1, 0.03, 0.0, 0.02, 0.01)


def loop(charging, name):
    estimator, sensors, process = LOOPS[name]
    controller = replace(controller_of(charging), estimator=estimator)
    return controller, replace(plant_of(charging), sensors=sensors, process_noise_sd=process)


@pytest.mark.parametrize("name", LOOPS)
def test_virtual_machine_and_step_by_step(charging, same, name):
    controller, plant = loop(charging, name)
    whole = simulate(controller, plant, steps=120, theta=THETA, seed=4, compiled=False)
    same(whole, run_episode(controller, plant, steps=120, theta=THETA, seed=4))
    assert (whole.ending, len(whole), whole.failures) == (Ending.DONE, 120, 0)


@pytest.mark.compiled_code
@pytest.mark.parametrize("name", ["all of these", "exact state", "Kalman filter, delay 1"])
def test_compiled_and_step_by_step(charging, same, name):
    controller, plant = loop(charging, name)
    episodes = compiled_episode(controller, plant, 120, compiled=True)
    assert episodes.compiled
    same(episodes.run(THETA, 4), run_episode(controller, plant, steps=120, theta=THETA, seed=4))


def test_what_the_loops_have_in_common_is_not_all(charging):
    # Else the table above would compare a loop with itself.
    episodes = [simulate(*loop(charging, name), steps=120, theta=THETA, seed=4, compiled=False) for name in LOOPS]
    traces = [np.hstack([e.input, e.output_end]) for e in episodes]
    for i, one in enumerate(traces):
        for other in traces[:i]:
            assert np.max(np.abs(one - other)) > 1e-4


def test_more_steps_than_noise_is_drawn_at_first(tank_controller, tank_plant, same):
    plant = tank_plant(sensors=Sensors(noise_sd={"level": 0.05, "gauge": 0.02}), process_noise_sd={"level": 0.05})
    controller = tank_controller()
    whole = simulate(controller, plant, steps=1100, seed=2, compiled=False)
    same(whole, run_episode(controller, plant, steps=1100, seed=2))
    assert np.std(whole.output_end[512:, 0] - whole.arrays()["true_end"][512:, 0]) == pytest.approx(0.05, rel=0.15)
    shorter = simulate(controller, plant, steps=40, seed=2, compiled=False)
    np.testing.assert_array_equal(shorter.input, whole.input[:40])


def test_seeds(tank_controller, tank_plant):
    plant, controller = tank_plant(sensors=Sensors(noise_sd={"level": 0.05})), tank_controller()
    one, again, other = (simulate(controller, plant, steps=40, seed=s, compiled=False) for s in (1, 1, 2))
    np.testing.assert_array_equal(one.input, again.input)
    assert not np.array_equal(one.input, other.input)


def test_parameters_and_start_are_run_time_values(tank_controller, tank_plant, tank, same):
    controller = tank_controller()
    for plant in (tank_plant(), SimulatedPlant(tank.with_parameters(leak=0.8, splash=0.1), {"level": 0.5})):
        episodes = compiled_episode(controller, plant, 40, compiled=False)
        same(episodes.run(), run_episode(controller, plant, steps=40))
        first = compiled_episode(controller, tank_plant(), 40, compiled=False)
        assert episodes.function is first.function


TRIPS = {
    "at rest": ((Trip("gauge", upper=0.9),), {}),
    "at rest, noisy": ((Trip("level", lower=0.99),), {"sensors": Sensors(noise_sd={"level": 0.2})}),
    "start of an interval": ((Trip("gauge", upper=1.6),), {}),
    "lower side": ((Trip("level", lower=1.2),), {"process_noise_sd": {"level": 0.3}}),
    "two": ((Trip("level", upper=1.79), Trip("gauge", upper=1.85)), {}),
    "never": ((Trip("gauge", -5.0, 50.0),), {}),
}


@pytest.mark.parametrize("name", TRIPS)
def test_trips_cut_at_the_same_interval(tank_controller, tank_plant, same, name):
    trips, more = TRIPS[name]
    controller, plant = tank_controller(), tank_plant(**more)
    for seed in range(5):
        whole = simulate(controller, plant, steps=40, seed=seed, trips=trips, compiled=False)
        same(whole, run_episode(controller, plant, steps=40, seed=seed, trips=trips))
        if name == "never":
            assert (whole.ending, len(whole)) == (Ending.DONE, 40)
        elif not more:
            assert whole.ending is Ending.LIMIT
            assert (len(whole) == 0) == (name == "at rest")


def test_a_solver_without_a_number_ends_both_ways(tank_controller, tank_plant, same):
    controller = tank_controller(cost=lambda s: ca.sqrt(s.theta["limit"]) * (s.x["level"] - s.x_d["level"]) ** 2)
    whole = simulate(controller, tank_plant(), steps=40, theta=[-1.0], compiled=False)
    same(whole, run_episode(controller, tank_plant(), steps=40, theta=[-1.0]))
    assert (whole.ending, len(whole)) == (Ending.SOLVER, BLIND_MAX)


def odd(tank, level, gauge):
    """A tank of which the next level and the gauge are given expressions of level and inflow."""
    return Model.build(
        "odd", states=tank.states, inputs=tank.inputs, outputs=tank.outputs, parameters={}, sampling_time_s=2.0,
        equations=lambda x, u, _p: ({"level": level(x["level"], u["inflow"])}, {"level": x["level"], "gauge": gauge(x["level"])}),
    )  # fmt: skip


def test_a_gauge_without_a_number_ends_both_ways(tank_controller, tank, same):
    # The root is no number above level 1.5.
    plant = SimulatedPlant(odd(tank, lambda x, u: 0.9 * x + u, lambda x: ca.sqrt(1.5 - x)), {"level": 1.0})
    whole = simulate(tank_controller(), plant, steps=40, compiled=False)
    same(whole, run_episode(tank_controller(), plant, steps=40))
    assert whole.ending is Ending.SENSOR
    assert len(whole) < 10


@pytest.mark.parametrize("trips", [(), (Trip("level", upper=1e20),)])
def test_a_state_that_is_not_finite_ends_both_ways(tank_controller, tank, same, trips):
    plant = SimulatedPlant(odd(tank, lambda x, u: 1e100 * x + u, lambda x: x), {"level": 1.0})
    whole = simulate(tank_controller(), plant, steps=40, trips=trips, compiled=False)
    same(whole, run_episode(tank_controller(), plant, steps=40, trips=trips))
    assert (whole.ending, len(whole)) == ((Ending.LIMIT, 1) if trips else (Ending.PLANT, 3))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"steps": 0}, "steps = 0, allowed is an integer >= 1"),
        ({"steps": 2.5}, "steps = 2.5, allowed is an integer >= 1"),
        ({"seed": -1}, "seed = -1, allowed is an integer >= 0"),
        ({"theta": [9.0]}, r"theta: limit = 9, allowed is \[-1, 5\]"),
        ({"trips": [Trip("voltage", upper=1.0)]}, r"trip of unknown \['voltage'\], allowed are level, gauge"),
    ],
)
def test_refuses_what_step_by_step_refuses(tank_controller, tank_plant, arguments, message):
    with pytest.raises(ValueError, match=message):
        simulate(tank_controller(), tank_plant(), **({"steps": 40, "compiled": False} | arguments))


# A fresh process: prints whether it is compiled, and the last input to the last bit.
PROGRAM = """
import sys
from chargetune.battery.cell.cell import default_cell
from chargetune.battery.charging.controller import controller_of
from chargetune.battery.charging.evaluate import plant_of
from chargetune.battery.charging.problem import ChargingProblem
from chargetune.battery.charging.settings import ControllerSettings
from chargetune.episode.compiled import compiled_episode
problem = ChargingProblem(default_cell(), controller=ControllerSettings(horizon=2, mismatch_seed=0))
episodes = compiled_episode(controller_of(problem), plant_of(problem), 8)
print(episodes.compiled, episodes.run().input[-1, 0].hex())
"""


def fresh(**environment):
    kept = {name: value for name, value in os.environ.items() if not name.startswith("CHARGETUNE")}
    done = subprocess.run(
        [sys.executable, "-W", "error::RuntimeWarning", "-c", PROGRAM], env=kept | environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


@pytest.mark.compiled_code
def test_a_fresh_process_loads_what_was_compiled_before(tmp_path):
    log, wrapper, cache = tmp_path / "calls", tmp_path / "counting-cc", tmp_path / "cache"
    wrapper.write_text(f'#!/bin/sh\necho called >> "{log}"\nexec "{find_compiler()}" "$@"\n')
    wrapper.chmod(0o755)
    environment = {"CHARGETUNE_CC": str(wrapper), "CHARGETUNE_CACHE": str(cache)}
    first = fresh(**environment)
    calls, libraries = log.read_text(), sorted(cache.iterdir())
    assert first[0] == "True"
    assert calls
    assert len(libraries) == len(calls.splitlines())
    assert fresh(**environment) == first
    assert log.read_text() == calls
    assert sorted(cache.iterdir()) == libraries


def test_no_compiler_means_the_virtual_machine(tmp_path):
    compiled, current = fresh(CHARGETUNE_CC="none", CHARGETUNE_CACHE=str(tmp_path))
    assert compiled == "False"
    assert 0.0 <= float.fromhex(current) <= 6.0
    assert not list(tmp_path.iterdir())


@pytest.fixture
def broken_compiler(monkeypatch, tmp_path):
    monkeypatch.setenv("CHARGETUNE_CC", "false")
    monkeypatch.setenv("CHARGETUNE_CACHE", str(tmp_path))


@pytest.mark.usefixtures("broken_compiler")
def test_a_broken_compiler_is_named_and_the_virtual_machine_stands_in(tank_controller, tank_plant, same):
    controller, plant = tank_controller(), tank_plant()
    with pytest.warns(RuntimeWarning, match=r"virtual machine.*: the C compiler failed: .*/false") as told:
        episodes = compiled_episode(controller, plant, 17)
    assert not episodes.compiled
    assert Path(told[0].filename).name == "test_compiled.py"
    same(episodes.run(), run_episode(controller, plant, steps=17))
    # It is tried once a content, not once an episode.
    assert compiled_episode(controller, plant, 17).function is episodes.function


@pytest.mark.usefixtures("broken_compiler")
def test_a_broken_compiler_is_an_error_when_compiling_is_insisted_on(tank_controller, tank_plant):
    with pytest.raises(RuntimeError, match="the C compiler failed"):
        compiled_episode(tank_controller(), tank_plant(), 18, compiled=True)
    assert not compiled_episode(tank_controller(), tank_plant(), 18, compiled=False).compiled


def test_insisting_without_a_compiler(tank_controller, tank_plant, monkeypatch):
    monkeypatch.setenv("CHARGETUNE_CC", "none")
    assert not compiled_episode(tank_controller(), tank_plant(), 19).compiled
    with pytest.raises(RuntimeError, match="no C compiler found; set CHARGETUNE_CC"):
        compiled_episode(tank_controller(), tank_plant(), 19, compiled=True)


@pytest.mark.compiled_code
def test_a_cache_that_cannot_be_written(tank_controller, tank_plant, monkeypatch, tmp_path):
    blocked = tmp_path / "a file"
    blocked.write_text("")
    monkeypatch.setenv("CHARGETUNE_CACHE", str(blocked))
    with pytest.warns(RuntimeWarning, match=r"virtual machine.*a file"):
        assert not compiled_episode(tank_controller(), tank_plant(), 20).compiled
    with pytest.raises(OSError, match="a file"):
        compiled_episode(tank_controller(), tank_plant(), 20, compiled=True)


@pytest.mark.compiled_code
@pytest.mark.parametrize("count", [1, 5, 37])
def test_an_ensemble_is_one_loop_after_the_other(charging, same, count):
    controller, plant = loop(charging, "all of these")
    episodes = compiled_episode(controller, plant, 40)
    draws = np.random.default_rng(0).uniform(0.7, 1.3, count)
    nominal = np.array(dict(plant.model.parameters)["R0_ohm"])
    plants = [replace(plant, model=plant.model.with_parameters(R0_ohm=tuple(f * nominal)), start={"soc": 0.1 * f}) for f in draws]
    thetas = [f * np.array(THETA) for f in draws]
    together = episodes.run_each(thetas, plants, seed=3)
    assert len(together) == count
    for theta, one, episode in zip(thetas, plants, together, strict=True):
        same(episode, replace(episodes, plant=one).run(theta, 3))


LATTICE = LookupTable.over({"soc": (0.0, 1.0), "current_A": (-1.0, 12.0)}, ["voltage_V", "soc"])


# Compiled once: the loop that has everything in it.
@pytest.mark.parametrize(
    ("name", "compiled"), [("ideal", False), ("noise", False), ("Kalman filter, delay 1", False), ("Kalman filter, delay 1", None)]
)
def test_a_constant_table_is_the_bias_of_a_sensor(charging, name, compiled):
    controller, plant = loop(charging, name)
    off = {"voltage_V": 4e-3, "soc": 0.01}
    biased = replace(plant, sensors=replace(plant.sensors, bias={k: plant.sensors.bias.get(k, 0.0) + v for k, v in off.items()}))
    table = np.tile([[v] for v in off.values()], LATTICE.size)
    episodes = compiled_episode(controller, plant, 40, compiled=compiled, lookup_table=LATTICE)
    episode = episodes.run_each([THETA], [plant], 3, [table])[0]
    whole = compiled_episode(controller, biased, 40, compiled=compiled).run(THETA, 3)
    assert np.max(np.abs(episode.input - episodes.run(THETA, 3).input)) > 1e-3
    # Rounding of the error that is added in another order, and what a solver makes of it.
    for mine, other in ((episode.input, whole.input), (episode.output_start, whole.output_start), (episode.output_end, whole.output_end)):
        np.testing.assert_allclose(mine, other, rtol=0, atol=1e-6)


@pytest.mark.usefixtures("virtual_machine")
def test_without_a_table_a_lattice_changes_nothing(charging, same):
    controller, plant = loop(charging, "Kalman filter, delay 1")
    same(compiled_episode(controller, plant, 40, lookup_table=LATTICE).run(THETA, 3), compiled_episode(controller, plant, 40).run(THETA, 3))


@pytest.mark.usefixtures("virtual_machine")
def test_what_is_measured_is_the_truth_and_the_table_there(charging):
    controller, plant = loop(charging, "ideal")
    table = np.random.default_rng(0).normal(0.0, 3e-3, (2, LATTICE.size))
    episode = compiled_episode(controller, plant, 40, lookup_table=LATTICE).run_each([THETA], [plant], tables=[table])[0]
    columns = [episode.output_names.index(name) for name in LATTICE.outputs]
    for measured, true in ((episode.output_start, episode.true_start), (episode.output_end, episode.true_end)):
        at = np.stack([true[:, episode.output_names.index("soc")], episode.input[:, 0]], axis=1)
        for row, column in zip(table, columns, strict=True):
            grid = [np.linspace(low, high, count) for (_, low, high), count in zip(LATTICE.ranges, LATTICE.counts, strict=True)]
            added = RegularGridInterpolator(grid, row.reshape(LATTICE.counts))(at)
            assert np.max(np.abs(added)) > 1e-3
            np.testing.assert_allclose(measured[:, column] - true[:, column], added, rtol=0, atol=1e-12)


@pytest.mark.usefixtures("virtual_machine")
def test_an_ensemble_refuses_what_does_not_belong_to_it(charging):
    controller, plant = loop(charging, "ideal")
    episodes = compiled_episode(controller, plant, 10)
    with pytest.raises(ValueError, match="2 thetas, 1 plant, 1 seed, 1 table and 1 given, allowed are as many of each"):
        episodes.run_each([THETA, THETA], [plant])
    other = replace(plant, model=replace(plant.model, f=ca.Function("f", list(plant.model.f.sx_in()), [plant.model.f.sx_in()[0]])))
    with pytest.raises(ValueError, match=r"plants\[1\] has another model"):
        episodes.run_each([THETA, THETA], [plant, other])
    with pytest.raises(ValueError, match="built without a lookup_table"):
        episodes.run_each([THETA], [plant], tables=[np.zeros((2, LATTICE.size))])
    with pytest.raises(ValueError, match=r"a table has the shape \(2, 9\), allowed is \(2, 495\): outputs, nodes"):
        compiled_episode(controller, plant, 10, lookup_table=LATTICE).run_each([THETA], [plant], tables=[np.zeros((2, 9))])
    with pytest.raises(ValueError, match="table over 'temperature_K', allowed are voltage_V, soc"):
        compiled_episode(controller, plant, 10, lookup_table=LookupTable.over({"soc": (0.0, 1.0)}, ["temperature_K"]))
    with pytest.raises(ValueError, match="allowed are 1 to 3 signals"):
        LookupTable.over({}, ["voltage_V"])
