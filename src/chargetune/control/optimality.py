"""How good a plan is: its merit, its optimality, and the Lagrangian's curvature in the inputs, from the stages' derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np

from chargetune.control.condensing import span_of
from chargetune.control.estimators import finite
from chargetune.control.layout import Layout, greatest, largest, least
from chargetune.control.linearisation import Linearisation, dense
from chargetune.control.window import Window
from chargetune.runtime.split import split

__all__ = ["adjoint", "curvature", "merit", "residual"]


def merit(layout: Layout) -> ca.Function:
    """(J, c) -> J + sum of price (s + s^2 / 2), infinite where a row is no number."""
    cost, rows = ca.MX.sym("J"), ca.MX.sym("c", len(layout.groups))
    total = cost
    if layout.prices:
        s = layout.violations(rows)
        total += ca.dot(ca.DM(layout.prices), s + s**2 / 2)
    if layout.groups:
        # The running maximum drops a NaN; the sum keeps it, so that the line search refuses the point.
        total = ca.if_else(finite(ca.sum1(rows)), total, np.inf)
    return ca.Function("merit", [cost, rows], [total])


def residual(layout: Layout, adjoints: tuple[ca.Function, ca.Function]) -> ca.Function:
    """Natural residual at U with multipliers lambda >= 0 of the rows (all in the scaled problem).

    stationarity      clip(-range gamma (g + A' lambda), (lower - U) / range, (upper - U) / range) is zero
    complementarity   min(lambda_i, s_j - c_i) is zero with s_j = max(0, max c_i): an unused row has no multiplier
    exactness         min(s_j, 1 + s_j - sum lambda / w_j) is zero: a violation only where the penalty is spent
    """
    size, count = layout.size, len(layout.groups)
    inputs, lower, upper = (ca.MX.sym(n, size) for n in ("U", "lower", "upper"))
    rows, multipliers, gamma = ca.MX.sym("c", count), ca.MX.sym("lambda", count), ca.MX.sym("gamma")
    back, end = adjoints
    lengths = (*[back.size1_in(0)] * layout.horizon, end.size1_in(0))
    vector = ca.MX.sym("D", sum(lengths))
    *stages, last = split(vector, lengths)
    span, (prices, last_price) = span_of(lower, upper), layout.rows(multipliers)
    costate = end(last, last_price, gamma)
    slopes: list[Any] = []
    for own, price in zip(reversed(stages), reversed(prices), strict=True):
        costate, slope = back(own, costate, price, gamma)
        slopes.insert(0, slope)
    gradient = ca.vertcat(*_summed(slopes, layout)) * span
    residuals = [least(greatest(-gradient, (lower - inputs) / span), (upper - inputs) / span)]
    s = layout.violations(rows) if layout.prices else ca.MX(0, 1)
    if layout.groups:
        residuals.append(least(multipliers, layout.spread(s) - rows))
    if layout.prices:
        # Relative to the price, which is so large that its rounding alone would exceed the tolerance.
        spent = layout.sums(multipliers) / (gamma * ca.DM(layout.prices))
        residuals.append(least(s, 1 + s - spent))
    everything = ca.fabs(ca.vertcat(*residuals))
    # A maximum drops a NaN, also that of a pair above; sums keep it.
    known = ca.sum1(everything) + ca.sum1(ca.fabs(ca.vertcat(gradient, rows, multipliers)))
    worst = ca.if_else(ca.logic_and(finite(known), gamma > 0), largest(everything.T), np.inf)
    return ca.Function("residual", [inputs, rows, vector, multipliers, gamma, lower, upper], [worst])


def curvature(
    layout: Layout,
    weights: Sequence[float],
    follow: ca.Function,
    seconds: tuple[ca.Function, ca.Function],
    adjoints: tuple[ca.Function, ca.Function],
    window: Window,
    at_start: ca.Function,
) -> ca.Function:
    """`Problem.curvature`: to the derivatives what the second ones of stage and end add, an interval after the other from the end."""
    (second, second_final), (back, end) = seconds, adjoints
    horizon = layout.horizon
    now, inputs, q = ca.MX.sym("now", follow.size1_in(0)), ca.MX.sym("U", layout.size), ca.MX.sym("q", window.length)
    lengths = (*[back.size1_in(0)] * horizon, end.size1_in(0))
    vector, multipliers = ca.MX.sym("D", sum(lengths)), ca.MX.sym("lambda", len(layout.groups))
    controls = layout.inputs(inputs)
    *derivatives, last_derivatives = split(vector, lengths)
    prices, last_price = layout.rows(multipliers)
    states = [now]
    for i, u in enumerate(controls):
        states.append(follow(states[-1], u, window.at(q, i)))
    costate = end(last_derivatives, last_price, 1.0)
    out: list[Any] = [last_derivatives + second_final(states[-1], now, window.at(q, horizon), last_price)]
    for i in reversed(range(horizon)):
        bent = second(states[i], controls[i], now, window.at(q, i), weights[i], costate, prices[i])
        out.insert(0, derivatives[i] + bent if i else at_start(derivatives[i] + bent))
        costate, _ = back(derivatives[i], costate, prices[i], 1.0)
    return ca.Function("curvature", [now, inputs, vector, multipliers, q], [ca.vertcat(*out)])


def adjoint(stage: Linearisation, final: Linearisation) -> tuple[ca.Function, ca.Function]:
    """(D, costate, multipliers, gamma) -> (costate, slope in the input) of a stage, (D, multipliers, gamma) -> costate of the end."""
    own, last = ca.SX.sym("D", stage.length), ca.SX.sym("D", final.length)
    nx, _, width = stage.shape
    ahead, mu, gamma = ca.SX.sym("costate", nx), ca.SX.sym("lambda", width), ca.SX.sym("gamma")
    f_x, f_u, c_x, c_u, l_x, l_u, *_ = stage.unpack(own)
    *_, final_x, _, final_slope, _, _, _, _ = final.unpack(last)
    mu_last = ca.SX.sym("lambda", final_x.shape[0])
    slopes = (gamma * cost + ca.mtimes(c.T, mu) + ca.mtimes(f.T, ahead) for f, c, cost in ((f_x, c_x, l_x), (f_u, c_u, l_u)))
    back = ca.Function("back", [own, ahead, mu, gamma], dense(*slopes))
    return back, ca.Function("end", [last, mu_last, gamma], dense(gamma * final_slope + ca.mtimes(final_x.T, mu_last)))


def _summed(intervals: list[Any], layout: Layout) -> list[Any]:
    """Of what stands for each interval the sum over each block."""
    return [sum(parts[1:], parts[0]) for parts in layout.together(intervals)]
