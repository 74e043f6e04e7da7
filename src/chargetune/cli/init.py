"""chargetune init."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path

from chargetune.battery.cell.cell import load_cell
from chargetune.battery.studies.study_file import load_config
from chargetune.cli.output import console
from chargetune.cli.outputs import Kind, Output, claim
from chargetune.study.files import write_whole

__all__ = ["init_command"]

# Intervals of 10 s in an hour.
STEPS = 360
TEXT = """\
# A study of fast charging. Every key is optional; what stands here is the default or a sensible beginning.
# Next: `chargetune check {name}`, then `chargetune tune {name}`.
# All keys: docs/reference/study-file.md. An editor completes them after `chargetune schema study > study.schema.json`
# and with this as the first line of the file, without the first "# ":
# #:schema ./study.schema.json

[study]
name = "{stem}"
tuner = "range"  # one theta for the whole [range]; "twin" learns from charge to charge
trials = 4       # each is one theta on fresh plants of [range]
seed = 0

[cell]
{cell}

[controller]
sampling_time_s = 10.0
horizon = 5
current_ramp_A_s = {ramp:g} # the current rises no faster: the first interval at an unknown resistance is one that no feedback sees

[estimator]
kind = "offset_free" # reads voltage and current; a disturbance on the voltage follows what the model leaves over

[sensors]
voltage_noise_sd_V = 0.002

[episode]
steps = {steps} # intervals of one charge: {why}
soc_start = 0.1
soc_target = 0.95

[objective]
charge_time_to_soc = 0.8 # the time to this SOC is minimised

# theta, what is tuned: the observer's numbers, and a margin to the voltage limit by state of charge.
[theta.backoff]
nodes = 4
lower_V = 0.0
upper_V = 0.05

[[theta.observer]]
name = "backoff_sd" # margin in standard deviations of the predicted voltage
lower = 0.1
upper = 6.0

# The ramp of the current can be tuned as well:
# [theta.current_ramp]
# lower_A_s = {ramp_least:.3g}
# upper_A_s = {ramp_most:.3g}

# What differs between the cells and the charges that the controller will meet; the certificate is drawn from the same.
[range]
soc_start = [0.05, 0.5]
resistance = 0.1         # all resistances times 1 +- this
resistance_by_node = 0.1 # each node of each table times 1 +- this
capacity = 0.02
fade = 0.1               # at full age the capacity has lost this share,
growth = 0.2             # and all resistances have grown by this one
"""


def init_command(path: Path, *, cell: Path | None, overwrite: bool) -> None:
    """Write a commented study file that runs. Raises ValueError where it may not be written, or the cell file is none."""
    claim([Output("study file", path, Kind.STUDY)], inputs=[] if cell is None else [cell], overwrite=overwrite, folders=False)
    largest, steps, why = 6.0, STEPS, "an hour"
    line = '# file = "cell.toml" # as `chargetune identify` writes it; without it the case study\'s cell'
    if cell is not None:
        known = load_cell(cell)
        largest = known.current_max_A
        # From empty to full at the largest current, and half of that again for the limits.
        needed = STEPS * 1.5 * known.capacity_Ah / largest
        if needed > STEPS:
            steps, why = 60 * math.ceil(needed / 60), "half as long again as the largest current takes from empty to full"
        line = f"file = {json.dumps(os.path.relpath(cell, path.parent))}"
    # A minute from rest to the largest current; tuned, between five minutes and six seconds.
    ramp = {"ramp": largest / 60, "ramp_least": largest / 300, "ramp_most": largest / 6}
    text = TEXT.format(name=path.name, stem=path.stem, cell=line, steps=steps, why=why, **ramp)
    write_whole(path, text)
    load_config(path).problem(path.parent)
    console().print(f"study file in {path}\nnext: chargetune check {path}", markup=False, soft_wrap=True)
