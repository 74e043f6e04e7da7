"""Figures of merit of a charge, in closed form and by hand."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from chargetune.battery.charging.metrics import charging_metrics, crossing_minutes


@pytest.mark.parametrize(
    ("time_s", "soc", "mark", "minutes"),
    [
        ([0, 60, 120], [0.0, 0.5, 1.0], 0.25, 0.5),
        ([0, 60, 120], [0.0, 0.5, 1.0], 0.5, 1.0),
        ([0, 60, 120], [0.0, 0.5, 1.0], 1.0, 2.0),
        ([0, 60, 120], [0.0, 0.5, 0.9], 0.95, None),
        ([0, 60, 120], [0.9, 0.95, 0.99], 0.8, 0.0),
        ([30, 60, 120], [0.9, 0.95, 0.99], 0.8, 0.5),
        # The first time counts, also when the SOC falls again.
        ([0, 60, 120, 180], [0.0, 0.8, 0.6, 0.9], 0.7, 0.875),
        ([0, 60, 180], [0.5, 0.5, 0.75], 0.625, 2.0),
        ([0, 60, 120], [0.5, 0.5, 0.5], 0.5, 0.0),
    ],
)
def test_crossing(time_s, soc, mark, minutes):
    found = crossing_minutes(np.array(time_s, dtype=float), np.array(soc), mark)
    assert found == (None if minutes is None else pytest.approx(minutes, abs=1e-12))


@given(st.floats(0.01, 0.9), st.floats(0.02, 2.0), st.integers(2, 200))
def test_crossing_of_a_straight_line_is_exact(start, hours, samples):
    time = np.linspace(0.0, 3600 * hours, samples)
    soc = start + (1.0 - start) * time / time[-1]
    mark = start + 0.37 * (1.0 - start)
    assert crossing_minutes(time, soc, mark) == pytest.approx(0.37 * 60 * hours, rel=1e-9)


def test_by_hand(by_hand):
    # Four intervals of 10 s, limit 4.2 V: over by 0 and 10 mV, 20 and 40 mV, 0 and 0 (below), -5 and 5 mV.
    found = charging_metrics(by_hand, 4.2, 0.70)
    assert found["t80_min"] == pytest.approx((0.80 - 0.75) / (0.85 - 0.75) * 10 / 60 + 10 / 60)
    assert found["t90_min"] == pytest.approx(20 / 60 + 10 / 60)
    assert found["t95_min"] == pytest.approx((30 + 10 * 0.05 / 0.08) / 60)
    assert found["t99_min"] is None
    assert found["overshoot_mV"] == pytest.approx(40.0)
    assert found["overshoot_mVs"] == pytest.approx(10 * ((0 + 10) / 2 + (20 + 40) / 2 + 0 + (0 + 5) / 2))
    assert found["switch_min"] == pytest.approx(20 / 60)
    assert found["soc_end"] == 1.0 - 0.02
    assert found["solver_failures"] == 1.0


def test_overshoot_is_signed(by_hand):
    assert charging_metrics(by_hand, 4.3, 0.70)["overshoot_mV"] == pytest.approx(-60.0)
    assert charging_metrics(by_hand, 4.3, 0.70)["overshoot_mVs"] == 0.0


def test_no_switch_in_a_charge_of_constant_current(by_hand):
    assert charging_metrics(by_hand.cut(2, by_hand.ending, ""), 4.2, 0.70)["switch_min"] is None
