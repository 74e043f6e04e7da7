"""
A certificate
=============

The plants that chose theta do not judge it. A certificate counts on how many fresh charges, drawn from a stated range, a limit is broken,
and bounds the probability of it. Another program computes every figure again from the stored traces.

Here two margins of the same controller are certified with 100 charges each. For a study of yours: `chargetune certify study.sqlite`,
with 300 charges, and `chargetune verify certificate.json`.
"""

import tempfile
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt

from chargetune.battery.case_study.configurations import case_study
from chargetune.battery.certification.certificate import run_charges, write_certificate
from chargetune.battery.charging.observers import OffsetFree
from chargetune.battery.charging.range_settings import ChargingRangeSettings
from chargetune.battery.charging.settings import EstimatorSettings
from chargetune.battery.charging.tunables import Tunables
from chargetune.verify import verify

# %%
# The range: new cells of one make and their first few hundred cycles, charged from 2 to 50 %. The controller's resistances are wrong by up
# to a half; a disturbance on the voltage follows what its model leaves over. `backoff_sd` is its margin, in standard deviations of the
# voltage that it predicts.
use = ChargingRangeSettings(soc_start=(0.02, 0.5), resistance=0.05, resistance_by_node=0.02, capacity=0.02, fade=0.05, growth=0.1)
problem = replace(case_study("model", mismatch_seed=1).problem(), range=use, theta=Tunables())
folder = Path(tempfile.mkdtemp())

figure, axes = plt.subplots(figsize=(7, 4), layout="constrained")
for margin in (3.0, 5.0):
    one = replace(problem, estimator=EstimatorSettings(kind="offset_free", offset_free=OffsetFree(backoff_sd=margin)))
    charges = [charge for part in run_charges(one, (), seed=0, episodes=100) for charge in part]
    file = folder / f"certificate_{margin}.json"
    stated = write_certificate(file, one, charges, theta={}, origin={"study": "gallery"}, seed=0, confidence=0.95)
    found = stated["figures"]
    bound = 100 * found["violation_probability_upper"]
    print(f"backoff_sd = {margin}: {found['violations']} of 100 charges over a limit, median time to 80 % {found['t80_min.q50']:.1f} min")
    print(f"    a charge breaks one with a probability of at most {bound:.1f} % (confidence 95 %)")
    print(f"    computed again: {verify(file) or 'every figure is the same'}")
    start = [100 * charge.values["soc_start"][0] for charge in charges]
    excess = [1e3 * charge.score.excess["voltage_max_V"] for charge in charges]
    axes.plot(start, excess, "o", label=f"margin of {margin:g} sd: at most {bound:.0f} % over the limit")
axes.axhline(0, color="black", linestyle=":")
axes.set(xlabel="SOC at the start (%)", ylabel="largest voltage beyond 4.2 V (mV)")
axes.legend()
