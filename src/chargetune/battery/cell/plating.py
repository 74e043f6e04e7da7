"""The anode's potential, which says whether lithium plates."""

from __future__ import annotations

from dataclasses import dataclass

from chargetune.battery.cell.thermal import _finite, _increasing

__all__ = ["Anode"]


@dataclass(frozen=True)
class Anode:
    """What is known of the anode potential against lithium (V); below 0 lithium plates.

    phi = potential(z) - resistance(z) I over SOC nodes ``soc``: measured with a reference electrode or in a cell model.
    """

    soc: tuple[float, ...]
    potential_V: tuple[float, ...]
    resistance_ohm: tuple[float, ...]

    def __post_init__(self) -> None:
        for name in ("soc", "potential_V", "resistance_ohm"):
            object.__setattr__(self, name, tuple(getattr(self, name)))
        if not 2 <= len(self.soc) == len(self.potential_V) == len(self.resistance_ohm):
            counts = f"{len(self.soc)}, {len(self.potential_V)} and {len(self.resistance_ohm)}"
            raise ValueError(f"anode: soc, potential_V and resistance_ohm have {counts} values, allowed are as many, at least 2")
        _increasing("anode: soc", self.soc, 0.0, 1.0, "(a fraction, not per cent)")
        for name, least, most in (("potential_V", -0.5, 2.0), ("resistance_ohm", 0.0, 1.0)):
            for i, value in enumerate(getattr(self, name)):
                if not _finite(value) or not least <= value <= most:
                    raise ValueError(f"anode: {name}[{i}] = {value!r}, allowed is [{least:g}, {most:g}]")
