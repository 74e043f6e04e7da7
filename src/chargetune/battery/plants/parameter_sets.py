"""Which parameter sets of PyBaMM an electrochemical plant can have, and why it cannot have the others."""

from __future__ import annotations

__all__ = ["OTHER_SETS", "SETS"]

# Sets of PyBaMM that run here as SPM, SPMe and DFN at 1C, and why the others cannot: a test tries all of them.
SETS = (
    "Ai2020", "Chayambuka2022", "Chen2020", "Ecker2015", "Marquis2019", "Mohtat2020", "NCA_Kim2011", "OKane2022", "ORegan2022", "Prada2013",
    "Ramadass2004",
)  # fmt: skip
OTHER_SETS = {
    "Bonkile2024": "its negative electrode is a composite of two materials",
    "Chen2020_composite": "its negative electrode is a composite of two materials",
    "ECM_Example": "it is of an equivalent circuit",
    "Ecker2015_graphite_halfcell": "it is of a half-cell, against lithium metal",
    "OKane2022_graphite_SiOx_halfcell": "it is of a half-cell, against lithium metal",
    "MSMR_Example": "it has no open-circuit potential, as only a multi-species multi-reaction model wants it",
    "Sulzer2019": "it is of a lead-acid battery",
    "Xu2019": "it is of a half-cell, against lithium metal",
}
