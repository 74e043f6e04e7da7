"""
A certificate
=============

The plants that chose theta do not judge it. A certificate counts on how many fresh charges, drawn from a stated range, a limit is broken,
and bounds the probability of it. Another program computes every figure again from the stored traces.

Here two margins of one controller are certified with 100 charges each. For a study of yours: `chargetune certify study.sqlite`, with 300
charges, and `chargetune verify certificate.json`.
"""

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt

import chargetune as ct
from chargetune.battery.certification.certificate import run_charges, write_certificate
from chargetune.verify import verify

# %%
# The controller's resistances are wrong by up to a half; a disturbance on the voltage follows what its model leaves over. `backoff_sd` is
# its margin, in standard deviations of the voltage that it predicts. The range: new cells of one make and their first few hundred cycles.
STUDY = """
controller = { mismatch_seed = 1 }
estimator = { kind = "offset_free", offset_free = { backoff_sd = MARGIN } }
range = { soc_start = [0.02, 0.5], resistance = 0.05, resistance_by_node = 0.02, capacity = 0.02, fade = 0.05, growth = 0.1 }
"""
folder = Path(tempfile.mkdtemp())

# %%
# Without a violation among n charges the probability of one is at most 1 - 0.05^(1/n), with a confidence of 95 %.
figure, axes = plt.subplots(figsize=(7, 4), layout="constrained")
for margin in ("3.0", "5.0"):
    (folder / "study.toml").write_text(STUDY.replace("MARGIN", margin))
    problem = ct.load_config(folder / "study.toml").problem()
    charges = [charge for part in run_charges(problem, (), seed=0, episodes=100) for charge in part]
    file = folder / f"certificate-{margin}.json"
    stated = write_certificate(file, problem, charges, theta={}, origin={"study": "gallery"}, seed=0, confidence=0.95)["figures"]
    bound = 100 * stated["violation_probability_upper"]
    start = [100 * charge.values["soc_start"][0] for charge in charges]
    excess = [1e3 * charge.score.excess["voltage_max_V"] for charge in charges]
    axes.plot(start, excess, "o", label=f"{margin} sd: {stated['violations']} of 100, so at most {bound:.1f} % over the limit")
    print(f"{margin} sd: {stated['violations']} of 100 charges over a limit, median time to 80 % {stated['t80_min.q50']:.1f} min")
    print(f"computed again, the figures that differ: {verify(file) or 'none'}")
axes.axhline(0, color="black", linestyle=":")
axes.set(xlabel="SOC at the start (%)", ylabel="largest voltage beyond 4.2 V (mV)")
figure.legend(loc="outside upper center")
