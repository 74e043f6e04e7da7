"""What can be seen to be wrong with a controller without running it: signs, start, horizon."""

from __future__ import annotations

import itertools
from collections.abc import Mapping

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from chargetune.checks.finding import Evidence, Finding
from chargetune.control.control_step import numbers, problem_of
from chargetune.control.controller import Controller, LimitRows
from chargetune.model.model import Model
from chargetune.runtime.counted import counted

__all__ = [
    "amount",
    "beyond_axis",
    "check_horizon",
    "check_signs",
    "check_start",
    "model_at",
    "noticeable",
    "row_values",
    "titled",
    "unit_of",
]

# A violation below this share of a limit's scale is the solver's tolerance, with some room.
NOTICEABLE = 1e-2
# A horizon that spans less than this share of a time constant hardly sees the dynamics.
SEEN = 1 / 2
# |ln lambda| of an eigenvalue that integrates, and of one whose mode is over within an interval.
INTEGRATES, OVER = 1e-6, 3.0
# States and inputs at which a model is linearised, at most.
POINTS = 40


def model_at(controller: Controller, theta: ArrayLike | None = None, given: ArrayLike | None = None) -> Model:
    """The controller's model with the parameters it has at theta (None: untuned) and at values of its given signals (None: 0)."""
    model = controller.model
    signals = np.zeros(len(controller.given)) if given is None else np.asarray(given, dtype=np.float64)
    values = np.array(controller.parameters(controller.theta_vector(theta), model.nominal, signals)).ravel()
    named, first = {}, 0
    for name, size in model.parameter_blocks.items():
        named[name] = values[first : first + size]
        first += size
    return model.with_parameters(**named)


def unit_of(controller: Controller, name: str) -> str:
    """Unit of an output, a state or an input of the controller's model; empty where it has none, or the name is of none of them."""
    model = controller.model
    return next((s.unit for s in (*model.outputs, *model.states, *model.inputs) if s.name == name and s.unit != "1"), "")


def amount(controller: Controller, name: str, value: float) -> str:
    """A value of a signal with its unit."""
    return f"{value:.4g} {unit_of(controller, name)}".rstrip()


def titled(label: str, unit: str) -> str:
    """The label of an axis with its unit."""
    return f"{label} ({unit})" if unit else label


def beyond_axis(controller: Controller, limit: LimitRows) -> str:
    """The label of an axis of what is beyond a limit."""
    return titled(f"{limit.of} beyond its limit", unit_of(controller, limit.of))


def row_values(
    controller: Controller,
    limit: int,
    x: NDArray[np.float64],
    u: NDArray[np.float64],
    theta: ArrayLike | None = None,
    now: NDArray[np.float64] | None = None,
    *,
    last: NDArray[np.float64] | None = None,
    given: NDArray[np.float64] | None = None,
    bounds: NDArray[np.float64] | None = None,
) -> NDArray[np.float64]:
    """The largest row of a limit (positive: beyond it, in its unit) at states (K, nx) and inputs (K, nu), shape (K,).

    ``now`` (K, nx) are the states at which the controller solved, by default x; ``last`` (K, nu) the inputs before, by default that
    before the first interval; ``given`` (K, signals) the given signals of the intervals, by default 0, ``bounds`` those that the
    limits read, by default the same.
    """
    values, count = controller.theta_vector(theta), len(x)
    signals = np.zeros((count, len(controller.given))) if given is None else given
    before = np.tile(controller.input_before, (count, 1)) if last is None else last
    p = controller.parameters.map(count)(
        ca.repmat(ca.DM(values), 1, count), ca.repmat(ca.DM(controller.model.nominal), 1, count), signals.T
    )
    fixed = (ca.repmat(ca.DM(values), 1, count), p, (x if now is None else now).T)
    rows = controller.limits[limit].rows.map(count)(x.T, u.T, *fixed, before.T, (signals if bounds is None else bounds).T)
    return np.asarray(np.max(np.array(rows), axis=0), dtype=np.float64)


def noticeable(limit: LimitRows) -> float:
    """The violation of a limit that a check begins to speak of, in its unit."""
    return NOTICEABLE * limit.scale


def check_signs(
    controller: Controller,
    expected: Mapping[tuple[str, str], int],
    states: NDArray[np.float64],
    inputs: NDArray[np.float64],
    theta: ArrayLike | None = None,
    given: ArrayLike | None = None,
) -> tuple[Finding, ...]:
    """Outputs of the model that react to an input in the wrong direction.

    ``expected`` maps (output, input) to +1 or -1, the sign of d h(f(x, u), u) / du; ``states`` (K, nx) and ``inputs``
    (K, nu) are where it is looked at, with the given signals at ``given`` (by default 0).
    """
    model = model_at(controller, theta, given)
    x, u, p = (ca.SX.sym(n, k) for n, k in (("x", len(model.states)), ("u", len(model.inputs)), ("p", model.nominal.size)))
    slope = ca.Function("slope", [x, u, p], [ca.jacobian(model.h(model.f(x, u, p), u, p), u)])
    points = _points(len(inputs))
    slopes = np.array([np.array(slope(states[k], inputs[k], model.nominal)) for k in points])
    out = []
    for (output, name), sign in expected.items():
        values = slopes[:, model.output_names.index(output), model.input_names.index(name)]
        wrong = float(np.mean(sign * values <= 0))
        if wrong:
            words = ("falls", "rise") if sign > 0 else ("rises", "fall")
            above, below = unit_of(controller, output) or "1", unit_of(controller, name)
            slope_axis = titled(f"d {output} / d {name}", f"{above}/{below}" if below else above)
            out.append(
                Finding(
                    "wrong-sign",
                    "error",
                    f"{output} {words[0]} when {name} is raised ({100 * wrong:.0f} % of the states looked at); it has to {words[1]}",
                    f"the sign of {name} or of a term of {output} in the model is wrong: current is positive when it charges, "
                    "V = OCV + U1 + R0 I",
                    {"share_wrong": wrong, "slope_mean": float(np.mean(values)), "expected_sign": float(sign)},
                    Evidence("time (min)", slope_axis, {"model": (points * model.sampling_time_s / 60, values)}, {"zero": 0.0}),
                )
            )
    return tuple(out)


def check_start(controller: Controller, theta: ArrayLike | None = None, given: NDArray[np.float64] | None = None) -> tuple[Finding, ...]:
    """Limits that every admissible input breaks at the start state; ``given`` are the given signals then, by default 0."""
    signals = np.zeros(len(controller.given)) if given is None else given
    values = controller.theta_vector(theta)
    problem, nu = problem_of(controller), len(controller.model.inputs)
    start = np.array(controller.start)
    now = problem.first(start, controller.input_before)
    q = numbers(controller, values, np.tile(signals, controller.horizon + 2))
    lower, upper = (np.array(bound).ravel()[:nu] for bound in problem.bounds(now, q))
    each = [sorted({low, high, float(np.clip(0.0, low, high))}) for low, high in zip(lower, upper, strict=True)]
    choices = np.array(list(itertools.product(*each)))
    tried = titled(f"{controller.model.input_names[0]} tried", unit_of(controller, controller.model.input_names[0]))
    out = []
    for j, limit in enumerate(controller.limits):
        if limit.at == "terminal":
            continue
        # A state's row at the start is given, whatever `at` says; an output's depends on the input.
        excess = row_values(controller, j, np.tile(start, (len(choices), 1)), choices, values, given=np.tile(signals, (len(choices), 1)))
        # An input that gives no number keeps no limit.
        least = float(np.min(np.where(np.isnan(excess), np.inf, excess)))
        if least > noticeable(limit):
            beyond = f"beyond its limit by {amount(controller, limit.of, least)}" if np.isfinite(least) else "no finite number"
            out.append(
                Finding(
                    "unsafe-start",
                    "error",
                    f"{limit.of} is {beyond} at the start, whatever the input",
                    f"start elsewhere, move the limit of {limit.of}, or allow an input that keeps it",
                    {"least_excess": least},
                    Evidence(tried, beyond_axis(controller, limit), {"start": (choices[:, 0], excess)}, {"limit": 0.0}),
                )
            )
    return tuple(out)


def check_horizon(
    controller: Controller,
    states: NDArray[np.float64],
    inputs: NDArray[np.float64],
    theta: ArrayLike | None = None,
    given: ArrayLike | None = None,
) -> tuple[Finding, ...]:
    """A horizon so short that the model's dynamics cannot matter.

    The time constants are Ts / |ln lambda| for the eigenvalues lambda of df/dx that neither integrate (1) nor
    are over within an interval (near 0); the fastest of them, in the median over the points, has to be seen.
    """
    model = model_at(controller, theta, given)
    x, u, p = (ca.SX.sym(n, k) for n, k in (("x", len(model.states)), ("u", len(model.inputs)), ("p", model.nominal.size)))
    transition = ca.Function("A", [x, u, p], [ca.jacobian(model.f(x, u, p), x)])
    step, points, fastest = model.sampling_time_s, _points(len(inputs)), []
    for k in points:
        slopes = np.array(transition(states[k], inputs[k], model.nominal))
        # Outside of the model's domain nothing is known of its time constants.
        if not np.all(np.isfinite(slopes)):
            fastest.append(np.nan)
            continue
        eigenvalues = np.linalg.eigvals(slopes).astype(complex)
        sizes = np.abs(np.log(np.where(eigenvalues == 0, 1e-12, eigenvalues)))
        slow = sizes[(sizes > INTEGRATES) & (sizes < OVER)]
        fastest.append(step / np.max(slow) if slow.size else np.nan)
    constants = np.array(fastest)
    if np.all(np.isnan(constants)):
        return ()
    constant, span = float(np.nanmedian(constants)), controller.horizon * step
    if span >= SEEN * constant:
        return ()
    least = int(np.ceil(SEEN * constant / step))
    return (
        Finding(
            "short-horizon",
            "warning",
            f"the horizon spans {span:.3g} s, less than half of the model's fastest time constant, {constant:.3g} s "
            "(the median along the closed loop): the controller acts almost as if the model had no dynamics",
            f"a horizon of at least {counted(least, 'interval')}, or a longer sampling time",
            {
                "horizon_s": span,
                "time_constant_s": constant,
                "horizon_intervals": float(controller.horizon),
                "least_intervals": float(least),
            },
            Evidence("time (min)", "fastest time constant (s)", {"closed loop": (points * step / 60, constants)}, {"horizon": span}),
        ),
    )


def _points(count: int) -> NDArray[np.int64]:
    return np.unique(np.linspace(0, count - 1, min(count, POINTS)).astype(np.int64))
