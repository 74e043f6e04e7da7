"""What a person has to know of the fits: samples left out, levels held, sets that differ from the others."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from chargetune.battery.identification.circuit_fit import PulseFit
from chargetune.battery.identification.record import Record
from chargetune.battery.identification.spikes import LONGEST, spikes
from chargetune.runtime.counted import counted

__all__ = ["remarks_on", "without_spikes"]

# An rms of more than so many times the median of the sets, and of more than this, V, is told.
RMS_TIMES, RMS_MIN_V = 5.0, 1e-3
# A resistance or time constant this many times its neighbours' is told.
NEIGHBOUR_TIMES = 3.0
# A sample this far, V, off both neighbours under a steady current is a spike.
SPIKE_V = 0.02


def remarks_on(fits: Sequence[PulseFit]) -> list[str]:
    """One remark for each thing that single sets show, and one for what several show alike."""
    notes = []
    for fit in fits:
        for k in fit.left_out:
            off = 1e3 * (fit.measured_V[k] - fit.fitted_V[k])
            notes.append(f"{fit.place}: the sample {fit.time_s[k]:.1f} s after the rest is {off:.0f} mV off and was left out of the fit")
    off = [fit for fit in fits if fit.level_off_V]
    if off:
        worst = 1e3 * max(abs(fit.level_off_V) for fit in off)
        every = counted(len(fits), "set")
        which = f"all {every}" if len(off) == len(fits) else f"{len(off)} of {every} ({_listed(off)})"
        more = "" if "R2_ohm" in off[0].values else "; --rc 2 may follow them"
        notes.append(
            f"the circuit does not follow the pulses of {which}: its level there is up to {worst:.1f} mV off the rest before them. "
            f"The rest is the OCV{more}"
        )
    middle = float(np.median([fit.rms_V for fit in fits]))
    notes += [
        f"{fit.place}: rms {1e3 * fit.rms_V:.2f} mV, {fit.rms_V / middle:.0f} times the median of the sets"
        for fit in fits
        if fit.rms_V > max(RMS_TIMES * middle, RMS_MIN_V)
    ]
    ordered = sorted(fits, key=lambda fit: fit.soc)
    for k, fit in enumerate(ordered):
        beside = [other for other in (ordered[max(k - 1, 0)], ordered[min(k + 1, len(ordered) - 1)]) if other is not fit]
        for label in (name for name in fit.values if name[0] == "R"):
            ratios = [fit.values[label] / other.values[label] for other in beside]
            if min(ratios) > NEIGHBOUR_TIMES or max(ratios) < 1 / NEIGHBOUR_TIMES:
                notes.append(
                    f"{fit.place}: {label} = {fit.values[label]:.3g}, beside it {beside[0].values[label]:.3g}; the OCV may bend there "
                    "between the rests (--ocv tells)"
                )
    return notes


def _listed(fits: Sequence[PulseFit]) -> str:
    """Their numbers and SOC, neighbours as a range."""
    runs: list[list[PulseFit]] = []
    for fit in fits:
        if runs and fit.number == runs[-1][-1].number + 1:
            runs[-1].append(fit)
        else:
            runs.append([fit])
    return ", ".join(
        f"{run[0].number} at SOC {run[0].soc:.2f}" + (f" to {run[-1].number} at {run[-1].soc:.2f}" if len(run) > 1 else "") for run in runs
    )


def without_spikes(record: Record) -> NDArray[np.float64]:
    """The voltage with each single sample far off its neighbours, under a steady current, replaced by their median. Shape (n,)."""
    volts = record.voltage_V
    return np.where(spikes(volts, record.current_A, SPIKE_V), median_filter(volts, 2 * LONGEST + 1, mode="nearest"), volts)
