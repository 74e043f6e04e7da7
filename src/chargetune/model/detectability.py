"""Detectability: which states of a model the measured outputs cannot tell apart, by name."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from chargetune.model.model import Model

__all__ = ["check_setpoint", "undetectable"]

# A singular value below this share of the largest is zero: derivatives are exact, and rounding is 1e-16.
RANK = 1e-9
# An entry of a direction below this share of its largest plays no part in it.
SHARE = 0.05
# A direction of which less than this is left at the end of an episode dies out by itself.
DECAYED = 0.9


def undetectable(
    model: Model,
    measured: Sequence[str],
    states: ArrayLike,
    inputs: ArrayLike,
    *,
    known: Sequence[str] = (),
    scale: Mapping[str, float] | None = None,
    rank: float = RANK,
) -> list[tuple[str, ...]]:
    """Groups of states that cannot be told apart; an empty list means detectable.

    At a set-point (``states`` (nx,), ``inputs`` (nu,)) the directions v with

        [A - I; C] v = 0

    which no measurement in steady state sees: for a model with integrating disturbances that is the rank test of Pannocchia and
    Rawlings, AIChE J. 49 (2003) 426, on [A - I, B_d; C, C_d]. Along an episode (``states`` (K, nx), ``inputs`` (K, nu)) those of

        [C_0; C_1 Phi_1; ..; C_{K-1} Phi_{K-1}] v = 0,   Phi_k = A_{k-1} .. A_0,

    with A = df/dx and C = dh/dx, unless Phi_K v has died out. ``known`` states are not estimated. ``scale``: a typical size of a state,
    1 where none is given; a singular value below ``rank`` times the largest counts as zero.

    Raises ValueError for unknown names and shapes that do not fit.
    """
    for field, names, allowed in (("measured", measured, model.output_names), ("known", known, model.state_names)):
        unknown = [name for name in names if name not in allowed]
        if unknown:
            raise ValueError(f"detectability of {model.name}: {field} = {unknown}, allowed are {', '.join(allowed)}")
    x, u = np.asarray(states, dtype=float), np.asarray(inputs, dtype=float)
    nx, nu = len(model.states), len(model.inputs)
    if x.ndim != u.ndim or x.ndim not in (1, 2) or x.shape[-1] != nx or u.shape[-1] != nu or x.shape[:-1] != u.shape[:-1]:
        raise ValueError(f"detectability of {model.name}: states {x.shape} and inputs {u.shape}, allowed are (K, {nx}) and (K, {nu})")
    free = [i for i, name in enumerate(model.state_names) if name not in known]
    names = [model.state_names[i] for i in free]
    sizes = np.array([float((scale or {}).get(name, 1.0)) for name in names])
    rows = [model.output_names.index(name) for name in measured]
    slopes = _slopes(model)
    # A known state has no error, whatever the others do to it.
    places = np.ix_(free, free)

    def derivatives(at: NDArray[np.float64], push: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        a, c = (np.array(value) for value in slopes(at, push, model.nominal))
        return a[places] * sizes / sizes[:, None], c[np.ix_(rows, free)] * sizes

    if x.ndim == 1:
        a, c = derivatives(x, u)
        return _groups(_null(np.vstack([a - np.eye(len(free)), c]), rank), names)
    moved, seen = np.eye(len(free)), []
    for at, push in zip(x, u, strict=True):
        a, c = derivatives(at, push)
        seen.append(c @ moved)
        moved = a @ moved
    null = _null(np.vstack(seen) if rows else np.zeros((1, len(free))), rank)
    if null.size:
        # Of what is not seen, only what does not die out by itself.
        _, left, directions = np.linalg.svd(moved @ null)
        null = null @ directions[left > DECAYED].T if left.size else null
    return _groups(null, names)


def check_setpoint(model: Model, measured: Sequence[str], setpoint: Mapping[str, float]) -> None:
    """Raises ValueError naming the states that the measured outputs cannot tell apart at this set-point (others are 0)."""
    allowed = (*model.state_names, *model.input_names)
    unknown = sorted(set(setpoint) - set(allowed))
    if unknown:
        raise ValueError(f"detectability of {model.name}: setpoint names {unknown}, allowed are {', '.join(allowed)}")
    at = [[setpoint.get(name, 0.0) for name in names] for names in (model.state_names, model.input_names)]
    groups = undetectable(model, measured, *at)
    if groups:
        alike = "; ".join(", ".join(group) for group in groups)
        raise ValueError(
            f"disturbances of {model.name}: {alike} cannot be told apart at the set-point from measured = {list(measured)}; "
            "allowed are disturbances with [A - I, B_d; C, C_d] of full column rank: at most one for each measured output"
        )


def _slopes(model: Model) -> ca.Function:
    x, u = ca.SX.sym("x", len(model.states)), ca.SX.sym("u", len(model.inputs))
    p = ca.SX.sym("p", model.nominal.size)
    return ca.Function("slopes", [x, u, p], [ca.densify(ca.jacobian(model.f(x, u, p), x)), ca.densify(ca.jacobian(model.h(x, u, p), x))])


def _null(matrix: NDArray[np.float64], rank: float) -> NDArray[np.float64]:
    """An orthonormal basis of what the matrix maps to zero, shape (n, k)."""
    _, values, directions = np.linalg.svd(matrix)
    padded = np.zeros(matrix.shape[1])
    padded[: values.size] = values
    return np.asarray(directions[padded <= rank * max(float(padded[0]), np.finfo(float).tiny)].T, dtype=np.float64)


def _groups(null: NDArray[np.float64], names: Sequence[str]) -> list[tuple[str, ...]]:
    """Which names take part in each direction; a basis in echelon form, so that no direction has more of them than it needs."""
    vectors = [np.array(column) for column in null.T]
    reduced: list[NDArray[np.float64]] = []
    while vectors:
        # The entry that is largest over all that is left becomes that direction's own.
        k, i = np.unravel_index(int(np.argmax(np.abs(vectors))), (len(vectors), len(names)))
        own = vectors.pop(int(k))
        own = own / own[i]
        vectors = [v - v[i] * own for v in vectors]
        reduced = [v - v[i] * own for v in reduced] + [own]
    return [tuple(n for n, v in zip(names, vector, strict=True) if abs(v) > SHARE * np.max(np.abs(vector))) for vector in reduced]
