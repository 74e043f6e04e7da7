"""
Safe charges on an electrochemical cell
=======================================

A cell in the cold (PyBaMM's Doyle-Fuller-Newman model at 10 °C, extra `pybamm`) plates lithium where its anode potential falls below 0 V.
The controller predicts it from a table that was made at 25 °C, and untuned it plates. Safe mode learns from whole charges how far to stay
away, and tries only what its model says is safe: the first charge is careful, each one is faster, none breaks the limit.

The charges are few and coarse, that this page is made in seconds; `chargetune tune examples/demo.toml` has five whole ones. A downloaded
script or notebook needs the file `okane2022_anode.toml` of the folder `examples` beside it.
"""

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt

import chargetune as ct

# %%
# A study file: what the controller knows, the plant, the limits, theta, and the start that is known to be safe.
STUDY = """
study = { tuner = "twin" }
cell = { file = "okane2022_anode.toml" }
plant = { model = "DFN", parameters = "OKane2022", ambient_K = 283.15 }
controller = { sampling_time_s = 30.0 }
estimator = { kind = "offset_free", offset_free = { soc = "measured" } }
limits = { current_max_A = 10.0, anode_min_V = 0.0, tolerance_anode_V = 0.001 }
episode = { steps = 75, soc_start = 0.2 }
objective = { charge_time_to_soc = 0.7, verdict_samples = 5 }
sensors = { voltage_noise_sd_V = 0.002 }
theta = { anode_backoff = { nodes = 2, lower = -0.05, upper = 0.05 } }
safety = { probability = 0.95, start = { anode_backoff_V = 0.03 } }
"""
examples = next(folder for folder in (Path(), Path("..")) if (folder / "okane2022_anode.toml").exists())
folder = Path(tempfile.mkdtemp())
(folder / "study.toml").write_text(STUDY)
config = ct.load_config(folder / "study.toml")
run = ct.evaluation_of("twin", config.problem(examples))
with ct.Store(folder / "study.sqlite") as store, ct.open_study(store, config, examples) as study:
    study.run(run, 3)
    charges = {"untuned": run(None, 0)[1]}
    charges |= {f"charge {t.number + 1}": ct.Episode.from_arrays(*study.trace(t.number)) for t in study.trials()}

# %%
# The lowest anode potential of each charge, and its time to a charge of 70 %.
figure, (anode, time) = plt.subplots(1, 2, figsize=(9, 4), layout="constrained", gridspec_kw={"width_ratios": (2, 1)})
for k, (name, episode) in enumerate(charges.items()):
    soc, potential = episode.signal("soc")[1], 1e3 * episode.signal("anode_potential_V")[1]
    minutes = episode.time_s[soc < 0.7][-1] / 60
    anode.plot(100 * soc, potential, "k--" if k == 0 else f"C{k}", label=name)
    time.bar(name.removeprefix("charge "), minutes, color="0.6" if potential.min() < 0 else f"C{k}")
    print(f"{name}: lowest anode potential {potential.min():5.1f} mV, 70 % after {minutes:.1f} min")
anode.axhspan(-10, 0, color="C3", alpha=0.15)
anode.set(xlabel="SOC (%)", ylabel="anode potential (mV)", ylim=(-10, 60), xlim=(20, 75))
anode.legend()
time.set(xlabel="charge", ylabel="time to 70 % (min)")
