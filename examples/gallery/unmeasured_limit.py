"""
A limit that is not measured in use
===================================

Below 0 V at the anode lithium plates, which ages a cell, the more so in the cold. No charger measures this potential. In the laboratory a
reference electrode does: two charges with it become a table over the state of charge, and in use the controller predicts by it.

The cell is PyBaMM's Doyle-Fuller-Newman model at 10 °C (extra `pybamm`). What the controller knows of it is an identified circuit, the
file `okane2022.toml` of the folder `examples`, which a downloaded script or notebook needs beside it.
"""

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt

import chargetune as ct
from chargetune.battery.baselines.charging_protocols import charge, constant_current
from chargetune.battery.charging.limits import Limit
from chargetune.battery.identification.anode import with_anode

STUDY = """
plant = { model = "DFN", parameters = "OKane2022", ambient_K = 283.15 }
controller = { sampling_time_s = 20.0 }
estimator = { kind = "offset_free", offset_free = { soc = "measured" } }
limits = { current_max_A = 10.0, voltage_max_V = 4.2, anode_min_V = 0.0 }
episode = { steps = 120, soc_start = 0.15 }
theta = { anode_backoff = { lower = -0.01, upper = 0.05 } }
"""
file = Path(tempfile.mkdtemp()) / "study.toml"
file.write_text(STUDY)
config = ct.load_config(file)
circuit = ct.load_cell(next(path for path in (Path("okane2022.toml"), Path("../okane2022.toml")) if path.exists()))

# %%
# The laboratory: a slow and a fast charge with a reference electrode, at constant current, from 15 % to 85 %.
limits, lab = [Limit("voltage_max_V", 4.2, 0.0)], []
for current, seconds in ((1.0, 120.0), (6.0, 30.0)):
    cell = config.plant.plant(0.15, seconds, ct.Sensors())
    lab.append(charge(cell, constant_current(current), limits, steps=200, soc_target=0.85, current_max_A=current))
problem = config.problem(cell=with_anode(circuit, lab))

# %%
# In use: voltage, temperature and state of charge are measured. A disturbance follows what the model of the voltage leaves over, so that
# 4.2 V are kept without any learning; nothing follows the error at the anode, which takes a margin. A charger without the table plates.
blind = charge(config.plant.plant(0.15, 40.0, ct.Sensors()), constant_current(10.0), limits, steps=60, soc_target=1.0, current_max_A=10.0)
charges = {"2C, then 4.2 V": blind, "anode predicted": ct.run_charge(problem, [0.0]), "margin of 6 mV": ct.run_charge(problem, [0.006])}
figure, (top, bottom) = plt.subplots(2, 1, figsize=(7, 5), sharex=True, layout="constrained")
for name, episode in charges.items():
    minutes, anode = episode.time_s / 60, 1e3 * episode.signal("anode_potential_V")[1]
    top.plot(minutes, anode, label=name)
    bottom.step(minutes, episode.input[:, 0], where="post")
    volts, t80 = episode.signal("voltage_V")[1].max(), minutes[episode.signal("soc")[1] < 0.8][-1]
    print(f"{name:21s} lowest anode potential {anode.min():5.1f} mV, highest voltage {volts:.3f} V, 80 % after {t80:.0f} min")
top.axhspan(-80, 0, color="C3", alpha=0.15)
top.set(ylabel="anode potential (mV)", ylim=(-80, 60))
bottom.set(xlabel="time (min)", ylabel="current (A)")
top.legend()
