"""The parametrised MPC as data: model, cost, limits, horizon, and theta in any of its slots."""

from __future__ import annotations

import hashlib
import math
import pickle
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from chargetune.control.estimators import Estimator, ExactState
from chargetune.model.model import Model, Named
from chargetune.model.parameter_space import ParameterSpace
from chargetune.runtime.split import split

__all__ = ["Controller", "LimitRows", "SoftLimit", "Stage"]

HORIZON_MAX = 200
CONVEXITY_POINTS = 8
At = Literal["start", "end", "both", "terminal"]


@dataclass(frozen=True)
class Stage:
    """What an expression of the control problem may use, each read by name, as CasADi symbols.

    x, u, y, p: predicted state, input, output h(x, u, p) and model parameters; theta: the tuned parameters;
    now: the estimated state at the moment of the solve; x_d, u_d: the set-point.
    """

    x: Named
    u: Named
    y: Named
    p: Named
    theta: Named
    now: Named
    x_d: Named
    u_d: Named


Expression = Callable[[Stage], Any]
Bound = float | Expression


@dataclass(frozen=True)
class SoftLimit:
    """A limit on an output or a state, kept by an exact penalty; either side is a number or an expression of theta.

    of
        Name of an output or state of the controller's model.
    at
        Where in the interval outputs are limited: h(x_i, u_i), h(x_{i+1}, u_i), both, or only at the end of the horizon.
        A state is limited at ``end`` or ``terminal``, since x_0 is given.
    penalty
        Cost per unit of the largest violation over the horizon, weighted 1 at its start to 2 at its end. The penalty is
        exact (no violation where none is needed) when it exceeds the sum of the limit's multipliers.
    scale
        A noticeable violation, in the unit of the limit; the solver's tolerance is relative to it.
    """

    of: str
    lower: Bound | None = None
    upper: Bound | None = None
    at: At = "both"
    penalty: float = 1e3
    scale: float = 1.0

    def __post_init__(self) -> None:
        if self.lower is None and self.upper is None:
            raise ValueError(f"limit of {self.of}: neither lower nor upper is given")
        for name in ("lower", "upper"):
            value = getattr(self, name)
            if value is not None and not callable(value) and not _finite(value):
                raise ValueError(f"limit of {self.of}: {name} = {value!r}, allowed is a finite number or an expression")
        if _finite(self.lower) and _finite(self.upper) and self.lower >= self.upper:  # type: ignore[operator]
            raise ValueError(f"limit of {self.of}: lower = {self.lower} must be less than upper = {self.upper}")
        if self.at not in ("start", "end", "both", "terminal"):
            raise ValueError(f"limit of {self.of}: at = {self.at!r}, allowed is start, end, both or terminal")
        for name in ("penalty", "scale"):
            if not _finite(getattr(self, name)) or getattr(self, name) <= 0:
                raise ValueError(f"limit of {self.of}: {name} = {getattr(self, name)!r}, allowed is a finite number > 0")


@dataclass(frozen=True)
class LimitRows:
    """A `SoftLimit` as a CasADi function (x, u, theta, p, now) -> rows that are <= 0 when it is kept."""

    of: str
    rows: ca.Function
    at: At
    penalty: float
    scale: float


@dataclass(frozen=True)
class Controller:
    """An MPC whose theta may enter stage cost, terminal cost, dynamics, outputs and every set. It holds data only.

        min  sum_{i<N} l(x_i, u_i) + Vf(x_N) + sum of penalties
        s.t. x_{i+1} = f(x_i, u_i), x_0 = estimate, input_lower <= u_i <= input_upper, limits on outputs and states

    Inputs are bounded hard, everything else softly, so the problem always has a solution. l and Vf are to be convex
    in (x, u) and x (their Hessians are the curvature of the Gauss-Newton model). Build one with `Controller.build`.
    ``blocks`` says for how many intervals each input is held; empty: u_i is free at every interval.
    ``setpoint`` is (x_d, u_d), ``start`` the estimator's state before the first measurement, ``fallback`` the input
    applied when the solver fails, both within the input bounds by clipping.
    """

    model: Model
    theta: ParameterSpace
    horizon: int
    parameters: ca.Function
    stage_cost: ca.Function
    terminal_cost: ca.Function
    limits: tuple[LimitRows, ...]
    input_lower: ca.Function
    input_upper: ca.Function
    fallback: ca.Function
    setpoint: tuple[float, ...]
    start: tuple[float, ...]
    estimator: Estimator = field(default_factory=ExactState)
    iterations_max: int = 20
    blocks: tuple[int, ...] = ()

    @classmethod
    def build(
        cls,
        model: Model,
        theta: ParameterSpace,
        *,
        horizon: int,
        stage_cost: Expression,
        input_lower: Mapping[str, Bound],
        input_upper: Mapping[str, Bound],
        terminal_cost: Expression = lambda _: 0.0,
        limits: Sequence[SoftLimit] = (),
        parameters: Callable[[Stage], Mapping[str, Any]] = lambda _: {},
        fallback: Mapping[str, Bound] | None = None,
        setpoint: Mapping[str, float] | None = None,
        start: Mapping[str, float] | None = None,
        estimator: Estimator | None = None,
        iterations_max: int = 20,
        blocks: Sequence[int] = (),
    ) -> Controller:
        """Make a controller from Python functions of a `Stage`.

        ``parameters`` returns the model parameters that theta changes, by name; the others keep the model's values.
        ``fallback`` defaults to the lower input bounds. ``blocks`` = (1, 1, 2, 4) holds the input for one, one, two and
        four intervals (move blocking: fewer variables, so a longer horizon for the same work); by default it changes at
        every interval. Costs and limits count at every interval all the same. Source: Cagienard, Grieder, Kerrigan and
        Morari, Journal of Process Control 17 (2007). Raises ValueError naming the field at fault.
        """
        if isinstance(horizon, bool) or not isinstance(horizon, int) or not 1 <= horizon <= HORIZON_MAX:
            raise ValueError(f"controller: horizon = {horizon!r}, allowed is an integer in [1, {HORIZON_MAX}]")
        if isinstance(iterations_max, bool) or not isinstance(iterations_max, int) or iterations_max < 1:
            raise ValueError(f"controller: iterations_max = {iterations_max!r}, allowed is an integer >= 1")
        held = tuple(blocks)
        if held and (not all(isinstance(b, int) and not isinstance(b, bool) and b >= 1 for b in held) or sum(held) != horizon):
            raise ValueError(f"controller: blocks = {held!r}, allowed are integers >= 1 that add up to horizon = {horizon}")
        wanted = _named_values("setpoint", setpoint or {}, (*model.state_names, *model.input_names))
        begin = _named_values("start", start or {}, model.state_names)
        symbols = _Symbols(model, theta, wanted, begin)
        for label, given in (("input_lower", input_lower), ("input_upper", input_upper)):
            if set(given) != set(model.input_names):
                raise ValueError(f"controller: {label} names {sorted(given)}, expected {list(model.input_names)}")
        for name in model.input_names:
            low, high = input_lower[name], input_upper[name]
            if _finite(low) and _finite(high) and low >= high:  # type: ignore[operator]
                raise ValueError(f"controller: input_lower of {name} = {low} must be less than input_upper = {high}")
        declared = dict(fallback) if fallback is not None else dict(input_lower)
        if set(declared) != set(model.input_names):
            raise ValueError(f"controller: fallback names {sorted(declared)}, expected {list(model.input_names)}")
        return cls(
            model=model,
            theta=theta,
            horizon=horizon,
            parameters=symbols.parameters(parameters),
            stage_cost=symbols.cost("stage_cost", stage_cost, with_input=True),
            terminal_cost=symbols.cost("terminal_cost", terminal_cost, with_input=False),
            limits=tuple(symbols.limit(limit) for limit in limits),
            input_lower=symbols.inputs("input_lower", input_lower),
            input_upper=symbols.inputs("input_upper", input_upper),
            fallback=symbols.inputs("fallback", declared),
            setpoint=wanted,
            start=begin,
            estimator=estimator or ExactState(),
            iterations_max=iterations_max,
            blocks=held,
        )

    @property
    def input_blocks(self) -> tuple[int, ...]:
        """For how many intervals each input of the plan is held; they add up to the horizon."""
        return self.blocks or (1,) * self.horizon

    @cached_property
    def estimation(self) -> ca.Function:
        """The estimator's equations: (x_hat, memory, y, u, p) -> (x_hat and memory of ``correct``, memory of ``predict``)."""
        model, names = self.model, self.estimator.signals(self.model)
        sizes = (
            len(model.states),
            self.estimator.initial(model, np.array(self.start)).size,
            len(names),
            len(model.inputs),
            model.nominal.size,
        )
        arguments = [ca.SX.sym(name, size) for name, size in zip(("x", "memory", "y", "u", "p"), sizes, strict=True)]
        x, memory, y, u, p = arguments
        estimate, corrected = self.estimator.correct(model, memory, {name: y[i] for i, name in enumerate(names)}, u, p)
        ahead = self.estimator.predict(model, x, memory, u, p)
        return ca.Function("estimation", arguments, [estimate, ca.SX(corrected), ca.SX(ahead)])

    @cached_property
    def structure(self) -> str:
        """A hash of everything that is compiled in; numbers that are run-time values do not enter."""
        functions = [
            self.estimation, self.model.f, self.model.h, self.parameters, self.stage_cost, self.terminal_cost,
            self.input_lower, self.input_upper, self.fallback, *(limit.rows for limit in self.limits),
        ]  # fmt: skip
        limits = [(limit.of, limit.at, limit.penalty, limit.scale) for limit in self.limits]
        names = [self.model.state_names, self.model.input_names, self.model.output_names, self.model.sampling_time_s]
        sizes = [self.theta.dimension, self.horizon, self.iterations_max, self.input_blocks, *names, self.model.parameter_blocks]
        content = pickle.dumps(([f.serialize() for f in functions], limits, sizes))
        return hashlib.sha256(content).hexdigest()

    def theta_vector(self, theta: ArrayLike | None) -> NDArray[np.float64]:
        """theta checked against the space; None is theta_0."""
        return self.theta.default if theta is None else self.theta.validate(theta)


class _Symbols:
    """One set of symbols, so that all functions of a controller have the same arguments."""

    def __init__(self, model: Model, theta: ParameterSpace, wanted: tuple[float, ...], begin: tuple[float, ...]) -> None:
        self.model, self.space, self.wanted, self.begin = model, theta, np.array(wanted), np.array(begin)
        sizes = {p.name: p.size for p in theta.parameters}
        nx, nu, np_ = len(model.states), len(model.inputs), sum(model.parameter_blocks.values())
        self.x, self.u, self.p = ca.SX.sym("x", nx), ca.SX.sym("u", nu), ca.SX.sym("p", np_)
        self.theta, self.now = ca.SX.sym("theta", theta.dimension), ca.SX.sym("now", nx)
        self.setpoint = ca.SX.sym("setpoint", nx + nu)
        wanted_x, wanted_u = split(self.setpoint, (nx, nu))
        states, inputs = dict.fromkeys(model.state_names, 1), dict.fromkeys(model.input_names, 1)
        outputs = dict.fromkeys(model.output_names, 1)
        self.stage = Stage(
            x=Named(states, self.x),
            u=Named(inputs, self.u),
            y=Named(outputs, model.h(self.x, self.u, self.p)),
            p=Named(model.parameter_blocks, self.p),
            theta=Named(sizes, self.theta),
            now=Named(states, self.now),
            x_d=Named(states, wanted_x),
            u_d=Named(inputs, wanted_u),
        )

    def parameters(self, expression: Callable[[Stage], Mapping[str, Any]]) -> ca.Function:
        changed = expression(self.stage)
        blocks = self.model.parameter_blocks
        unknown = sorted(set(changed) - set(blocks))
        if unknown:
            raise ValueError(f"controller: parameters sets unknown {unknown}, allowed are {', '.join(blocks)}")
        rows = []
        for name, size in blocks.items():
            value = ca.SX(changed.get(name, self.stage.p[name]))
            if value.shape != (size, 1):
                raise ValueError(f"controller: parameters sets {name} with shape {value.shape}, expected ({size}, 1)")
            rows.append(value)
        return self._function("parameters", [self.theta, self.p], ca.vertcat(*rows) if rows else ca.SX(0, 1))

    def cost(self, label: str, expression: Expression, *, with_input: bool) -> ca.Function:
        value = ca.SX(expression(self.stage))
        if value.shape != (1, 1):
            raise ValueError(f"controller: {label} has shape {value.shape}, expected a scalar")
        if not with_input and ca.depends_on(value, self.u):
            raise ValueError(f"controller: {label} depends on the input, allowed are x, theta, p, now and the set-point")
        function = self._function(label, [self.x, self.u, self.theta, self.p, self.setpoint, self.now], value)
        self._check_convex(label, value)
        return function

    def _check_convex(self, label: str, value: Any) -> None:
        """Look at the curvature in (x, u) at start, set-point and random points: the QP must be bounded below."""
        curvature, _ = ca.hessian(value, ca.vertcat(self.x, self.u))
        evaluate = ca.Function("curvature", [self.x, self.u, self.theta, self.p, self.setpoint, self.now], [curvature])
        draw = np.random.default_rng(0)
        default, nx, size = self.space.default, self.begin.size, self.wanted.size
        places = [(np.pad(self.begin, (0, size - nx)), default, self.begin), (self.wanted, default, self.wanted[:nx])]
        for _ in range(CONVEXITY_POINTS):
            theta = draw.uniform(self.space.lower, self.space.upper) if default.size else default
            places.append((draw.uniform(-1.0, 1.0, size), theta, draw.uniform(-1.0, 1.0, nx)))
        for xu, theta, now in places:
            matrix = np.array(evaluate(xu[:nx], xu[nx:], theta, self.model.nominal, self.wanted, now))
            if not np.all(np.isfinite(matrix)):
                continue
            values = np.linalg.eigvalsh(matrix)
            if values[0] < -1e-9 * (1.0 + abs(values[-1])):
                raise ValueError(
                    f"controller: {label} has curvature {values[0]:.3g} in (x, u), allowed is a convex function (curvature >= 0)"
                )

    def limit(self, limit: SoftLimit) -> LimitRows:
        model, s = self.model, self.stage
        if limit.of in model.output_names and not (limit.of in model.state_names and limit.at == "terminal"):
            value = s.y[limit.of]
        elif limit.of in model.state_names:
            value = s.x[limit.of]
        else:
            raise ValueError(f"limit of {limit.of!r}: unknown name, allowed are {', '.join((*model.output_names, *model.state_names))}")
        if limit.at == "terminal" and ca.depends_on(value, self.u):
            raise ValueError(f"limit of {limit.of}: at = 'terminal' needs a value without direct feedthrough of the input")
        rows = []
        for bound, sign in ((limit.upper, 1.0), (limit.lower, -1.0)):
            if bound is not None:
                rows.append(sign * (value - (bound(s) if callable(bound) else bound)))
        at = limit.at
        if at in ("start", "both") and not ca.depends_on(ca.vertcat(*rows), self.u):
            # Without the input in it the value at the start of an interval is the value at the end of the one before,
            # and the first one is given: only the end can be controlled.
            at = "end"
        return LimitRows(
            limit.of, self._function(f"limit_{limit.of}", self.row_arguments, ca.vertcat(*rows)), at, limit.penalty, limit.scale
        )

    @property
    def row_arguments(self) -> list[ca.SX]:
        return [self.x, self.u, self.theta, self.p, self.now]

    def inputs(self, label: str, bounds: Mapping[str, Bound]) -> ca.Function:
        values = []
        for name in self.model.input_names:
            bound = bounds[name]
            value = bound(self.stage) if callable(bound) else bound
            if not callable(bound) and not _finite(bound):
                raise ValueError(f"controller: {label} of {name} = {bound!r}, allowed is a finite number or an expression")
            values.append(value)
        return self._function(label, [self.theta, self.p, self.now], ca.vertcat(*(ca.SX(v) for v in values)))

    def _function(self, label: str, arguments: list[ca.SX], value: ca.SX) -> ca.Function:
        try:
            return ca.Function(label, arguments, [ca.cse(value)])
        except RuntimeError as error:
            raise ValueError(f"controller: {label} uses a quantity that is not known there ({error})") from error


def _named_values(label: str, given: Mapping[str, float], names: Sequence[str]) -> tuple[float, ...]:
    unknown = sorted(set(given) - set(names))
    if unknown:
        raise ValueError(f"controller: {label} names unknown {unknown}, allowed are {', '.join(names)}")
    for name, value in given.items():
        if not _finite(value):
            raise ValueError(f"controller: {label} of {name} = {value!r}, allowed is a finite number")
    return tuple(float(given.get(name, 0.0)) for name in names)


def _finite(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
