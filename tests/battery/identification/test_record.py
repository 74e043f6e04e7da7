"""Measurements: the sign of the current settled, rests ended where the current began, arrays that do not fit refused."""

import numpy as np
import pytest

from chargetune.battery.identification.plausibility import checked
from chargetune.battery.identification.record import Record


def record(rows, **more):
    time, current, voltage = np.array(rows, dtype=float).T
    return Record("mine", time, current, voltage, **more)


def test_the_sign_is_found_without_a_jump():
    falling = [(10.0 * k, 2.0, 4.1 - 0.001 * k) for k in range(50)]
    found = checked(record(falling))
    np.testing.assert_array_equal(found.current_A, -2.0)
    assert "sign was changed" in found.remarks[0]
    rising = [(t, i, 8.2 - v) for t, i, v in falling]
    np.testing.assert_array_equal(checked(record(rising)).current_A, 2.0)


def test_a_rest_lasts_until_its_current_began():
    """Logged every minute at rest and every half second in the pulse: the pulse is 1 s long and passes 1 s of current, not 41 s."""
    rows = [(0, 0, 3.6), (60, 0, 3.6), (100.5, -2, 3.5), (101, -2, 3.49), (102, 0, 3.55)]
    warm = np.array([298.0, 299.0, 300.0, 301.0, 302.0])
    found = checked(record(rows, temperature_K=warm))
    np.testing.assert_allclose(found.time_s, [0, 60, 100, 100.5, 101, 102])
    np.testing.assert_allclose(found.current_A, [0, 0, 0, -2, -2, 0])
    np.testing.assert_allclose(found.voltage_V, [3.6, 3.6, 3.6, 3.5, 3.49, 3.55])
    np.testing.assert_allclose(found.temperature_K, [298, 299, 299, 300, 301, 302])
    assert found.charge_Ah[-1] == pytest.approx(-2.0 / 3600)
    assert found.remarks == ("no sample at the end of 1 rest; each was taken to last until its current began",)


def test_a_rest_with_its_end_is_left_alone():
    rows = [(0, 0, 3.6), (60, 0, 3.6), (60.5, -2, 3.5), (61, -2, 3.49), (62, 0, 3.55)]
    found = checked(record(rows))
    assert len(found) == 5
    assert found.remarks == ()


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        ([(0, 0, 3.6), (10, 1, 3.7), (9, 1, 3.7)], r"mine, sample 3: time_s = 9 after 10"),
        ([(0, 0, 3.6), (10, np.nan, 3.7)], r"mine: current_A .* allowed: 2 finite numbers"),
    ],
)
def test_a_record_that_is_none_is_refused(rows, said):
    with pytest.raises(ValueError, match=said):
        record(rows)


def test_arrays_of_two_lengths_are_refused():
    with pytest.raises(ValueError, match=r"voltage_V of shape \(2,\), allowed: 3"):
        Record("mine", np.arange(3.0), np.ones(3), np.ones(2))
