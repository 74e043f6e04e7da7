"""The QP of one iteration: the states eliminated, and the inputs in coordinates that make its Hessian the identity.

It is put together from one function for a stage, called for each: so the code grows with the horizon alone, and what takes many
operations are loops. For a small problem `ocp` writes the same out as straight-line code.
"""

from __future__ import annotations

from functools import cache, partial
from math import ceil
from typing import Any

import casadi as ca
import numpy as np

from chargetune.control.estimators import finite
from chargetune.control.layout import Layout
from chargetune.control.linearisation import Linearisation, dense, straight
from chargetune.runtime.split import split

__all__ = ["convex", "operations", "quadratic", "scaling", "span_of"]

# Least curvature of an input relative to the mean; only the steps depend on it, not the solution.
REGULARISATION = 1e-8
# A cost whose mean curvature is below this share of its mean slope (both over an input's range) is flat: a proximal term of that size
# stands in for its curvature, so that a step over the whole range costs a twenty-thousandth of what it gains.
FLAT = 1e-4
# Least curvature that stands in for a negative one.
LEAST_PIVOT = 1e-3
# A stage's function of at most so many multiplications is straight-line code: quicker than loops of a few turns, and compiled in a moment.
STAGE_MAX = 1500
# Sensitivities grow by a block a stage. They move on in at most so many chunks: straight-line code where that is short, or loops.
CHUNKS = 8
CHUNKS_OF_LOOPS = 4


def span_of(lower: Any, upper: Any) -> Any:
    """The range of each input, by which a step is scaled."""
    return ca.fmax(upper - lower, 1e-9 * (1 + ca.fabs(upper)))


def quadratic(layout: Layout, stage: Linearisation, final: Linearisation) -> ca.Function:
    """The QP by a Riccati recursion, in coordinates that make its Hessian the identity.

    With B = f_u range, stage Hessians [Q C'; C R] times gamma and P the cost to go, backwards

        r'r = R + B'P B,   h = r^-T (C + B'P A),   P <- Q + A'P A - h'h,   g = r^-T (l_u + B'p),   p <- l_x + A'p - h'g

    the cost is sum_i |e_i|^2 / 2 + g_i'e_i with e_i = r v_i + h dx_i. Forwards v_i = r^-1 (e_i - h dx_i) makes the bounds
    and rows lower triangular in e. That costs N^2 operations where condensing and factorising the Hessian costs N^3.
    """
    (nx, nu, _), size, count, slacks = stage.shape, layout.size, len(layout.groups), len(layout.prices)
    inputs, lower, upper = (ca.MX.sym(n, size) for n in ("U", "lower", "upper"))
    gamma, near = ca.MX.sym("gamma"), ca.MX.sym("near")
    rows, vector = ca.MX.sym("c", count), ca.MX.sym("D", layout.horizon * stage.length + final.length)
    blocks, last = _blocks(vector, layout, stage, final)
    # Each of these functions is made once for a form of stage.
    backward, forward = cache(_backward), cache(_forward)
    span = span_of(lower, upper)
    ranges = split(span, [nu] * len(layout.blocks))
    *_, final_x, _, final_slope, _, final_curve, _, _ = final.unpack(last)
    costate, weight = gamma * ca.densify(final_slope), gamma * ca.densify(final_curve)
    gradient: list[Any] = []
    laws: list[tuple[Any, Any]] = []
    for scale, (of, own) in zip(reversed(ranges), reversed(blocks), strict=True):
        inverse, law, slope, weight, costate = backward(of)(own, scale, near, gamma, weight, costate)
        gradient.insert(0, slope)
        laws.insert(0, (inverse, law))

    # Each row of the QP is a column of A'. Of the sensitivities of the state to e, a chunk of columns after the other is moved on.
    root = ca.sqrt(gamma * ca.DM(layout.prices))
    bounds, jacobian = [], []
    chunk = _chunk(layout, stage)
    nothing = _zeros(nu, nu * chunk)
    states: list[Any] = []
    for i, (scale, (inverse, law), (of, own)) in enumerate(zip(ranges, laws, blocks, strict=True)):
        if i % chunk == 0:
            states.append(_zeros(nx, nu * min(chunk, len(layout.blocks) - i)))
        moved, seen = [], []
        for k, one in enumerate(states):
            width = one.shape[1]
            before = nu * (i - k * chunk)
            new = ca.horzcat(_zeros(nu, before), inverse, _zeros(nu, width - nu - before)) if before < width else nothing
            states[k], move, row = forward(of, width)(one, own, scale, inverse, law, new)
            moved.append(move)
            seen.append(row)
        later = size - nu * min(chunk * len(states), len(layout.blocks))
        bounds.append(ca.horzcat(_zeros(nu, slacks), *moved, _zeros(nu, later)).T)
        if layout.stage_groups:
            groups = layout.stage_groups * layout.blocks[i]
            jacobian.append(ca.horzcat(_slacks(groups, root), *seen, _zeros(len(groups), later)).T)
    if layout.final_groups:
        jacobian.append(ca.horzcat(_slacks(layout.final_groups, root), ca.densify(ca.mtimes(final_x, ca.horzcat(*states)))).T)

    data = [
        ca.vertcat(root, *gradient),
        ca.horzcat(*bounds, *jacobian),
        ca.vertcat((lower - inputs) / span, ca.MX(ca.DM(np.full(count, -np.inf)))),
        ca.vertcat((upper - inputs) / span, -rows),
        span,
    ]
    return ca.Function("quadratic", [inputs, rows, vector, lower, upper, gamma, near], data)


def scaling(layout: Layout, stage: Linearisation, final: Linearisation) -> ca.Function:
    """(D, lower, upper) -> (gamma, near) with gamma = 1 / max(mean of the scaled Hessian's diagonal, FLAT times that of the slope).

    With gamma the mean of the diagonal is one; where the cost has hardly a curvature ``near`` is what it lacks, else 0.
    """
    vector, lower, upper, blocks, last, ranges = _from_the_end(layout, stage, final)
    weigh = cache(_weigh)
    _, _, _, _, final_slope, _, final_curve, _, _ = final.unpack(last)
    weight, costate, total, steep = ca.densify(final_curve), ca.densify(final_slope), ca.MX(0.0), ca.MX(0.0)
    for scale, (of, own) in zip(reversed(ranges), reversed(blocks), strict=True):
        part, slope, weight, costate = weigh(of)(own, scale, weight, costate)
        total, steep = total + part, steep + slope
    # A derivative that is infinite where nothing depends on it (a root at 0) must not make gamma 0, with which all is optimal.
    curvature, slope = (ca.if_else(finite(value), value, 0) / layout.size for value in (total, FLAT * steep))
    gamma = 1 / ca.fmax(ca.fmax(curvature, slope), 1e-12)
    near = ca.if_else(curvature < slope, 1 - gamma * ca.fmax(curvature, 0), 0)
    return ca.Function("scaling", [vector, lower, upper], [gamma, near])


def convex(layout: Layout, stage: Linearisation, final: Linearisation, *, exact: bool) -> ca.Function:
    """(D, lower, upper) -> D as it is where the whole Hessian is positive definite, else with one nearby in every stage.

    The Riccati recursion has positive pivots where it is. Hessians that are not ``exact`` stay as they are.
    """
    vector, lower, upper, blocks, last, ranges = _from_the_end(layout, stage, final)
    if not exact:
        return ca.Function("convex", [vector, lower, upper], [vector])
    pivots = cache(_pivots)
    weight, smallest, largest = ca.densify(final.unpack(last)[6]), ca.MX(np.inf), ca.MX(0.0)
    for scale, (of, own) in zip(reversed(ranges), reversed(blocks), strict=True):
        least, most, weight = pivots(of)(own, scale, weight)
        smallest, largest = ca.fmin(smallest, least), ca.fmax(largest, most)
    definite = ca.Function("definite", [vector, lower, upper], [smallest > REGULARISATION * largest])
    each = []
    for of, count in ((stage, layout.horizon), (final, 1)):
        own = ca.SX.sym("D", of.length)
        each += [ca.Function("nearby", [own], dense(of.convex(own)))] * count
    parts = split(vector, [function.size1_in(0) for function in each])
    changed = ca.vertcat(*(function(part) for function, part in zip(each, parts, strict=True)))
    as_it_is, nearby = (ca.Function(name, [vector], [out]) for name, out in (("as_it_is", vector), ("nearby", changed)))
    choose = ca.Function.if_else("choose", as_it_is, nearby)
    return ca.Function("convex", [vector, lower, upper], [choose(definite(vector, lower, upper), vector)])


def _from_the_end(layout: Layout, stage: Linearisation, final: Linearisation) -> tuple[Any, ...]:
    """Symbols D, lower and upper, the derivatives of each block and of the end, and the ranges."""
    vector = ca.MX.sym("D", layout.horizon * stage.length + final.length)
    lower, upper = ca.MX.sym("lower", layout.size), ca.MX.sym("upper", layout.size)
    blocks, last = _blocks(vector, layout, stage, final)
    return vector, lower, upper, blocks, last, split(span_of(lower, upper), [layout.nu] * len(layout.blocks))


def operations(layout: Layout, stage: Linearisation) -> int:
    """About how many multiplications `quadratic` makes."""
    total = 0
    for i, length in enumerate(layout.blocks):
        of = _form(stage, length)
        composing = length * _composing_operations(stage) if length > 1 else 0
        total += composing + _backward_operations(of) + (i + 1) * layout.nu * _column_operations(of)
    return total


def _composing_operations(stage: Linearisation) -> int:
    nx, nu, _ = stage.shape
    f_x, _, c_x, _, _, _, l_xx, l_ux, _ = (pattern.nnz() for pattern in stage.patterns)
    return (f_x + c_x + l_xx + l_ux) * (nx + nu) + nx * nx * (nx + nu) + nx * nu * nu


def _backward_operations(of: Linearisation) -> int:
    nx, nu, _ = of.shape
    f_x, f_u, *_ = (pattern.nnz() for pattern in of.patterns)
    return 4 * f_x * nx + 3 * f_u * nx + 2 * nx * nu * nu


def _column_operations(of: Linearisation) -> int:
    nx, nu, _ = of.shape
    return sum(pattern.nnz() for pattern in of.patterns[:4]) + nx * nu + nu * nu


def _chunk(layout: Layout, stage: Linearisation) -> int:
    """Blocks of columns that `_forward` moves on at once."""
    short = STAGE_MAX // (layout.nu * _column_operations(_form(stage, max(layout.blocks))))
    count = len(layout.blocks)
    return short if short * CHUNKS >= count else ceil(count / CHUNKS_OF_LOOPS)


def _weigh(of: Linearisation) -> ca.Function:
    """(D, range, P, p) -> trace of the scaled R + B'P B, size of the scaled slope, P <- Q + A'P A, p <- l_x + A'p."""
    own, scale, weight = ca.MX.sym("D", of.length), ca.MX.sym("range", of.shape[1]), ca.MX.sym("P", of.shape[0], of.shape[0])
    costate = ca.MX.sym("p", of.shape[0])
    f_x, f_u, _, _, l_x, l_u, l_xx, _, l_uu = of.unpack(own)
    block = ca.densify(l_uu + ca.mtimes(f_u.T, ca.mtimes(weight, f_u)))
    slope = ca.sum1(ca.fabs(scale * ca.densify(l_u + ca.mtimes(f_u.T, costate))))
    before = [ca.densify(l_xx + ca.mtimes(f_x.T, ca.mtimes(weight, f_x))), ca.densify(l_x + ca.mtimes(f_x.T, costate))]
    function = ca.Function("weigh", [own, scale, weight, costate], [ca.dot(scale**2, ca.diag(block)), slope, *before])
    return straight(function) if _backward_operations(of) <= STAGE_MAX else function


def _pivots(of: Linearisation) -> ca.Function:
    """(D, range, P) -> least and largest pivot of the scaled R + B'P B, P of the stage before."""
    nx, nu, _ = of.shape
    own, ranges, weight = ca.SX.sym("D", of.length), ca.SX.sym("range", nu), ca.SX.sym("P", nx, nx)
    f_x, f_u, _, _, _, _, l_xx, l_ux, l_uu = of.unpack(own)
    scale = ca.diag(ranges)
    ahead = ca.mtimes(ca.mtimes(f_u, scale).T, weight)
    rest = ca.densify(ca.mtimes([scale, l_uu, scale]) + ca.mtimes(ahead, ca.mtimes(f_u, scale)))
    law = ca.densify(ca.mtimes(scale, l_ux) + ca.mtimes(ahead, f_x))
    before, least, most = ca.densify(l_xx + ca.mtimes([f_x.T, weight, f_x])), ca.SX(np.inf), ca.SX(0)
    for k in range(nu):
        pivot, below, row = rest[k, k], rest[:, k], law[k, :]
        least, most = ca.fmin(least, pivot), ca.fmax(most, pivot)
        before -= ca.mtimes(row.T, row) / pivot
        law -= ca.mtimes(below, row) / pivot
        rest -= ca.mtimes(below, below.T) / pivot
    return ca.Function("pivots", [own, ranges, weight], dense(least, most, before))


def _backward(of: Linearisation) -> ca.Function:
    """(D, range, near, gamma, P, p) -> (r^-1, h, g, P, p) of the stage before."""
    nx, nu, _ = of.shape
    own, ranges, near, gamma = ca.MX.sym("D", of.length), ca.MX.sym("range", nu), ca.MX.sym("near"), ca.MX.sym("gamma")
    weight, costate = ca.MX.sym("P", nx, nx), ca.MX.sym("p", nx)
    f_x, f_u, _, _, l_x, l_u, l_xx, l_ux, l_uu = of.unpack(own)
    scale = ca.diag(ranges)
    into = ca.mtimes(f_u, scale)
    ahead = ca.mtimes(into.T, weight)
    inverse = _factor(nu)(ca.densify(ca.mtimes([scale, gamma * l_uu, scale]) + ca.mtimes(ahead, into)) + near * ca.DM.eye(nu))
    law = ca.densify(ca.mtimes(inverse.T, gamma * ca.mtimes(scale, l_ux) + ca.mtimes(ahead, f_x)))
    slope = ca.densify(ca.mtimes(inverse.T, gamma * ca.mtimes(scale, l_u) + ca.mtimes(into.T, costate)))
    before = ca.densify(gamma * l_x + ca.mtimes(f_x.T, costate) - ca.mtimes(law.T, slope))
    weighed = ca.densify(gamma * l_xx + ca.mtimes(f_x.T, ca.mtimes(weight, f_x)) - ca.mtimes(law.T, law))
    function = ca.Function("backward", [own, ranges, near, gamma, weight, costate], [inverse, law, slope, weighed, before])
    return straight(function) if _backward_operations(of) <= STAGE_MAX else function


def _forward(of: Linearisation, width: int) -> ca.Function:
    """(columns of dx, D, range, r^-1, h, e) -> columns of (dx after the stage, v, rows)."""
    nx, nu, _ = of.shape
    own, ranges, inverse, law = ca.MX.sym("D", of.length), ca.MX.sym("range", nu), ca.MX.sym("inverse", nu, nu), ca.MX.sym("law", nu, nx)
    states, new = ca.MX.sym("dx", nx, width), ca.MX.sym("e", nu, width)
    f_x, f_u, c_x, c_u, *_ = of.unpack(own)
    moves = new - ca.mtimes(inverse, ca.mtimes(law, states))
    scaled = ca.mtimes(ca.diag(ranges), moves)
    after, seen = (ca.densify(ca.mtimes(x, states) + ca.mtimes(u, scaled)) for x, u in ((f_x, f_u), (c_x, c_u)))
    function = ca.Function("forward", [states, own, ranges, inverse, law, new], [after, moves, seen])
    return straight(function) if width * _column_operations(of) <= STAGE_MAX else function


def _factor(nu: int) -> ca.Function:
    """M -> r^-1, upper triangular, where r'r is M with the regularisation; a pivot that is not positive is taken as if it were."""
    block = ca.SX.sym("M", nu, nu)
    r, rest = ca.SX(nu, nu), block + REGULARISATION * ca.SX.eye(nu)
    for k in range(nu):
        pivot = rest[k, k]
        r[k, k] = ca.sqrt(ca.if_else(pivot >= REGULARISATION, pivot, ca.fmax(-pivot, LEAST_PIVOT)))
        for j in range(k + 1, nu):
            r[k, j] = rest[k, j] / r[k, k]
        for i in range(k + 1, nu):
            for j in range(k + 1, nu):
                rest[i, j] -= r[k, i] * r[k, j]
    return ca.Function("factor", [block], dense(ca.solve(r, ca.SX.eye(nu))))


def _zeros(rows: int, columns: int) -> Any:
    return ca.MX(ca.DM.zeros(rows, columns))


def _slacks(groups: tuple[int, ...], root: Any) -> Any:
    """Rows of A for the slacks: c + dc - s_j / sqrt(price) <= 0; a hard row has none."""
    where = np.zeros((len(groups), root.shape[0]))
    for row, limit in enumerate(groups):
        if limit >= 0:
            where[row, limit] = -1.0
    return ca.MX(ca.DM(where)) / ca.repmat(root.T, len(groups), 1)


def _blocks(vector: Any, layout: Layout, stage: Linearisation, final: Linearisation) -> tuple[list[tuple[Linearisation, Any]], Any]:
    """The derivatives of each block as those of one long interval, and the vector of those of the end."""
    *stages, last = split(vector, (*[stage.length] * layout.horizon, final.length))
    composition, blocks = cache(partial(_composition, stage)), []
    for parts in layout.together(stages):
        if len(parts) == 1:
            blocks.append((stage, parts[0]))
        else:
            of, compose = composition(len(parts))
            blocks.append((of, compose(ca.vertcat(*parts))))
    return blocks, last


def _composition(stage: Linearisation, length: int) -> tuple[Linearisation, ca.Function]:
    """One stage of several, in which the input is held: dx = X dx_0 + V du at the start of each, and so forth."""
    nx, nu, _ = stage.shape
    vector = ca.MX.sym("D", length * stage.length)
    x, v = ca.MX(ca.DM.eye(nx)), _zeros(nx, nu)
    c_of_x, c_of_u = [], []
    slope_x, slope_u, curve_xx, curve_ux, curve_uu = _zeros(nx, 1), _zeros(nu, 1), _zeros(nx, nx), _zeros(nu, nx), _zeros(nu, nu)
    for part in split(vector, [stage.length] * length):
        f_x, f_u, c_x, c_u, l_x, l_u, l_xx, l_ux, l_uu = stage.unpack(part)
        c_of_x.append(ca.densify(ca.mtimes(c_x, x)))
        c_of_u.append(ca.densify(ca.mtimes(c_x, v) + c_u))
        slope_x += ca.mtimes(x.T, l_x)
        slope_u += ca.mtimes(v.T, l_x) + l_u
        cross = ca.mtimes(l_ux, v)
        curve_xx += ca.mtimes(x.T, ca.mtimes(l_xx, x))
        curve_ux += ca.mtimes(ca.mtimes(v.T, l_xx) + l_ux, x)
        curve_uu += ca.mtimes(ca.mtimes(v.T, l_xx), v) + cross + cross.T + l_uu
        x, v = ca.densify(ca.mtimes(f_x, x)), ca.densify(ca.mtimes(f_x, v) + f_u)
    pieces = (x, v, ca.vertcat(*c_of_x), ca.vertcat(*c_of_u), slope_x, slope_u, curve_xx, curve_ux, curve_uu)
    packed = ca.vertcat(*(ca.vec(ca.densify(piece)) for piece in pieces))
    return _form(stage, length), ca.Function("compose", [vector], [packed])


def _form(stage: Linearisation, length: int) -> Linearisation:
    """The form of the derivatives of so many intervals as one: dense, but for a single one."""
    if length == 1:
        return stage
    nx, nu, width = stage.shape
    rows = length * width
    shapes = ((nx, nx), (nx, nu), (rows, nx), (rows, nu), (nx, 1), (nu, 1), (nx, nx), (nu, nx), (nu, nu))
    return Linearisation(tuple(ca.Sparsity.dense(*shape) for shape in shapes))
