"""run_episode: it always returns, the plant is closed once, and no fault lets an input leave its limits."""

import math
import signal
from dataclasses import dataclass, field, replace

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from chargetune.battery.charging.controller import controller_of
from chargetune.battery.charging.evaluate import plant_of
from chargetune.control.control_step import act
from chargetune.control.estimators import ExactState, Propagated
from chargetune.control.kalman import ExtendedKalman
from chargetune.control.sqp import SolveStatus
from chargetune.episode.episode import BLIND_MAX, Ending, Trip
from chargetune.episode.stepwise import run_episode, signal_indices
from chargetune.model.model import Model, Signal
from chargetune.plants.faults import Fault, FaultKind, Faulty
from chargetune.plants.plant import Measurement, Plant, PlantError
from chargetune.plants.simulated import SimulatedPlant

INFLOW_MAX = 0.5


@dataclass
class Watched:
    """A plant that counts what is done to it, and does ``event`` instead of interval ``at`` (-1: of the reset)."""

    plant: Plant
    event: object = None
    at: int = 10**9
    broken_close: bool = False
    inputs_seen: list = field(default_factory=list)
    resets: int = 0
    closes: int = 0

    @property
    def inputs(self):
        return self.plant.inputs

    @property
    def outputs(self):
        return self.plant.outputs

    @property
    def sampling_time_s(self):
        return self.plant.sampling_time_s

    def reset(self, seed):
        self.resets += 1
        measurement = self.plant.reset(seed)
        return self.event(measurement) if self.at == -1 else measurement

    def step(self, u):
        self.inputs_seen.append(u)
        measurement = self.plant.step(u)
        return self.event(measurement) if len(self.inputs_seen) - 1 == self.at else measurement

    def close(self):
        self.closes += 1
        if self.broken_close:
            raise OSError("relay stuck")


def throw(error):
    def event(_measurement):
        raise error

    return event


def interrupt(measurement):
    signal.raise_signal(signal.SIGINT)
    return measurement


def one_number(measurement):
    return replace(measurement, end=np.zeros(1))


# What happens in interval 4 -> ending, part of the message.
EVENTS = {
    "plant error": (throw(PlantError("solver of the plant failed")), Ending.PLANT, "solver of the plant failed"),
    "any other error": (throw(ZeroDivisionError("in the driver")), Ending.PLANT, "the plant raised ZeroDivisionError: in the driver"),
    "lost connection": (throw(ConnectionResetError("cable")), Ending.PLANT, "the plant raised ConnectionResetError: cable"),
    "wrong shape": (one_number, Ending.PLANT, "the plant's measurement end has shape (1,), expected (2,)"),
    "interrupt": (interrupt, Ending.INTERRUPTED, "interrupted by the user"),
}


@pytest.mark.parametrize("name", EVENTS)
@pytest.mark.parametrize("at", [-1, 0, 4])
def test_events(tank_controller, tank_plant, name, at):
    event, ending, message = EVENTS[name]
    plant = Watched(tank_plant(), event, at)
    episode = run_episode(tank_controller(), plant, steps=9)
    assert episode.ending is ending
    assert message in episode.message
    assert (plant.resets, plant.closes) == (1, 1)
    # What happened until then is kept, and is what happens without the event.
    kept = max(at, 0)
    assert len(episode) == kept
    whole = run_episode(tank_controller(), tank_plant(), steps=9)
    for array in ("input", "output_end", "estimate"):
        np.testing.assert_array_equal(getattr(episode, array), getattr(whole, array)[:kept])
    assert len(episode.arrays().get("state", [0])) == kept + 1
    # A trace of any length can be stored.
    assert type(episode).from_arrays(episode.arrays(), episode.meta()).meta() == episode.meta()


def test_a_system_exit_passes_and_the_plant_is_closed(tank_controller, tank_plant):
    plant = Watched(tank_plant(), throw(SystemExit(3)), 2)
    with pytest.raises(SystemExit):
        run_episode(tank_controller(), plant, steps=5)
    assert plant.closes == 1


@pytest.mark.parametrize(("at", "before"), [(10**9, ""), (3, "; cable")])
def test_a_plant_that_cannot_be_closed_is_the_news(tank_controller, tank_plant, at, before):
    plant = Watched(tank_plant(), throw(PlantError("cable")), at, broken_close=True)
    episode = run_episode(tank_controller(), plant, steps=6)
    assert episode.ending is Ending.PLANT
    assert episode.message == "the plant could not be closed: OSError: relay stuck" + before
    assert len(episode) == min(at, 6)
    assert plant.closes == 1


def out_of_memory(_u):
    raise RuntimeError("out of memory")


@pytest.mark.parametrize(
    ("fourth", "message"),
    [
        (out_of_memory, "the controller raised RuntimeError: out of memory"),
        (lambda u: u * math.nan, "the controller raised ValueError: input = [nan], allowed: 1 finite number"),
        (lambda u: np.concatenate([u, u]), "allowed: 1 finite number"),
    ],
)
def test_a_broken_control_step_leaves_the_plant_safe(tank_controller, tank_plant, fourth, message):
    plant = Watched(tank_plant())

    def control(*arguments):
        u, memory, info = act(*arguments)
        return (fourth(u) if len(plant.inputs_seen) == 3 else u), memory, info

    episode = run_episode(tank_controller(), plant, steps=9, control=control)
    assert (episode.ending, len(episode), len(plant.inputs_seen), plant.closes) == (Ending.SOLVER, 3, 3, 1)
    assert message in episode.message


def test_a_blind_controller_stops(tank_controller, tank_plant):
    plant = Watched(Faulty(tank_plant(), [Fault(FaultKind.MISSING, 4, 100)]))
    episode = run_episode(tank_controller(), plant, steps=20)
    assert (episode.ending, len(episode), plant.closes) == (Ending.SENSOR, 4 + BLIND_MAX, 1)
    assert len(plant.inputs_seen) == 4 + BLIND_MAX
    # The estimator's own prediction stood in for the missing measurement.
    assert set(episode.status) == {SolveStatus.CONVERGED}


def test_a_short_dropout_is_ridden_out(tank_controller, tank_plant):
    faults = [Fault(FaultKind.MISSING, 4, 3 + BLIND_MAX - 1)]
    episode = run_episode(tank_controller(), Faulty(tank_plant(), faults), steps=20)
    whole = run_episode(tank_controller(), tank_plant(), steps=20)
    assert (episode.ending, len(episode)) == (Ending.DONE, 20)
    np.testing.assert_allclose(episode.arrays()["state"], whole.arrays()["state"], rtol=0, atol=1e-3)


def test_a_solver_that_gives_no_number_stops_on_the_declared_fallback(tank_controller, tank_plant):
    controller = tank_controller(cost=lambda s: ca.sqrt(s.theta["limit"]) * (s.x["level"] - s.x_d["level"]) ** 2)
    plant = Watched(tank_plant())
    episode = run_episode(controller, plant, steps=20, theta=[-1.0])
    assert (episode.ending, len(episode), plant.closes) == (Ending.SOLVER, BLIND_MAX, 1)
    assert set(episode.status) == {SolveStatus.FALLBACK}
    assert [u.tolist() for u in plant.inputs_seen] == [[0.125]] * BLIND_MAX
    assert episode.failures == BLIND_MAX


def test_a_state_that_is_not_finite_ends_with_the_plant(tank_controller, tank):
    burst = Model.build(
        "burst", states=tank.states, inputs=tank.inputs, outputs=tank.outputs, parameters={"growth": 1e100}, sampling_time_s=2.0,
        equations=lambda x, _u, p: ({"level": p["growth"] * x["level"]}, {"level": x["level"], "gauge": x["level"]}),
    )  # fmt: skip
    episode = run_episode(tank_controller(), SimulatedPlant(burst, {"level": 1.0}), steps=20)
    assert (episode.ending, len(episode)) == (Ending.PLANT, 3)
    assert "not finite after step 3: [inf]" in episode.message
    assert np.all(np.isfinite(episode.arrays()["state"]))


@pytest.mark.parametrize(("upper", "length"), [(0.9, 0), (1.6, 2), (1e9, 12)])
def test_a_trip_ends_the_episode_whatever_the_controller_wants(tank_controller, tank_plant, upper, length):
    plant = Watched(tank_plant())
    episode = run_episode(tank_controller(), plant, steps=12, trips=[Trip("gauge", upper=upper)])
    assert len(episode) == len(plant.inputs_seen) == length
    assert plant.closes == 1
    assert episode.ending is (Ending.DONE if length == 12 else Ending.LIMIT)
    if length:
        before = episode.output_end[:-1, 1]
        assert np.all(before <= upper)


def test_an_instrument_has_no_true_state(tank_controller, tank_plant):
    def forget(m):
        return Measurement(m.start, m.end, m.received)

    plant = Watched(tank_plant(), forget, 2)
    episode = run_episode(tank_controller(), plant, steps=4)
    assert (episode.ending, episode.state, episode.true_start, episode.true_end) == (Ending.DONE, None, None, None)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"steps": 0}, "steps = 0, allowed is an integer >= 1"),
        ({"steps": True}, "steps = True, allowed is an integer >= 1"),
        ({"steps": 2.0}, "steps = 2.0, allowed is an integer >= 1"),
        ({"seed": -1}, "seed = -1, allowed is an integer >= 0"),
        ({"theta": [9.0]}, r"theta: limit = 9, allowed is \[-1, 5\]"),
        ({"theta": [1.0, 1.0]}, r"theta has shape \(2,\), expected \(1,\): limit"),
        ({"trips": [Trip("voltage", upper=1.0)]}, r"trip of unknown \['voltage'\], allowed are level, gauge"),
    ],
)
def test_refused_before_the_plant_is_touched(tank_controller, tank_plant, arguments, message):
    plant = Watched(tank_plant())
    with pytest.raises(ValueError, match=message):
        run_episode(tank_controller(), plant, **({"steps": 3} | arguments))
    assert (plant.resets, plant.closes, plant.inputs_seen) == (0, 0, [])


def other(tank, **changed):
    values = {"states": tank.states, "inputs": tank.inputs, "outputs": tank.outputs, "sampling_time_s": 2.0} | changed
    inflow = values["inputs"][0].name
    return SimulatedPlant(
        Model.build(
            "other", parameters={}, **values,
            equations=lambda x, u, _p: (
                {"level": x["level"] + u[inflow]},
                {s.name: x["level"] for s in values["outputs"]},
            ),
        ),
        {},
    )  # fmt: skip


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"sampling_time_s": 1.0}, "sampling_time_s: plant 1.0, controller 2.0; they must be equal"),
        ({"inputs": (Signal("outflow", "m"),)}, r"the plant's inputs \['outflow'\] are not the controller's \['inflow'\]"),
        ({"outputs": (Signal("gauge", "m"),)}, r"the estimator reads \['level'\], which the plant does not measure; it has gauge"),
    ],
)
def test_a_plant_that_does_not_fit(tank_controller, tank, changed, message):
    with pytest.raises(ValueError, match=message):
        run_episode(tank_controller(), other(tank, **changed), steps=3)


def test_signals_are_found_by_name(tank_controller, tank):
    plant = other(tank, outputs=(Signal("gauge", "m"), Signal("level", "m")))
    assert signal_indices(tank_controller(), plant) == [1]


FAULTS = st.lists(
    st.builds(
        lambda kind, first, length, signals, size: Fault(kind, first, first + length, signals, size),
        st.sampled_from(FaultKind),
        st.integers(0, 19),
        st.integers(0, 19),
        st.sampled_from([(), ("soc",), ("voltage_V",), ("soc", "overpotential_V")]),
        # The larger the error, the further the solver is from anything it was made for.
        st.one_of(st.floats(-10, 10), st.sampled_from([1e3, -1e30, 1e308])),
    ),
    min_size=1,
    max_size=3,
)
ESTIMATORS = {
    "propagated": Propagated(("soc",)),
    "exact": ExactState(),
    "kalman": ExtendedKalman(("voltage_V", "soc"), (5e-3, 1e-3), (1e-4, 1e-3), (1e-2, 1e-2)),
}


@pytest.mark.parametrize("estimator", ESTIMATORS)
@settings(max_examples=40)
@given(faults=FAULTS, seed=st.integers(0, 3))
def test_every_input_is_finite_and_within_its_limits_under_any_fault(charging, estimator, faults, seed):
    controller = replace(controller_of(charging), estimator=ESTIMATORS[estimator])
    plant = Watched(Faulty(plant_of(charging), faults))
    episode = run_episode(controller, plant, steps=20, seed=seed)
    currents = np.array(plant.inputs_seen)
    assert np.all(np.isfinite(currents))
    assert np.all((currents >= 0.0) & (currents <= charging.cell.current_max_A))
    assert plant.closes == 1
    assert len(episode) == 20 or episode.ending is not Ending.DONE
    assert episode.ending in {Ending.DONE, Ending.SENSOR, Ending.SOLVER, Ending.PLANT}


def test_a_voltage_bias_does_not_steer_a_controller_that_does_not_read_it(charging):
    biased = Faulty(plant_of(charging), [Fault(FaultKind.BIAS, 0, 100, ("voltage_V",), 0.010)])
    sound, wrong = (run_episode(controller_of(charging), plant, steps=30) for plant in (plant_of(charging), biased))
    np.testing.assert_array_equal(sound.input, wrong.input)
    np.testing.assert_allclose(wrong.output_end[:, 0] - sound.output_end[:, 0], 0.010, rtol=0, atol=1e-12)


def test_a_latch_outside_the_controller_stops_what_the_controller_does_not_see(charging):
    # The controller's model is wrong: it drives the cell over its limit, which is what the study is about.
    limit = charging.voltage_max_V
    free = run_episode(controller_of(charging), plant_of(charging), steps=120)
    worst = np.maximum(*free.signal("voltage_V"))
    assert worst.max() > limit + 0.01
    stopped = run_episode(controller_of(charging), plant_of(charging), steps=120, trips=[Trip("voltage_V", 2.5, limit + 0.01)])
    assert stopped.ending is Ending.LIMIT
    assert len(stopped) == int(np.argmax(worst > limit + 0.01)) + 1
    assert math.isclose(float(stopped.input[-1, 0]), float(free.input[len(stopped) - 1, 0]))
