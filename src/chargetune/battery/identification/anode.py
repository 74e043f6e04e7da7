"""The anode potential of a cell over SOC and current, from charges in which it was measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from chargetune.battery.cell.cell import Cell
from chargetune.battery.cell.plating import Anode
from chargetune.episode.episode import Episode
from chargetune.runtime.counted import counted

__all__ = ["with_anode"]

# SOC nodes of the table within the SOC that were visited, unless told: two charges tell about as many apart.
NODES = 12
# Currents that differ by less than this share tell potential and resistance no longer apart.
APART = 0.3


def with_anode(cell: Cell, charges: Sequence[Episode], nodes: int = NODES) -> Cell:
    """The cell with an anode table, from charges with the measured outputs soc and anode_potential_V, one of them slow.

    The tables are the least-squares solution, with piecewise linear U and r >= 0 over SOC, of

        phi = U(z) - r(z) s(T) I

    at the end of every interval, with ``nodes`` of the SOC that were visited; s(T) is the resistance factor of the cell's ``thermal``
    data, 1 without them. Beyond the SOC that were visited the outer values hold. Raises ValueError when an output is missing, the
    currents do not tell U from r, or ``nodes`` is not an integer >= 2.
    """
    if isinstance(nodes, bool) or not isinstance(nodes, int) or nodes < 2:
        raise ValueError(f"anode: nodes = {nodes!r}, allowed is an integer >= 2")
    columns: list[NDArray[np.float64]] = []
    thermal = cell.thermal
    for number, charge in enumerate(charges):
        needed = ("soc", "anode_potential_V", *(("temperature_K",) if thermal else ()))
        missing = [name for name in needed if name not in charge.output_names]
        if missing:
            raise ValueError(
                f"charge {number + 1}: outputs are {', '.join(charge.output_names)}, needed to identify [anode] is {missing[0]}"
            )
        soc, potential = (charge.signal(name)[1] for name in needed[:2])
        current = charge.input[:, charge.input_names.index("current_A")]
        factor = np.ones(len(charge))
        if thermal:
            warm = charge.signal("temperature_K")[1]
            factor = np.array([float(thermal.resistance_factor(t, thermal.activation_J_mol, thermal.reference_K)) for t in warm])
        columns.append(np.column_stack([soc, factor * current, potential]))
    z, flow, phi = np.vstack([np.zeros((0, 3)), *columns]).T
    largest = [float(np.max(part[:, 1])) for part in columns if len(part)]
    if not largest or max(largest) <= 0 or min(largest) > (1 - APART) * max(largest):
        raise ValueError(
            f"largest currents of the {counted(len(columns), 'charge')} (times the resistance factor): "
            f"{', '.join(f'{v:.3g}' for v in largest)} A; "
            f"to tell potential from resistance in [anode] one charge needs at most {1 - APART:.1f} of another's"
        )
    at = np.linspace(float(z.min()), float(z.max()), nodes)
    hats = np.stack([np.interp(z, at, unit) for unit in np.eye(nodes)], axis=1)
    low, high = np.repeat([-np.inf, 0.0], nodes), np.full(2 * nodes, np.inf)
    found = lsq_linear(np.hstack([hats, -flow[:, None] * hats]), phi, bounds=(low, high)).x
    start, end = [0.0] if at[0] > 0 else [], [1.0] if at[-1] < 1 else []
    outer = (len(start), len(end))
    return replace(
        cell,
        anode=Anode(
            soc=(*start, *(float(v) for v in np.clip(at, 0.0, 1.0)), *end),
            potential_V=tuple(float(v) for v in np.pad(found[:nodes], outer, mode="edge")),
            resistance_ohm=tuple(float(v) for v in np.pad(found[nodes:], outer, mode="edge")),
        ),
    )
