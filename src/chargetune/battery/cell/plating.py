"""The anode's potential, which says whether lithium plates."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

from pydantic import Field

from chargetune.battery.cell.thermal import _finite, _increasing

__all__ = ["Anode"]


@dataclass(frozen=True)
class Anode:
    """What is known of the anode potential against lithium (V); below 0 lithium plates.

    phi = potential(z) - resistance(z) I over SOC nodes ``soc``: measured with a reference electrode or in a cell model.
    """

    soc: Annotated[tuple[float, ...], Field(description="SOC of both tables, 1; increasing within 0 to 1, at least 2.")]
    potential_V: Annotated[tuple[float, ...], Field(description="Anode potential against lithium without current, V; -0.5 to 2.")]
    resistance_ohm: Annotated[
        tuple[float, ...], Field(description="By how much it falls per ampere of one cell, ohm; 0 to 2 V / capacity_Ah.")
    ]

    def __post_init__(self) -> None:
        for name in ("soc", "potential_V", "resistance_ohm"):
            object.__setattr__(self, name, tuple(getattr(self, name)))
        if not 2 <= len(self.soc) == len(self.potential_V) == len(self.resistance_ohm):
            counts = f"{len(self.soc)}, {len(self.potential_V)} and {len(self.resistance_ohm)}"
            raise ValueError(f"anode: soc, potential_V and resistance_ohm have {counts} values, allowed are as many, at least 2")
        _increasing("anode: soc", self.soc, 0.0, 1.0, "(a fraction, not per cent)")
        # How large the resistance may be depends on the capacity, which `Cell` knows.
        for name, least, most, allowed in (
            ("potential_V", -0.5, 2.0, "[-0.5, 2] V"),
            ("resistance_ohm", 0.0, math.inf, "at least 0 ohm"),
        ):
            for i, value in enumerate(getattr(self, name)):
                if not _finite(value) or not least <= value <= most:
                    raise ValueError(f"anode: {name}[{i}] = {value!r}, allowed is {allowed}")
