"""Temperature and anode potential of the circuit against an independent integration and by hand."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from chargetune.battery.cell.cell import default_cell
from chargetune.battery.cell.equivalent_circuit import ecm_model, start_state
from chargetune.battery.cell.plating import Anode
from chargetune.battery.cell.thermal import GAS_CONSTANT, Thermal
from chargetune.plants.simulated import SimulatedPlant

THERMAL = Thermal(heat_capacity_J_K=45.0, cooling_W_K=0.12, ambient_K=283.15, activation_J_mol=25e3, entropic_V_K=-2e-4)
# Flat tables, so that an integration needs no splines.
FLAT = replace(
    default_cell(),
    R0_ohm=(0.03,) * 9, R1_ohm=(0.02,) * 9, C1_F=(900.0,) * 9, R2_ohm=(0.01,) * 9, C2_F=(2e4,) * 9,
    thermal=THERMAL,
)  # fmt: skip


def arrhenius(temperature):
    return math.exp(25e3 / GAS_CONSTANT * (1 / temperature - 1 / 298.15))


def test_it_is_the_integral_of_its_differential_equations():
    """One short interval after another; the heat is held over each, which costs first order in the interval."""
    current, step = 4.0, 0.5
    model = ecm_model(FLAT, step)

    def rate(_, x):
        _, u1, u2, temperature = x
        s = arrhenius(temperature)
        heat = current * (u1 + u2 + s * 0.03 * current) - current * temperature * 2e-4
        return [
            current / 7200,
            (s * 0.02 * current - u1) / (0.02 * 900),
            (s * 0.01 * current - u2) / (0.01 * 2e4),
            (heat - 0.12 * (temperature - 283.15)) / 45,
        ]

    x = np.array([0.1, 0.0, 0.0, 283.15])
    for _ in range(1200):
        x = np.array(model.f(x, current, model.nominal)).ravel()
    exact = solve_ivp(rate, (0, 600), [0.1, 0.0, 0.0, 283.15], rtol=1e-10, atol=1e-12).y[:, -1]
    assert exact[3] > 285
    assert np.all(np.abs(x - exact) <= [1e-9, 2e-5, 2e-5, 2e-3])


def test_voltage_and_anode_potential_by_hand():
    cell = replace(FLAT, anode=Anode((0.0, 0.5, 1.0), (0.3, 0.2, 0.1), (0.02, 0.02, 0.02)))
    model = ecm_model(cell)
    assert model.output_names == ("voltage_V", "soc", "overpotential_V", "overpotential2_V", "temperature_K", "anode_potential_V")
    y = np.array(model.h([0.5, 0.01, 0.02, 290.0], 3.0, model.nominal)).ravel()
    rest = np.array(model.h([0.5, 0.0, 0.0, 290.0], 0.0, model.nominal)).ravel()
    assert y[0] - rest[0] == pytest.approx(0.03 + 0.03 * arrhenius(290.0) * 3.0, rel=1e-5)
    assert y[5] == pytest.approx(0.2 - 0.02 * arrhenius(290.0) * 3.0, rel=1e-9)


@pytest.mark.parametrize(("temperature", "factor"), [(270.0, 2.0), (283.15, 2.0), (298.15, 1.0), (313.15, 0.8), (330.0, 0.8)])
def test_a_table_of_resistance_over_temperature(temperature, factor):
    thermal = replace(THERMAL, activation_J_mol=0.0, factor_K=(283.15, 298.15, 313.15), factor=(2.0, 1.0, 0.8))
    model = ecm_model(replace(FLAT, thermal=thermal))
    rest, charged = (float(model.h([0.5, 0.0, 0.0, temperature], i, model.nominal)[0]) for i in (0.0, 2.0))
    assert charged - rest == pytest.approx(0.03 * factor * 2.0, rel=1e-5)


def test_at_rest_nothing_moves_and_left_alone_it_cools_to_ambient():
    model = ecm_model(FLAT)
    start = start_state(FLAT, 0.4)
    assert start == {"soc": 0.4, "temperature_K": 283.15}
    plant = SimulatedPlant(model, start)
    plant.reset(0)
    np.testing.assert_allclose(plant.step(np.zeros(1)).state, [0.4, 0.0, 0.0, 283.15], rtol=0, atol=1e-12)
    x = np.array(model.f([0.4, 0.0, 0.0, 313.15], 0.0, model.nominal)).ravel()
    assert x[3] == pytest.approx(283.15 + 30 * math.exp(-10 * 0.12 / 45))


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: replace(THERMAL, heat_capacity_J_K=0.0), "heat_capacity_J_K = 0.0"),
        (lambda: replace(THERMAL, ambient_K=25.0), "ambient_K = 25.0, allowed is more than 200 and at most 400 K (was it given in degC?)"),
        (lambda: replace(THERMAL, reference_K=True), "reference_K = True"),
        (lambda: replace(THERMAL, activation_J_mol=math.nan), "activation_J_mol = nan"),
        (lambda: replace(THERMAL, entropic_V_K=0.2), "entropic_V_K = 0.2"),
        (lambda: replace(THERMAL, factor_K=(280.0, 300.0), factor=(1.0, 0.9)), "allowed is one of them"),
        (lambda: Thermal(45.0, 0.1, factor_K=(280.0, 280.0), factor=(1.0, 0.9)), "factor_K[1] = 280 must be more"),
        (lambda: Thermal(45.0, 0.1, factor_K=(280.0,), factor=(1.0,)), "at least 2"),
        (lambda: Thermal(45.0, 0.1, factor_K=(280.0, 300.0), factor=(1.0, -0.9)), "factor[1] = -0.9"),
        (lambda: Anode((0.0, 1.0), (0.2, 3.0), (0.0, 0.0)), "potential_V[1] = 3.0"),
        (lambda: Anode((0.0, 50.0), (0.2, 0.1), (0.0, 0.0)), "soc[1] = 50.0, allowed is [0, 1] (a fraction"),
    ],
)
def test_nonsense_is_refused_by_name(make, said):
    with pytest.raises(ValueError, match=r"thermal|anode") as caught:
        make()
    assert said in str(caught.value)
