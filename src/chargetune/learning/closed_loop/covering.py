"""Covering: the theta with which the controller's own predictions are at least as cautious as what was measured, by a linear program."""

from __future__ import annotations

import warnings
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linprog
from scipy.sparse import csr_matrix, hstack, identity

from chargetune.control.controller import Controller
from chargetune.episode.episode import Episode
from chargetune.runtime.cache import cached
from chargetune.runtime.counted import counted
from chargetune.runtime.hoisting import hoist
from chargetune.runtime.numpy_call import numpy_call

__all__ = ["covering", "predicted_rows"]

# Penalty on a sample that is not covered, relative to the cost of the mean surplus: large, so that a sample stays uncovered only where no
# theta covers it.
UNCOVERED = 1e4
# Cost of moving an entry over its whole range, as a share of the largest wanted change: an entry that no sample needs stays where it is.
MOVING = 1e-3
# Linear programs, at most: the rows are linearised at the theta of the episode, and once more at the first solution.
LINEARISATIONS = 2
# Largest difference from the linearisation at which rows count as linear in theta, in units of the limit's scale. Then a second program
# would give the same solution.
STRAIGHT = 1e-6
# A row is covered only if plant or controller came closer to its limit than this share of the range of its values.
REACH = 0.25
# An input counts as being at its bound within this share of its range.
AT_BOUND = 1e-3


def predicted_rows(controller: Controller, episode: Episode, theta: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The excess over each limit that the controller would have predicted along a recorded episode, one interval ahead, with ``theta``.

    Returns the rows of the limits at both ends of each interval, shape (K, 2, rows), and their slopes with respect to theta, shape
    (K, 2, rows, d). The estimator is run again along the recorded inputs and outputs, together with the sensitivity of its memory. nan
    where a limit does not apply at that end.
    """
    memory = controller.estimator.initial(controller.model, np.array(controller.start))
    step, of_fixed, _ = _rolled(controller)
    names = controller.estimator.signals(controller.model)
    received = np.full((len(episode), len(names)), np.nan)
    for i, name in enumerate(names):
        start, end = episode.signal(name)
        received[1:, i] = end[:-1]
        # Before the first input only a state is known: it is the same on both sides of the jump of the input, an output is not.
        if name in controller.model.state_names:
            received[0, i] = start[0]
    last = np.vstack([controller.input_before, episode.input[:-1]])
    d, count = len(theta), len(episode)
    roll = cached(f"rolled rows {controller.structure} {count}", lambda: step.mapaccum("rolled", count, 2))
    (q,) = numpy_call(of_fixed, theta, controller.model.nominal)
    given = (memory, np.zeros((d, memory.size)), received, last, episode.input, np.tile(q, (count, 1)))
    _, _, rows, slopes = numpy_call(roll, *given)
    return rows.reshape(count, 2, -1), slopes.reshape(count, d, 2, -1).transpose(0, 2, 3, 1)


def covering(
    controller: Controller,
    episode: Episode,
    theta: NDArray[np.float64],
    measured: NDArray[np.float64],
) -> NDArray[np.float64]:
    """The theta with which the controller's predictions cover what was measured on this episode, and not much more.

        min   mean_k c_k(theta') + UNCOVERED mean_k t_k + moving sum_i |theta'_i - theta_i| / range_i
        s.t.  c_k(theta') >= e_k - t_k,  t_k >= 0,  theta' in its bounds

    c: predicted rows (`predicted_rows`), linearised around ``theta``; e: ``measured`` rows, shape (K, 2, rows), in the unit of each limit,
    nan where nothing was measured; t: what stays uncovered. Where the input was at its bound and the limit was kept, the limit did not
    decide the input: there only max(0, c_k(theta')) counts.

    With such a theta a controller that keeps its predicted limits also keeps those of the plant wherever it was measured, with the least
    surplus. The program is solved by HiGHS; if that fails, theta is returned unchanged, with a RuntimeWarning.
    Raises ValueError when no measured row is finite.
    """
    lower, upper = controller.theta.lower, controller.theta.upper
    full = _at_bound(controller, episode, theta)
    rows, slopes = predicted_rows(controller, episode, theta)
    near = _near(controller, measured, rows)
    # Rows are divided by the scale of their limit, so that kelvins and volts can be added.
    scale = np.concatenate([np.full(limit.rows.size1_out(0), limit.scale) for limit in controller.limits])
    for number in range(LINEARISATIONS):
        # Where the input is at its bound the limit does not decide it: there the predicted row only has to stay below 0.
        idle = full[:, None, None] & (measured <= 0)
        wanted = np.where(near, (np.where(idle, 0.0, measured) - rows) / scale, np.nan).ravel()
        free = np.broadcast_to(idle, rows.shape).ravel()
        steep = (slopes / scale[:, None]).reshape(wanted.size, -1)
        known = np.isfinite(wanted) & np.all(np.isfinite(steep), axis=1)
        if not known.any():
            raise ValueError("nothing to cover: no measured row is finite")
        n, d = int(known.sum()), len(theta)
        free, wanted, steep = free[known], wanted[known], steep[known]
        moved = np.where(free[:, None], 0.0, steep).sum(axis=0) / n
        # Sign +1: t is what is uncovered, t >= wanted - slope; -1: t is the excess over the limit, t >= slope - wanted.
        sign = np.where(free, -1.0, 1.0)
        moving = MOVING * float(np.max(np.abs(wanted))) / (upper - lower)
        # theta' - theta as the difference of two numbers >= 0, so that its size is linear too.
        cost = np.concatenate([moved + moving, -moved + moving, np.where(free, 1.0, UNCOVERED) / n])
        signed = csr_matrix(sign[:, None] * steep)
        matrix = hstack([-signed, signed, -identity(n)]).tocsc()
        most = np.concatenate([np.maximum(upper - theta, 0.0), np.maximum(theta - lower, 0.0), np.full(n, np.inf)])
        bounds = np.stack([np.zeros_like(most), most], axis=1)
        # Without presolve, which took two fifths of the time and saved no iteration.
        found = linprog(cost, A_ub=matrix, b_ub=-sign * wanted, bounds=bounds, method="highs", options={"presolve": False})
        if found.x is None:
            warnings.warn(
                f"the linear program of {counted(n, 'sample')} has no solution, theta stays ({found.message})", RuntimeWarning, stacklevel=2
            )
            return theta
        before, theta = theta, np.clip(theta + found.x[:d] - found.x[d : 2 * d], lower, upper)
        if number + 1 == LINEARISATIONS or _rolled(controller).straight:
            break
        straight = rows + slopes @ (theta - before)
        rows, slopes = predicted_rows(controller, episode, theta)
        if np.all(np.abs(rows - straight) <= STRAIGHT * scale, where=np.isfinite(straight)):
            # The rows are linear in the entries that have changed, such as a backoff or R0: a second program would give the same theta.
            break
    return np.asarray(theta, dtype=np.float64)


def _near(controller: Controller, measured: NDArray[np.float64], predicted: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which rows are covered: those to which the plant came close or, with its backoff, the controller; shape (rows,).

    Of a limit with a lower and an upper side only the closer side, because the two ask for opposite changes of theta.
    """
    if not np.any(np.isfinite(measured)):
        raise ValueError("nothing to cover: no measured row is finite")
    closeness = np.maximum(_closeness(measured), np.where(np.isfinite(measured).any(axis=(0, 1)), _closeness(predicted), -np.inf))
    out, first = closeness >= min(-REACH, float(closeness.max())), 0
    for limit in controller.limits:
        part = slice(first, first + limit.rows.size1_out(0))
        out[part] &= np.arange(part.stop - part.start) == np.argmax(closeness[part])
        first = part.stop
    return out


def _closeness(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """Largest value of each row as a share of the range of its values, shape (rows,); -inf where none is finite."""
    flat = np.where(np.isfinite(rows), rows, np.nan).reshape(-1, rows.shape[-1])
    known = np.isfinite(flat).any(axis=0)
    most, least = (pick(np.where(known, flat, 0.0), axis=0) for pick in (np.nanmax, np.nanmin))
    return np.where(known, most / np.maximum(most - least, 1e-12), -np.inf)


def _at_bound(controller: Controller, episode: Episode, theta: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Intervals in which every input was at one of its bounds, shape (K,)."""
    count = len(episode)
    signals = ca.DM.zeros(len(controller.given))
    p = ca.repmat(controller.parameters(theta, controller.model.nominal, signals), 1, count)
    arguments = (ca.repmat(ca.DM(theta), 1, count), p, episode.estimate.T, ca.repmat(signals, 1, count))
    lower, upper = (np.array(bound.map(count)(*arguments)).T for bound in (controller.input_lower, controller.input_upper))
    room = AT_BOUND * np.maximum(upper - lower, 1e-12)
    return np.asarray(np.all((episode.input >= upper - room) | (episode.input <= lower + room), axis=1))


class _Rolled(NamedTuple):
    """CasADi functions for one interval of `predicted_rows`."""

    step: ca.Function
    """(memory, its slopes, received outputs, last input, input, q) -> (memory, its slopes, rows, slopes of the rows) one interval ahead."""
    of_fixed: ca.Function
    """(theta, p) -> q: what depends on these alone, computed once."""
    straight: bool
    """Whether the rows are linear in theta for every recorded episode."""


def _rolled(controller: Controller) -> _Rolled:
    return cached(f"rows {controller.structure}", lambda: _step(controller))


def _step(controller: Controller) -> _Rolled:
    model, estimator = controller.model, controller.estimator
    names = estimator.signals(model)
    nm, d = estimator.initial(model, np.array(controller.start)).size, controller.theta.dimension
    memory, theta = ca.SX.sym("memory", nm), ca.SX.sym("theta", d)
    received, nominal = ca.SX.sym("received", len(names)), ca.SX.sym("p", model.nominal.size)
    slopes = ca.SX.sym("slopes", nm, d)
    last, u = (ca.SX.sym(n, len(model.inputs)) for n in ("last", "u"))
    given = ca.DM.zeros(len(controller.given))
    p = controller.parameters(theta, nominal, given)
    signals = {name: received[i] for i, name in enumerate(names)}
    estimate, corrected = estimator.correct(model, memory, signals, last, p)
    ahead = ca.SX(estimator.predict(model, estimate, corrected, u, p))
    rows: list[Any] = []
    for end, state in (("start", estimate), ("end", model.f(estimate, u, p))):
        for limit in controller.limits:
            row = limit.rows(state, u, theta, p, estimate, last, given)
            applies = limit.at in (end, "both")
            rows.append(row if applies else ca.SX.nan(*row.shape))
    every = ca.vertcat(*rows)

    # The estimator often does not depend on theta, for example if theta is in the limits only; then its memory has no slopes.
    known = not ca.depends_on(ahead, theta)

    def total(value: Any) -> Any:
        own = ca.jacobian(value, theta)
        return ca.densify(own if known else own + ca.mtimes(ca.jacobian(value, memory), slopes))

    rise = ca.vec(total(every))
    step, of_fixed = hoist("rows", [memory, slopes, received, last, u], [theta, nominal], [ahead, total(ahead), every, rise])
    return _Rolled(step, of_fixed, known and not ca.depends_on(rise, theta))
