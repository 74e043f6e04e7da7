"""Curvature of a cost in what the input can change."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from chargetune.model.model import Model
from chargetune.model.parameter_space import ParameterSpace

__all__ = ["Curvature", "curvature_of", "nearby_convex", "reached_states"]

# Random points at which the curvature is looked at, beside start and set-point.
POINTS = 8


@dataclass(frozen=True)
class Curvature:
    """Least and largest eigenvalue of a cost's Hessian over the points looked at.

    ``of``: what the Hessian is taken of, the inputs and the states that they reach; ``along``: those that the least one points to;
    ``of_states``: whether the states have a part in it.
    """

    least: float
    largest: float
    of: tuple[str, ...]
    along: tuple[str, ...]
    of_states: bool

    @property
    def convex(self) -> bool:
        return self.least >= -1e-9 * (1.0 + self.largest)


def reached_states(model: Model) -> tuple[int, ...]:
    """Indices of the states that some input can change, now or later, by the structure of f."""
    by_input, by_state = model.f.jac_sparsity(0, 1), model.f.jac_sparsity(0, 0)
    rows, columns = by_state.get_triplet()
    reached = set(by_input.get_triplet()[0])
    while True:
        more = {row for row, column in zip(rows, columns, strict=True) if column in reached} - reached
        if not more:
            return tuple(sorted(reached))
        reached |= more


def curvature_of(cost: ca.Function, model: Model, theta: ParameterSpace, setpoint: Sequence[float], start: Sequence[float]) -> Curvature:
    """The curvature of a cost (x, u, theta, p, setpoint, now, u_last, given) in u, u_last and the states that u reaches.

    Looked at are start, set-point and random points; the other states are no choice of the controller's.
    """
    x, u, *others, last, given = cost.sx_in()
    reached = reached_states(model)
    names = [*model.input_names, *(f"{n} before" for n in model.input_names), *(model.state_names[i] for i in reached)]
    free = ca.vertcat(u, last, *(x[i] for i in reached))
    hessian = ca.hessian(cost(x, u, *others, last, given), free)[0]
    evaluate = ca.Function("curvature", [x, u, *others, last, given], [hessian])
    draw, nx = np.random.default_rng(0), len(start)
    default, wanted, size = theta.default, np.array(setpoint), len(setpoint)
    begin = np.array(start)
    places = [(np.pad(begin, (0, size - nx)), default, begin), (wanted, default, wanted[:nx])]
    for _ in range(POINTS):
        point = draw.uniform(theta.lower, theta.upper) if default.size else default
        places.append((draw.uniform(-1.0, 1.0, size), point, draw.uniform(-1.0, 1.0, nx)))
    least, largest, of_states = 0.0, 0.0, False
    along: tuple[str, ...] = ()
    for xu, at, now in places:
        signals = draw.uniform(-1.0, 1.0, given.shape[0])
        matrix = np.array(evaluate(xu[:nx], xu[nx:], at, model.nominal, wanted, now, xu[nx:], signals))
        if not matrix.size or not np.all(np.isfinite(matrix)):
            continue
        values, vectors = np.linalg.eigh(matrix)
        first_state = len(names) - len(reached)
        of_states = of_states or bool(np.any(matrix[first_state:, first_state:]))
        largest = max(largest, float(values[-1]))
        if values[0] < least:
            least = float(values[0])
            along = tuple(name for name, share in zip(names, np.abs(vectors[:, 0]), strict=True) if share > 0.1)
    return Curvature(least, largest, tuple(names), along, of_states)


def nearby_convex(matrix: Any) -> Any:
    """A positive definite matrix near a symmetric one (SX, n x n), and that one itself where it is positive definite by far.

    L D L' with d_j = max(|c_jj|, (max_i |c_ij| / beta)^2, delta) in place of the pivots c_jj.
    Source: Gill, Murray and Wright, Practical Optimization, 1981, sec. 4.4.2.2.
    """
    size = matrix.shape[0]
    rest = ca.SX(ca.densify(matrix))
    on, off = ca.SX(0), ca.SX(0)
    for i in range(size):
        on = ca.fmax(on, ca.fabs(rest[i, i]))
        for j in range(i):
            off = ca.fmax(off, ca.fabs(rest[i, j]))
    bound = ca.fmax(ca.fmax(on, off / np.sqrt(max(size**2 - 1, 1))), 1e-30)
    out = ca.SX.zeros(size, size)
    for k in range(size):
        below = rest[:, k]
        most = ca.SX(0)
        for i in range(k + 1, size):
            most = ca.fmax(most, ca.fabs(rest[i, k]))
        pivot = ca.fmax(ca.fmax(ca.fabs(rest[k, k]), most**2 / bound), 1e-12 * (on + off) + 1e-30)
        column = ca.SX(below)
        column[k] = pivot
        for i in range(k):
            column[i] = 0
        part = ca.mtimes(column, column.T) / pivot
        out += part
        rest -= part
    return (out + out.T) / 2
