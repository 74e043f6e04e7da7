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

__all__ = ["with_anode"]

# SOC nodes of the table within the SOC that were visited.
NODES = 12
# Currents that differ by less than this share tell potential and resistance no longer apart.
APART = 0.3


def with_anode(cell: Cell, charges: Sequence[Episode]) -> Cell:
    """The cell with an anode table, from charges with the measured outputs soc and anode_potential_V, one of them slow.

    The tables are the least-squares solution, with piecewise linear U and r >= 0 over SOC, of

        phi = U(z) - r(z) s(T) I

    at the end of every interval; s(T) is the resistance factor of the cell's ``thermal`` data, 1 without them. Beyond the SOC that
    were visited the outer values hold. Raises ValueError when an output is missing, or the currents do not tell U from r.
    """
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
            f"largest currents of the {len(columns)} charges (times the resistance factor): {', '.join(f'{v:.3g}' for v in largest)} A; "
            f"to tell potential from resistance in [anode] one charge needs at most {1 - APART:.1f} of another's"
        )
    nodes = np.linspace(float(z.min()), float(z.max()), NODES)
    hats = np.stack([np.interp(z, nodes, unit) for unit in np.eye(NODES)], axis=1)
    low, high = np.repeat([-np.inf, 0.0], NODES), np.full(2 * NODES, np.inf)
    found = lsq_linear(np.hstack([hats, -flow[:, None] * hats]), phi, bounds=(low, high)).x
    start, end = [0.0] if nodes[0] > 0 else [], [1.0] if nodes[-1] < 1 else []
    outer = (len(start), len(end))
    return replace(
        cell,
        anode=Anode(
            soc=(*start, *(float(v) for v in np.clip(nodes, 0.0, 1.0)), *end),
            potential_V=tuple(float(v) for v in np.pad(found[:NODES], outer, mode="edge")),
            resistance_ohm=tuple(float(v) for v in np.pad(found[NODES:], outer, mode="edge")),
        ),
    )
