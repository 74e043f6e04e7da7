"""What is added to the outputs of an episode, as a table over what it went through."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from chargetune.episode.episode import Episode

__all__ = ["LookupTable"]

# Nodes along each signal, by the number of signals.
NODES = {1: (101,), 2: (33, 15), 3: (21, 7, 5)}


@dataclass(frozen=True)
class LookupTable:
    """Nodes of a table over one to three signals: evenly spaced within their ranges, linear in between, held beyond.

    ``ranges``: (name, lower, upper) of every signal, the first one with the most nodes; ``outputs``: those that a table adds to.
    A table has the shape (outputs, nodes), the last signal's nodes next to each other.
    """

    ranges: tuple[tuple[str, float, float], ...]
    outputs: tuple[str, ...]

    @classmethod
    def over(cls, ranges: Mapping[str, tuple[float, float]], outputs: Sequence[str]) -> LookupTable:
        """Raises ValueError for another number of signals than one to three."""
        if len(ranges) not in NODES:
            raise ValueError(f"table over {sorted(ranges)}, allowed are 1 to {max(NODES)} signals")
        return cls(tuple((name, float(low), float(high)) for name, (low, high) in ranges.items()), tuple(outputs))

    @property
    def counts(self) -> tuple[int, ...]:
        """Nodes along each signal."""
        return NODES[len(self.ranges)]

    @property
    def size(self) -> int:
        """Nodes in all."""
        return int(np.prod(self.counts))

    @cached_property
    def nodes(self) -> NDArray[np.float64]:
        """Where they are, as shares of the ranges, shape (nodes, signals)."""
        axes = [np.linspace(0.0, 1.0, count) for count in self.counts]
        return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))

    @cached_property
    def _edges(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        low, high = np.array([one[1:] for one in self.ranges]).T
        return low, high

    def unit(self, at: NDArray[np.float64]) -> NDArray[np.float64]:
        """Values of the signals (..., signals) as shares of their ranges."""
        low, high = self._edges
        return np.asarray((at - low) / (high - low))

    def value(self, unit: NDArray[np.float64]) -> NDArray[np.float64]:
        """The inverse of `unit`."""
        low, high = self._edges
        return np.asarray(low + unit * (high - low))

    def around(self, at: NDArray[np.float64]) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
        """The nodes around each of K values of the signals (K, signals), and their shares of what is there, both (K, 2^signals)."""
        unit = np.clip(self.unit(at), 0.0, 1.0)
        nodes, shares = np.zeros((len(at), 1), dtype=np.intp), np.ones((len(at), 1))
        for place, count in zip(unit.T * (np.array(self.counts)[:, None] - 1.0), self.counts, strict=True):
            below = np.minimum(place.astype(np.intp), count - 2)[:, None]
            beyond = place[:, None] - below
            nodes = np.hstack([nodes * count + below, nodes * count + below + 1])
            shares = np.hstack([shares * (1.0 - beyond), shares * beyond])
        return nodes, shares

    def weights(self, at: NDArray[np.float64]) -> NDArray[np.float64]:
        """`around` as a matrix: values at the nodes -> values at K points, shape (K, nodes)."""
        nodes, shares = self.around(at)
        out = np.zeros((len(at), self.size))
        np.put_along_axis(out, nodes, shares, axis=1)
        return out

    def true_outputs(self, episode: Episode, table: NDArray[np.float64] | None) -> Episode:
        """A simulated episode without the noise of its sensors: its model's outputs, and what the table says there; None: nothing."""
        true = episode.noise_free()
        if table is None:
            return true
        columns, both = [true.output_names.index(name) for name in self.outputs], []

        def along(name: str, k: int) -> NDArray[np.float64]:
            return true.signal(name)[k] if name in true.output_names else true.input[:, true.input_names.index(name)]

        for k, outputs in enumerate((true.output_start, true.output_end)):
            nodes, shares = self.around(np.stack([along(name, k) for name, _, _ in self.ranges], axis=1))
            out = outputs.copy()
            out[:, columns] += np.sum(table[:, nodes] * shares, axis=-1).T
            both.append(out)
        return replace(true, output_start=both[0], output_end=both[1])

    def coefficients(self, table: NDArray[np.float64]) -> NDArray[np.float64]:
        """A table as the last argument of `function`. Raises ValueError for another shape than (outputs, nodes)."""
        expected = (len(self.outputs), self.size)
        if table.shape != expected:
            raise ValueError(f"a table has the shape {table.shape}, allowed is {expected}: outputs, nodes")
        return table.reshape(len(self.outputs), *self.counts).ravel(order="F")

    def function(self, output_names: Sequence[str], input_names: Sequence[str]) -> ca.Function:
        """(outputs, inputs, coefficients) -> what is added to the outputs. Raises ValueError for a signal that is neither."""
        y, u = ca.MX.sym("y", len(output_names)), ca.MX.sym("u", len(input_names))
        coefficients = ca.MX.sym("table", len(self.outputs) * self.size)
        known = {**dict(zip(output_names, ca.vertsplit(y), strict=True)), **dict(zip(input_names, ca.vertsplit(u), strict=True))}
        unknown = [name for name in (*(one[0] for one in self.ranges), *self.outputs) if name not in known]
        if unknown:
            raise ValueError(f"table over {unknown[0]!r}, allowed are {', '.join(known)}")
        at = [ca.fmin(ca.fmax(known[name], low), high) for name, low, high in self.ranges]
        grid = [np.linspace(low, high, count).tolist() for (_, low, high), count in zip(self.ranges, self.counts, strict=True)]
        lookup = ca.interpolant("lookup", "linear", grid, len(self.outputs), {"lookup_mode": ["exact"] * len(grid)})
        values = dict(zip(self.outputs, ca.vertsplit(lookup(ca.vertcat(*at), coefficients)), strict=True))
        added = ca.vertcat(*(values.get(name, ca.MX(0)) for name in output_names))
        return ca.Function("added", [y, u, coefficients], [ca.densify(added)])
