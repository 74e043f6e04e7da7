"""The circuit against an independent integration of its differential equations, SciPy's splines and finite differences."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline, PchipInterpolator

from chargetune.battery.cell.cell import default_cell, mismatched
from chargetune.battery.cell.equivalent_circuit import ecm_model, table_nodes

STEP = 10.0
CELL = default_cell()
MODEL = ecm_model(CELL, STEP)
# Keeping the tables positive changes them by less than this share (see the docstring of `ecm_model`).
ROUNDING = 2e-6
# The reference integrator divides by the square of its states, which must not vanish in rounding.
MICROVOLTS = st.integers(-100_000, 300_000).map(lambda i: 1e-6 * i)
MILLIAMPERES = st.integers(-6000, 6000).map(lambda i: 1e-3 * i)


def tables(cell, z):
    """R0, R1, C1 at SOC z by SciPy."""
    nodes = [0.0, *cell.soc, 1.0]
    return [float(CubicSpline(nodes, [t[0], *t, t[-1]], bc_type="natural")(z)) for t in (cell.R0_ohm, cell.R1_ohm, cell.C1_F)]


def following(x, current, model=MODEL):
    return np.array(model.f(x, [current], model.nominal)).ravel()


def outputs(x, current, model=MODEL):
    return np.array(model.h(x, [current], model.nominal)).ravel()


@given(z=st.floats(0.0, 0.99), u1=MICROVOLTS, current=MILLIAMPERES)
@example(z=0.5, u1=0.0, current=0.0)
def test_discretisation_is_exact(z, u1, current):
    _, r1, c1 = tables(CELL, z)

    def rate(_, x):
        return [current / (3600 * CELL.capacity_Ah), (current - x[1] / r1) / c1]

    solution = solve_ivp(rate, (0.0, STEP), [z, u1], method="DOP853", rtol=1e-11, atol=1e-13)
    # U1 is a sum of terms up to 0.3 V, each with the floor's rounding; where they cancel only their size counts.
    np.testing.assert_allclose(following([z, u1], current), solution.y[:, -1], rtol=ROUNDING, atol=0.3 * ROUNDING)


def test_two_half_steps_are_one_step_where_the_tables_are_flat():
    flat = replace(CELL, R0_ohm=(0.06,) * 9, R1_ohm=(0.04,) * 9, C1_F=(1000.0,) * 9)
    half = ecm_model(flat, STEP / 2)
    x = following([0.3, 0.05], 4.0, ecm_model(flat, STEP))
    np.testing.assert_allclose(following(following([0.3, 0.05], 4.0, half), 4.0, half), x, rtol=0, atol=1e-12)


def test_coulomb_counting():
    lossy = replace(CELL, coulombic_efficiency=0.98)
    model = ecm_model(lossy, 36.0)
    assert following([0.2, 0.0], 2.0, model)[0] == pytest.approx(0.2 + 0.98 * 2.0 * 0.01 / 2.0, abs=1e-15)


@given(z=st.floats(0.0, 1.0), u1=st.floats(-0.1, 0.3), current=st.floats(-6.0, 6.0))
def test_voltage(z, u1, current):
    r0, _, _ = tables(CELL, z)
    expected = float(PchipInterpolator(CELL.ocv_soc, CELL.ocv_V)(z)) + u1 + r0 * current
    np.testing.assert_allclose(outputs([z, u1], current), [expected, z, u1], rtol=0, atol=1e-6)


@pytest.mark.parametrize("cell", [CELL, mismatched(CELL, 3)], ids=["true", "wrong"])
@pytest.mark.parametrize("z", np.linspace(0.0, 1.0, 21))
def test_charging_raises_the_voltage_above_the_open_circuit(cell, z):
    model = ecm_model(cell, STEP)
    ocv = outputs([z, 0.0], 0.0, model)[0]
    # The overpotential that has built up, at the same state of charge.
    charged = outputs([z, following([z, 0.0], 3.0, model)[1]], 3.0, model)[0]
    drained = outputs([z, following([z, 0.0], -3.0, model)[1]], -3.0, model)[0]
    assert outputs([z, 0.0], 3.0, model)[0] > ocv > outputs([z, 0.0], -3.0, model)[0]
    assert charged > outputs([z, 0.0], 3.0, model)[0]
    assert drained < outputs([z, 0.0], -3.0, model)[0]


def test_open_circuit_voltage_rises_and_passes_through_its_table():
    fine = np.array([outputs([z, 0.0], 0.0)[0] for z in np.linspace(-0.05, 1.05, 2201)])
    assert np.all(np.diff(fine) > 0)
    at_nodes = [outputs([z, 0.0], 0.0)[0] for z in CELL.ocv_soc]
    np.testing.assert_allclose(at_nodes, CELL.ocv_V, rtol=0, atol=1e-9)


def resistance(model, z, current=1e3):
    return (outputs([z, 0.0], current, model)[0] - outputs([z, 0.0], 0.0, model)[0]) / current


def test_tables_pass_through_their_nodes_and_stay_constant_beyond():
    for z, r0 in zip(CELL.soc, CELL.R0_ohm, strict=True):
        assert resistance(MODEL, z) == pytest.approx(r0, rel=ROUNDING)
    assert resistance(MODEL, 0.0) == pytest.approx(CELL.R0_ohm[0], rel=ROUNDING)
    assert resistance(MODEL, 1.0) == pytest.approx(CELL.R0_ohm[-1], rel=ROUNDING)


@given(st.lists(st.floats(1e-4, 1.0), min_size=9, max_size=9))
def test_no_table_goes_below_zero_between_its_nodes(values):
    model = ecm_model(CELL, STEP).with_parameters(R0_ohm=values, R1_ohm=values, C1_F=[1e4 * v for v in values])
    for z in np.linspace(-0.1, 1.1, 61):
        assert resistance(model, z) > 0
        # Stable: without current the overpotential dies away and does not change its sign.
        assert 0.0 <= following([z, 0.1], 0.0, model)[1] < 0.1


@pytest.mark.parametrize(
    ("soc", "nodes"),
    [
        ((0.1, 0.5, 0.9), [0.0, 0.1, 0.5, 0.9, 1.0]),
        ((0.0, 0.5, 1.0), [0.0, 0.5, 1.0]),
        ((0.0, 0.5), [0.0, 0.5, 1.0]),
    ],
)
def test_table_nodes(soc, nodes):
    assert table_nodes(soc) == nodes
    cell = replace(CELL, soc=soc, **{n: getattr(CELL, n)[: len(soc)] for n in ("R0_ohm", "R1_ohm", "C1_F")})
    assert resistance(ecm_model(cell), soc[1]) == pytest.approx(cell.R0_ohm[1], rel=ROUNDING)


def sensitivities(function):
    symbols = [ca.SX.sym(n, k) for n, k in (("x", 2), ("u", 1), ("p", MODEL.nominal.size))]
    value = function(*symbols)
    return ca.Function("d", symbols, [ca.densify(ca.jacobian(value, ca.vertcat(*symbols)))])


@pytest.mark.parametrize("name", ["f", "h"])
@pytest.mark.parametrize("z", [0.02, 0.1, 0.37, 0.5, 0.83, 0.97])
@pytest.mark.parametrize("current", [0.0, 5.0])
def test_sensitivities_to_state_input_and_every_parameter(name, z, current):
    function = getattr(MODEL, name)
    exact = np.array(sensitivities(function)([z, 0.04], [current], MODEL.nominal))
    point = np.concatenate([[z, 0.04, current], MODEL.nominal])

    def value(at):
        return np.array(function(at[:2], at[2:3], at[3:])).ravel()

    for i in range(point.size):
        step = 1e-5 * max(abs(point[i]), 1e-2)
        up, down = point.copy(), point.copy()
        up[i] += step
        down[i] -= step
        slope = (value(up) - value(down)) / (2 * step)
        # PCHIP and natural splines have kinks in the second or third derivative at their nodes, hence no more digits.
        np.testing.assert_allclose(exact[:, i], slope, rtol=2e-4, atol=1e-7, err_msg=f"derivative to entry {i}")


def test_parameters_are_run_time_values():
    wrong = mismatched(CELL, 1)
    moved = MODEL.with_parameters(R0_ohm=wrong.R0_ohm, R1_ohm=wrong.R1_ohm, C1_F=wrong.C1_F)
    built = ecm_model(wrong, STEP)
    np.testing.assert_array_equal(following([0.4, 0.1], 3.0, moved), following([0.4, 0.1], 3.0, built))
    np.testing.assert_array_equal(outputs([0.4, 0.1], 3.0, moved), outputs([0.4, 0.1], 3.0, built))


@pytest.mark.parametrize("step", [0.0, -10.0, float("nan"), float("inf"), True])
def test_refuses_a_sampling_time(step):
    with pytest.raises(ValueError, match=r"sampling_time_s = .*, allowed is a finite number > 0"):
        ecm_model(CELL, step)
