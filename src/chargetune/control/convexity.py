"""Curvature of a cost in what the input can change."""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np

from chargetune.model.model import Model
from chargetune.model.parameter_space import ParameterSpace

__all__ = ["reached_states", "refuse_nonconvex"]

# Random points at which the curvature is looked at, beside start and set-point.
POINTS = 8


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


def refuse_nonconvex(
    label: str, cost: ca.Function, model: Model, theta: ParameterSpace, setpoint: Sequence[float], start: Sequence[float]
) -> None:
    """ValueError where a cost (x, u, theta, p, setpoint, now, u_last, given) is bent downwards in u, u_last and the states that u reaches.

    Looked at are start, set-point and random points; the others are no choice of the controller's.
    """
    x, u, *others, last, given = cost.sx_in()
    reached = reached_states(model)
    names = [f"x[{model.state_names[i]}]" for i in reached]
    names += [*(f"u[{n}]" for n in model.input_names), *(f"u_last[{n}]" for n in model.input_names)]
    free = ca.vertcat(*(x[i] for i in reached), u, last)
    value = cost(x, u, *others, last, given)
    curvature = ca.Function("curvature", [x, u, *others, last, given], [ca.hessian(value, free)[0]])
    draw, nx = np.random.default_rng(0), len(start)
    default, wanted, size = theta.default, np.array(setpoint), len(setpoint)
    begin = np.array(start)
    places = [(np.pad(begin, (0, size - nx)), default, begin), (wanted, default, wanted[:nx])]
    for _ in range(POINTS):
        point = draw.uniform(theta.lower, theta.upper) if default.size else default
        places.append((draw.uniform(-1.0, 1.0, size), point, draw.uniform(-1.0, 1.0, nx)))
    for xu, at, now in places:
        signals = draw.uniform(-1.0, 1.0, given.shape[0])
        matrix = np.array(curvature(xu[:nx], xu[nx:], at, model.nominal, wanted, now, xu[nx:], signals))
        if not np.all(np.isfinite(matrix)):
            continue
        values, vectors = np.linalg.eigh(matrix)
        if values[0] < -1e-9 * (1.0 + abs(values[-1])):
            bent = [name for name, share in zip(names, np.abs(vectors[:, 0]), strict=True) if share > 0.1]
            raise ValueError(
                f"controller: {label} has curvature {values[0]:.3g} in ({', '.join(bent)}), allowed is a convex function (curvature >= 0) "
                f"of the inputs and of the states that they reach, {', '.join(names[: len(reached)]) or 'none'}"
            )
