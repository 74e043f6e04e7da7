"""
From pulses to a cell
=====================

A pulse test (HPPC) of your cell becomes an equivalent circuit: open-circuit voltage, R0 and one R-C pair over the state of charge.
Here the cycler is simulated, so that the true values are known. With your own file begin at `read_record`; the same from the command
line is `chargetune identify pulses.csv -o cell.toml --figure fit.png`.
"""

import tempfile
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import chargetune as ct
from chargetune.battery.cell.equivalent_circuit import ecm_model, start_state
from chargetune.battery.identification.virtual_bench import pulse_test, record_csv
from chargetune.battery.plants.steppable import as_steppable

# %%
# The bench: pulses at eight states of charge, and a cycler whose voltage has 0.3 mV of noise.
true = ct.default_cell()


def full_cell(sampling_time_s):
    return as_steppable(ct.SimulatedPlant(ecm_model(true, sampling_time_s), start_state(true, 1.0)))


record = pulse_test(full_cell, capacity_Ah=true.capacity_Ah, voltage_min_V=true.voltage_min_V, points=8)
noise = 0.3e-3 * np.random.default_rng(0).standard_normal(len(record))
file = Path(tempfile.mkdtemp()) / "pulses.csv"
file.write_text(record_csv(replace(record, voltage_V=record.voltage_V + noise)))

# %%
# From the file to the cell. Read every remark: here one says that limits have to come from the data sheet.
found = ct.identify(ct.read_record(file), name="my cell")
cell = replace(found.cell, voltage_min_V=2.5, voltage_max_V=4.2, current_max_A=6.0)
print(*found.remarks, sep="\n")
print(ct.cell_toml(cell).split("[ocv]")[0])

# %%
# The fit of one set of pulses, and what was found over the state of charge, with two standard deviations.
figure, (pulse, table) = plt.subplots(1, 2, figsize=(9, 4), layout="constrained")
fit = found.fits[4]
pulse.plot(fit.time_s, 1e3 * (fit.measured_V - fit.measured_V[0]), color="C0", linewidth=3, label="measured")
pulse.plot(fit.time_s, 1e3 * (fit.fitted_V - fit.measured_V[0]), color="C1", label=f"fitted, {1e3 * fit.rms_V:.2f} mV rms")
pulse.set(xlabel="time (s)", ylabel="voltage from rest (mV)", title=f"pulses at a SOC of {100 * fit.soc:.0f} %")
for name, color in {"R0_ohm": "C0", "R1_ohm": "C1"}.items():
    table.plot(100 * np.array(true.soc), 1e3 * np.array(getattr(true, name)), color=color, label=f"true {name[:2]}")
    points = [(100 * fit.soc, 1e3 * fit.values[name], 2e3 * fit.sd[name]) for fit in found.fits]
    table.errorbar(*zip(*points, strict=True), fmt="o", color=color, capsize=3, label=f"found {name[:2]}")
table.set(xlabel="SOC (%)", ylabel="resistance (mΩ)", ylim=(0, None), title="the circuit")
for axes in (pulse, table):
    axes.legend()
