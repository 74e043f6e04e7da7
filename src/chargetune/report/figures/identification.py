"""What `identify` fitted: pulses with their fit, and the circuit over the state of charge."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.interpolate import PchipInterpolator

from chargetune.battery.identification.pulse_fit import Identification
from chargetune.report.figures.style import BLUE, GREEN, ORANGE, PAGE_IN, cell_note, journal_style, letter, new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["identification_figure"]


def identification_figure(found: Identification) -> Figure:
    """Measured and fitted voltage of every set of pulses, rms, OCV, and resistances with two standard deviations, over SOC."""
    cell = found.cell
    with journal_style():
        figure, axes = new_figure(PAGE_IN, 4.6, 2, 2)
        pulses, rms, ocv, resistance = axes
        for k, fit in enumerate(found.fits):
            level = 1e3 * fit.measured_V[0]
            pulses.plot(fit.time_s, 1e3 * fit.measured_V - level, color=BLUE, linewidth=2.0, label="measured" if k == 0 else None)
            pulses.plot(fit.time_s, 1e3 * fit.fitted_V - level, color=ORANGE, linewidth=0.8, label="fitted" if k == 0 else None)
        pulses.set_xlabel("time in the set (s)")
        pulses.set_ylabel("voltage from rest (mV)")
        pulses.legend()
        soc = [100 * fit.soc for fit in found.fits]
        rms.bar(soc, [1e3 * fit.rms_V for fit in found.fits], width=5.0, color=BLUE)
        rms.set_ylabel("rms of the fit (mV)")
        between = np.linspace(0.0, 1.0, 201)
        ocv.plot(100 * between, PchipInterpolator(cell.ocv_soc, cell.ocv_V)(between), color=BLUE)
        ocv.plot(100 * np.array(cell.ocv_soc), cell.ocv_V, ".", color=BLUE, markersize=4)
        ocv.set_ylabel("OCV (V)")
        for name, color in zip(("R0_ohm", *(f"R{k}_ohm" for k in cell.pairs)), (BLUE, ORANGE, GREEN), strict=False):
            values = [1e3 * fit.values[name] for fit in found.fits]
            spread = [2e3 * fit.sd[name] for fit in found.fits]
            resistance.errorbar(soc, values, yerr=spread, color=color, marker="o", markersize=3, capsize=2, label=f"${name[0]}_{name[1]}$")
        resistance.set_ylabel("resistance (mΩ)")
        resistance.set_ylim(bottom=0.0)
        resistance.legend(ncols=3)
        for axis in (rms, ocv, resistance):
            axis.set_xlabel("SOC (%)")
            axis.set_xlim(-4.0, 104.0)
        letter(axes)
        cell_note(figure, cell.name, cell.remark)
    return figure
