"""The anode table against a cell whose table is known, and what it refuses."""

from dataclasses import replace

import numpy as np
import pytest

from chargetune.battery.baselines.charging_protocols import charge, constant_current
from chargetune.battery.cell.cell import default_cell
from chargetune.battery.cell.equivalent_circuit import ecm_model, start_state
from chargetune.battery.cell.plating import Anode
from chargetune.battery.cell.thermal import Thermal
from chargetune.battery.charging.limits import Limit
from chargetune.battery.identification.anode import with_anode
from chargetune.battery.plants.steppable import as_steppable
from chargetune.plants.simulated import SimulatedPlant

TRUE = replace(
    default_cell(),
    thermal=Thermal(heat_capacity_J_K=45.0, cooling_W_K=0.1, activation_J_mol=15e3),
    anode=Anode((0.0, 0.3, 1.0), (0.4, 0.2, 0.06), (0.03, 0.02, 0.04)),
)
LIMIT = Limit("voltage_max_V", 4.2, 0.0)


def charged(current, cell=TRUE):
    plant = as_steppable(SimulatedPlant(ecm_model(cell, 30.0), start_state(cell, 0.02)))
    return charge(plant, constant_current(current), [LIMIT], steps=int(1.2 * 240 / current), soc_target=1.0, current_max_A=current)


def error(cell, run):
    """By how much the cell's anode potential is off along a charge, V."""
    own = ecm_model(cell, 30.0)
    states = np.column_stack([run.signal("soc")[1], np.zeros(len(run)), run.signal("temperature_K")[1]])
    at = own.output_names.index("anode_potential_V")
    said = [float(own.h(x, u, own.nominal)[at]) for x, u in zip(states, run.input[:, 0], strict=True)]
    return np.abs(said - run.signal("anode_potential_V")[1])


def test_the_table_comes_back():
    runs = [charged(0.4), charged(4.0)]
    found = with_anode(replace(TRUE, anode=None), runs)
    other = charged(2.0)
    # A current that was not shown, within what straight lines make of a curve; it is steep near empty.
    off = error(found, other)
    assert np.max(off[other.signal("soc")[1] > 0.15]) < 3e-3
    assert np.max(off) < 15e-3
    assert (found.anode.soc[0], found.anode.soc[-1]) == (0.0, 1.0)
    finer = with_anode(replace(TRUE, anode=None), runs, nodes=30)
    assert np.max(error(finer, other)) < np.max(off) / 2


def test_nonsense_is_refused_by_name():
    with pytest.raises(ValueError, match=r"one charge needs at most 0\.7 of another's"):
        with_anode(TRUE, [charged(3.0), charged(3.0)])
    with pytest.raises(ValueError, match="nodes = 1, allowed is an integer >= 2"):
        with_anode(TRUE, [charged(0.4), charged(4.0)], nodes=1)
    with pytest.raises(ValueError, match="0 charges"):
        with_anode(TRUE, [])
    with pytest.raises(ValueError, match=r"charge 2: .* needed to identify \[anode\] is anode_potential_V"):
        with_anode(TRUE, [charged(0.4), charged(4.0, replace(TRUE, anode=None))])
