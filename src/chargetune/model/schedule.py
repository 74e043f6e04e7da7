"""A schedule: theta as a table over declared contexts, such as ambient temperature and age, interpolated before an episode begins."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from chargetune.model.parameter_space import Parameter, ParameterSpace
from chargetune.runtime.numeric import is_finite

__all__ = ["Axis", "Schedule"]


@dataclass(frozen=True)
class Axis:
    """One quantity of a context: its name, and the nodes of the table along it, at least two increasing numbers."""

    name: str
    nodes: tuple[float, ...]
    unit: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "nodes", tuple(self.nodes))
        if (
            len(self.nodes) < 2
            or not all(map(is_finite, self.nodes))
            or any(b <= a for a, b in zip(self.nodes, self.nodes[1:], strict=False))
        ):
            raise ValueError(f"schedule: {self.name} = {list(self.nodes)}, allowed are at least 2 finite, increasing numbers")

    @property
    def span(self) -> str:
        return f"[{self.nodes[0]:g}, {self.nodes[-1]:g}] {self.unit}".rstrip()

    def check(self, value: float, where: str = "context") -> float:
        """The value, where the table has it; ValueError outside: nothing was chosen for such a context."""
        if not is_finite(value) or not self.nodes[0] <= value <= self.nodes[-1]:
            raise ValueError(f"{where}: {self.name} = {value:g}, allowed is what the schedule spans, {self.span}")
        return float(value)

    def shares(self, value: float) -> NDArray[np.float64]:
        """The share of each node, linear between neighbours, shape (nodes,)."""
        nodes = np.array(self.nodes)
        return np.array([np.interp(self.check(value), nodes, row) for row in np.eye(nodes.size)])


@dataclass(frozen=True)
class Schedule:
    """theta(c) for a context c from a table of thetas over the grid of ``axes``, multilinear in the scale that the tuner sees.

        u(c) = sum_k s_k(c) u_k,  s_k(c) the product over the axes of the shares of node k,

    u the point of the unit cube: linear entries are interpolated linearly, those on a log scale geometrically. ``parts`` are the
    parameters that the table has; the others are the same in each context; none named: all are in it.
    """

    axes: tuple[Axis, ...]
    parts: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        names = [axis.name for axis in self.axes]
        if not names or len(set(names)) < len(names):
            raise ValueError(f"schedule: axes {names}, allowed is at least one, each of another name")

    @property
    def count(self) -> int:
        """Contexts of the grid."""
        return int(np.prod([len(axis.nodes) for axis in self.axes]))

    def space(self, base: ParameterSpace) -> ParameterSpace:
        """The space of the table: each scheduled parameter has its entries of one context next to each other, the last axis fastest.

        Raises ValueError for a part that is no parameter.
        """
        unknown = sorted(set(self.parts) - {p.name for p in base.parameters})
        if unknown:
            raise ValueError(f"schedule: parts names unknown {unknown}, allowed are {', '.join(p.name for p in base.parameters)}")
        return ParameterSpace(tuple(self._table(p) if self._has(p) else p for p in base.parameters))

    def shares(self, context: Mapping[str, float]) -> NDArray[np.float64]:
        """The share of each context of the grid, shape (count,); ValueError outside of its span, or where a quantity is not told."""
        missing = [axis.name for axis in self.axes if axis.name not in context]
        if missing:
            raise ValueError(f"context: {', '.join(missing)} is not told, which the schedule needs")
        out: NDArray[np.float64] = np.ones(1)
        for axis in self.axes:
            out = np.asarray(np.kron(out, axis.shares(context[axis.name])), dtype=np.float64)
        return out

    def theta(self, base: ParameterSpace, table: ArrayLike, context: Mapping[str, float]) -> NDArray[np.float64]:
        """theta of ``base`` in this context from a point of `space`."""
        shares, whole, unit = self.shares(context), self.space(base), []
        at = whole.to_unit(whole.validate(table))
        for p, part in zip(base.parameters, whole.slices.values(), strict=True):
            unit.append(shares @ at[part].reshape(self.count, p.size) if self._has(p) else at[part])
        return base.from_unit(np.concatenate(unit) if unit else np.zeros(0))

    def constant(self, base: ParameterSpace, theta: ArrayLike) -> NDArray[np.float64]:
        """The table that has the same theta in every context."""
        values, parts = base.validate(theta), base.slices
        return np.concatenate([np.tile(values[parts[p.name]], self.count if self._has(p) else 1) for p in base.parameters] or [np.zeros(0)])

    def _has(self, p: Parameter) -> bool:
        return not self.parts or p.name in self.parts

    def _table(self, p: Parameter) -> Parameter:
        default: Sequence[float] = p.default if isinstance(p.default, tuple) else (p.default,) * p.size
        shape = (*(len(axis.nodes) for axis in self.axes), *p.shape)
        return replace(p, size=self.count * p.size, default=tuple(default) * self.count, shape=shape)
