"""Cells of the kinds that are on sale, with round numbers of their data sheets: none of them is measured."""

from chargetune.battery.cell.cell import Cell
from chargetune.battery.cell.thermal import Thermal

SOC = (0.05, 0.2, 0.4, 0.6, 0.8, 0.95)
# Relative course of a resistance over SOC: more at both ends.
COURSE = (1.6, 1.1, 1.0, 1.0, 1.05, 1.2)
OCV_SOC = (0.0, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 1.0)
# LFP's plateau as a cycler with a resolution of 10 mV shows it: two equal neighbours, twice.
LFP_V = (2.6, 3.11, 3.2, 3.24, 3.27, 3.29, 3.29, 3.3, 3.33, 3.33, 3.335, 3.34, 3.36)
LTO_V = (1.6, 1.95, 2.05, 2.12, 2.16, 2.19, 2.22, 2.26, 2.31, 2.37, 2.44, 2.49, 2.56)
NMC_V = (2.9, 3.35, 3.45, 3.55, 3.6, 3.64, 3.7, 3.8, 3.89, 3.98, 4.07, 4.12, 4.18)
LCO_V = (3.0, 3.55, 3.63, 3.7, 3.74, 3.77, 3.8, 3.85, 3.92, 4.0, 4.08, 4.12, 4.18)


def made(name, capacity_Ah, r0_ohm, r1_ohm, tau_s, ocv_V, voltages, rate, **more):
    """A 1-RC cell: R0 and R1 in the middle of the SOC, ``rate`` its largest current over capacity, 1/h."""
    return Cell(
        name=name,
        capacity_Ah=capacity_Ah,
        coulombic_efficiency=1.0,
        current_max_A=rate * capacity_Ah,
        voltage_min_V=voltages[0],
        voltage_max_V=voltages[1],
        soc=SOC,
        R0_ohm=tuple(r0_ohm * c for c in COURSE),
        R1_ohm=tuple(r1_ohm * c for c in COURSE),
        C1_F=tuple(tau_s / (r1_ohm * c) for c in COURSE),
        ocv_soc=OCV_SOC,
        ocv_V=ocv_V,
        **more,
    )


KINDS = {
    "LFP 2.5 Ah": made("LFP 2.5 Ah", 2.5, 0.012, 0.01, 25.0, LFP_V, (2.0, 3.65), 4.0),
    "LTO 1.5 Ah": made("LTO 1.5 Ah", 1.5, 0.012, 0.008, 15.0, LTO_V, (1.5, 2.8), 10.0),
    "NMC 5 Ah": made("NMC 5 Ah", 5.0, 0.015, 0.012, 30.0, NMC_V, (2.5, 4.2), 2.0),
    "coin 45 mAh": made("coin 45 mAh", 0.045, 1.2, 0.8, 20.0, LCO_V, (2.75, 4.2), 1.0),
    "prismatic 280 Ah": made(
        "prismatic 280 Ah", 280.0, 2e-4, 1.5e-4, 60.0, LFP_V, (2.5, 3.65), 1.0, thermal=Thermal(heat_capacity_J_K=5400.0, cooling_W_K=3.0)
    ),
}
