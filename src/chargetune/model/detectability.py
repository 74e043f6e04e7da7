"""Detectability: which states of a model the measured outputs cannot tell apart, by name."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from chargetune.model.model import Model

__all__ = ["Unseen", "check_setpoint", "undetectable", "unseen"]

# A singular value below this share of the largest is zero: derivatives are exact, and rounding is 1e-16.
RANK = 1e-9
# An entry of a direction below this share of its largest plays no part in it.
SHARE = 0.05
# A direction of which less than this is left at the end of an episode dies out by itself.
DECAYED = 0.9
# Growth of a deviation in an unstable model up to which others beside it are not lost in rounding.
GROWTH = 1e6


@dataclass(frozen=True)
class Unseen:
    """A direction that the measurements do not see: the states that take part in it, and what it moved them by.

    seen (K,): along an episode, up to each interval, the root of the summed squares of what one ``scale`` of it moved the measured
    outputs by, in their unit or in their noise; at a set-point it is empty.
    """

    states: tuple[str, ...]
    seen: NDArray[np.float64]


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

    Raises ValueError for unknown names, shapes that do not fit and derivatives that are not finite.
    """
    return [group.states for group in unseen(model, measured, states, inputs, known=known, scale=scale, rank=rank)]


def unseen(
    model: Model,
    measured: Sequence[str],
    states: ArrayLike,
    inputs: ArrayLike,
    *,
    known: Sequence[str] = (),
    scale: Mapping[str, float] | None = None,
    noise: Mapping[str, float] | None = None,
    parameters: ArrayLike | None = None,
    rank: float = RANK,
) -> list[Unseen]:
    """`undetectable` with what each direction moves, and what is unseen in practice.

    ``noise``: standard deviations of the measured outputs. A direction then counts as unseen as well where one ``scale`` of it moves
    all measurements together by less than one of those: what is known beforehand is worth more than all that is measured.
    ``parameters``: p of each interval, (K, np), or one for all; None: the model's.
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
    if not free:
        return []
    names = [model.state_names[i] for i in free]
    sizes = np.array([float((scale or {}).get(name, 1.0)) for name in names])
    rows = [model.output_names.index(name) for name in measured]
    units = np.array([float((noise or {}).get(name, 1.0)) for name in measured])
    p = np.broadcast_to(model.nominal if parameters is None else np.asarray(parameters, dtype=float), (*x.shape[:-1], model.nominal.size))
    slopes = _slopes(model)
    # A known state has no error, whatever the others do to it.
    places = np.ix_(free, free)

    def derivatives(*at: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        a, c = (np.array(value) for value in slopes(*at))
        a, c = a[places] * sizes / sizes[:, None], c[np.ix_(rows, free)] * sizes / units[:, None]
        if not (np.all(np.isfinite(a)) and np.all(np.isfinite(c))):
            raise ValueError(
                f"detectability of {model.name}: the derivatives at states {list(at[0])} and inputs {list(at[1])} are not finite"
            )
        return a, c

    if x.ndim == 1:
        a, c = derivatives(x, u, p)
        return [Unseen(_names(v, names), np.empty(0)) for v in _echelon(_null(np.vstack([a - np.eye(len(free)), c]), rank))]
    moved, seen, largest = np.eye(len(free)), [], 0.0
    left: NDArray[np.float64] | None = None
    for at in zip(x, u, p, strict=True):
        a, c = derivatives(*at)
        seen.append(c @ moved)
        ahead = a @ moved
        largest = largest or GROWTH * max(1.0, float(np.linalg.norm(ahead)))
        if np.linalg.norm(ahead) > largest:
            # What grows for ever must not hide the rest: rows may be scaled, and what has died out is judged before that.
            left = moved if left is None else left
            ahead *= largest / np.linalg.norm(ahead)
        moved = ahead
    stacked = np.vstack(seen) if rows else np.zeros((1, len(free)))
    null = _null(stacked, rank, 0.0 if noise is None else 1.0)
    if null.size:
        # Of what is not seen, only what does not die out by itself.
        _, lasting, directions = np.linalg.svd((moved if left is None else left) @ null)
        null = null @ directions[: lasting.size][lasting > DECAYED].T
    found = []
    for v in _echelon(null):
        each = np.array([float(np.sum((c @ v) ** 2)) for c in seen]) / float(v @ v)
        found.append(Unseen(_names(v, names), np.sqrt(np.cumsum(each))))
    return found


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


def _null(matrix: NDArray[np.float64], rank: float, least: float = 0.0) -> NDArray[np.float64]:
    """An orthonormal basis of what the matrix maps to zero, or to less than ``least``, shape (n, k)."""
    _, values, directions = np.linalg.svd(matrix)
    padded = np.zeros(matrix.shape[1])
    padded[: values.size] = values
    small = padded <= max(rank * max(float(padded[0]), np.finfo(float).tiny), least)
    return np.asarray(directions[small].T, dtype=np.float64)


def _echelon(null: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """The basis in echelon form, so that no direction has more entries than it needs."""
    vectors = [np.array(column) for column in null.T]
    reduced: list[NDArray[np.float64]] = []
    while vectors:
        # The entry that is largest over all that is left becomes that direction's own.
        k, i = np.unravel_index(int(np.argmax(np.abs(vectors))), (len(vectors), vectors[0].size))
        own = vectors.pop(int(k))
        own = own / own[i]
        vectors = [v - v[i] * own for v in vectors]
        reduced = [v - v[i] * own for v in reduced] + [own]
    return reduced


def _names(vector: NDArray[np.float64], names: Sequence[str]) -> tuple[str, ...]:
    """The states that take part in a direction."""
    return tuple(n for n, v in zip(names, vector, strict=True) if abs(v) > SHARE * np.max(np.abs(vector)))
