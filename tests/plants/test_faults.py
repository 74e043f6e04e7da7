"""Faulty: what each fault makes of a known trajectory."""

import math

import numpy as np
import pytest

from chargetune.plants.faults import Fault, FaultKind, Faulty
from chargetune.plants.plant import PlantError
from chargetune.plants.sensors import Sensors

INPUTS = np.array([0.5, 0.1, -0.3, 0.2, 0.4, 0.0])


def run(plant):
    first = plant.reset(0)
    return [first, *(plant.step(np.array([u])) for u in INPUTS)]


def table(measurements, name):
    return np.array([getattr(m, name) for m in measurements])


# What the faulty `end` and `start` of intervals 2..3 are, from the sound ones; row k + 1 of the tables is interval k.
EXPECTED = {
    FaultKind.MISSING: lambda _start, _end: ([[math.nan] * 2] * 2, [[math.nan] * 2] * 2),
    FaultKind.STUCK: lambda _start, end: ([end[2], end[2]], [end[2], end[2]]),
    FaultKind.SPIKE: lambda start, end: ([start[3], start[4]], [end[3] + 0.7, end[4]]),
    FaultKind.BIAS: lambda start, end: ([start[3] + 0.7, start[4] + 0.7], [end[3] + 0.7, end[4] + 0.7]),
    FaultKind.REVERSED: lambda start, end: ([-start[3], -start[4]], [-end[3], -end[4]]),
    FaultKind.LATE: lambda start, end: ([start[2], start[3]], [end[2], end[3]]),
}


@pytest.mark.parametrize("kind", EXPECTED)
@pytest.mark.parametrize("signals", [(), ("gauge",)])
def test_measurement_faults(make, kind, signals):
    sound = run(make())
    wrong = run(Faulty(make(), [Fault(kind, 2, 3, signals, size=0.7)]))
    start, end = EXPECTED[kind](table(sound, "start"), table(sound, "end"))
    hit = [True, True] if not signals else [False, True]
    for name, struck in (("start", start), ("end", end), ("received", end)):
        expected = table(sound, name)
        expected[3:5] = np.where(hit, struck, expected[3:5])
        np.testing.assert_array_equal(table(wrong, name), expected)
    # The truth of the simulation is not touched.
    for name in ("true_start", "true_end", "state"):
        np.testing.assert_array_equal(table(wrong, name), table(sound, name))


def test_an_ignored_set_point_leaves_the_plant_with_the_one_before(make):
    plant = Faulty(make(), [Fault(FaultKind.IGNORED, 1, 2)])
    wrong = run(plant)
    reference = make()
    reference.reset(0)
    for k, u in enumerate((INPUTS[0], INPUTS[0], INPUTS[0], *INPUTS[3:])):
        np.testing.assert_array_equal(reference.step(np.array([u])).end, wrong[k + 1].end)


def test_ignored_from_the_start_means_no_input(make):
    plant = Faulty(make(), [Fault(FaultKind.IGNORED, 0, 0)])
    plant.reset(0)
    assert plant.step(np.array([5.0])).state == pytest.approx([0.9])


def test_lost(make):
    plant = Faulty(make(), [Fault(FaultKind.LOST, 1, 1)])
    plant.reset(0)
    plant.step(np.array([0.0]))
    with pytest.raises(PlantError, match="no answer from the plant in step 1"):
        plant.step(np.array([0.0]))


def test_faults_add_up_in_their_order(make):
    sound = run(make())
    both = [Fault(FaultKind.BIAS, 1, 1, size=1.0), Fault(FaultKind.REVERSED, 1, 1)]
    np.testing.assert_array_equal(run(Faulty(make(), both))[2].end, -(sound[2].end + 1.0))
    np.testing.assert_array_equal(run(Faulty(make(), both[::-1]))[2].end, -sound[2].end + 1.0)


def test_a_stuck_sensor_is_stuck_anew_after_a_reset(make):
    plant = Faulty(make(sensors=Sensors(noise_sd={"level": 0.1})), [Fault(FaultKind.STUCK, 0, 9)])
    for seed in (1, 2):
        rest = plant.reset(seed)
        for _ in range(3):
            np.testing.assert_array_equal(plant.step(np.array([1.0])).end, rest.end)


def test_it_is_the_plant_it_wraps(make):
    plant = make()
    faulty = Faulty(plant, [])
    assert (faulty.inputs, faulty.outputs, faulty.sampling_time_s) == (plant.inputs, plant.outputs, plant.sampling_time_s)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("stuck", 0, 1), "kind = 'stuck', allowed are missing, stuck, spike"),
        ((FaultKind.STUCK, -1, 1), "fault stuck: first = -1, allowed is an integer >= 0"),
        ((FaultKind.STUCK, True, 1), "fault stuck: first = True, allowed is an integer >= 0"),
        ((FaultKind.STUCK, 3, 2), "fault stuck: last = 2, allowed is an integer >= 3"),
        ((FaultKind.BIAS, 0, 1, (), math.nan), "fault bias: size = nan, allowed is a finite number"),
    ],
)
def test_refuses(arguments, message):
    with pytest.raises(ValueError, match=message):
        Fault(*arguments)


def test_refuses_an_unknown_signal(make):
    with pytest.raises(ValueError, match=r"signals names unknown \['voltage_V'\], allowed are level, gauge"):
        Faulty(make(), [Fault(FaultKind.BIAS, 0, 1, ("voltage_V",))])
