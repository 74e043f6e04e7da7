"""From a cell on the bench to the cell file of a controller: here the bench is PyBaMM's DFN.

Run: python examples/electrochemical_cell.py FOLDER. A slow cycle gives the open-circuit voltage, a pulse test at 298 K the
circuit, pulse tests at two more temperatures how its resistance falls when it warms, and one charge its heat capacity and
cooling: `okane2022.toml`. A slow charge more, with a reference electrode, gives the anode potential too: `okane2022_anode.toml`. For a
range of ambient temperatures it takes charges at its ends, and more nodes: `okane2022_range.toml`.
"""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

import chargetune as ct
from chargetune.battery.baselines.charging_protocols import charge, constant_current
from chargetune.battery.charging.limits import Limit
from chargetune.battery.identification.anode import with_anode
from chargetune.battery.identification.record import Record
from chargetune.battery.identification.thermal import activation_energy, with_thermal
from chargetune.battery.identification.virtual_bench import pulse_test, slow_cycle


def bench(ambient_K, seconds, soc=1.0):
    """The cell at rest in a chamber of this temperature, sampled every ``seconds``."""
    return ct.Electrochemical(ambient_K=ambient_K).plant(soc, seconds, ct.Sensors())


capacity = ct.Electrochemical().capacity_Ah
ocv = slow_cycle(bench(298.15, 60.0), capacity_Ah=capacity, voltage_min_V=2.5, voltage_max_V=4.2)
cells = {}
for ambient in (283.15, 298.15, 313.15):
    record = pulse_test(lambda seconds, ambient=ambient: bench(ambient, seconds), capacity_Ah=capacity, voltage_min_V=2.5)
    cells[ambient] = ct.identify(record, capacity_Ah=capacity, ocv=ocv).cell
    print(f"{ambient:.0f} K: {cells[ambient].remark}")

limit = Limit("voltage_max_V", 4.2, 0.0)
run = charge(bench(298.15, 10.0, 0.05), constant_current(5.0), [limit], steps=420, soc_target=1.0, current_max_A=5.0)
warm = Record(
    "simulated 1C charge",
    np.append(0.0, run.time_s + 10.0),
    np.append(0.0, run.input[:, 0]),
    np.append(run.signal("voltage_V")[0][0], run.signal("voltage_V")[1]),
    np.append(298.15, run.signal("temperature_K")[1]),
)
energy = activation_energy(cells)
cell = with_thermal(cells[298.15], warm, 0.05, activation_J_mol=energy)
cell = replace(
    cell,
    name="OKane2022 (DFN), LG M50 5 Ah",
    current_max_A=15.0,
    voltage_min_V=2.5,
    voltage_max_V=4.2,
    remark="R-RC circuit identified from simulated pulses and a slow cycle on PyBaMM's DFN "
    "with the parameters of O'Kane et al., PCCP 24 (2022) 7909.",
)
print(f"E = {energy:.0f} J/mol, C = {cell.thermal.heat_capacity_J_K:.1f} J/K, hA = {cell.thermal.cooling_W_K:.4f} W/K")
slow = charge(bench(298.15, 60.0, 0.02), constant_current(1.0), [limit], steps=300, soc_target=1.0, current_max_A=1.0)
folder = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
# Current A, seconds a sample, samples, SOC at the end: where the anode plates while it is cold is what the table has to tell.
charges = [
    charge(bench(ambient, seconds, 0.03), constant_current(current), [limit], steps=steps, soc_target=end, current_max_A=current)
    for ambient in (278.15, 298.15, 308.15)
    for current, seconds, steps, end in ((1.0, 60.0, 300, 0.98), (5.0, 20.0, 196, 0.85), (8.0, 20.0, 122, 0.85))
]
files = {
    "okane2022.toml": cell,
    "okane2022_anode.toml": with_anode(cell, [slow, run]),
    "okane2022_range.toml": with_anode(cell, charges, nodes=30),
}
for name, one in files.items():
    (folder / name).write_text(ct.cell_toml(one), encoding="utf-8")
