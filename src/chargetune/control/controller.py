"""The parametrised MPC as data: model, cost, limits, horizon, and theta in any of its slots."""

from __future__ import annotations

import hashlib
import pickle
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from chargetune.control.convexity import Curvature, curvature_of
from chargetune.control.estimators import Estimator, ExactState
from chargetune.control.limits import Bound, LimitRows, SoftLimit
from chargetune.control.stage import Expression, Stage, Symbols
from chargetune.model.model import Model, Signal
from chargetune.model.parameter_space import ParameterSpace
from chargetune.runtime.numeric import is_finite, is_integer

__all__ = ["Controller", "LimitRows", "SoftLimit", "Stage"]

HORIZON_MAX = 200
Hessian = Literal["gauss_newton", "exact"]
Solver = Literal["sqp", "ipopt"]
FirstGuess = Literal["cold", "ipopt"]


@dataclass(frozen=True)
class Controller:
    """An MPC whose theta may enter stage cost, terminal cost, dynamics, outputs and every set. It holds data only.

        min  sum_{i<N} l(x_i, u_i) + Vf(x_N) + sum of penalties
        s.t. x_{i+1} = f(x_i, u_i), x_0 = estimate, input_lower <= u_i <= input_upper, limits on outputs and states

    Inputs are bounded hard, everything else softly, so the problem always has a solution. Build one with `Controller.build`.
    ``blocks`` says for how many intervals each input is held; empty: u_i is free at every interval. ``setpoint`` is (x_d, u_d),
    ``start`` the estimator's state before the first measurement, ``input_before`` the input before the first interval, ``fallback``
    the input applied when the solver fails, within the input bounds by clipping. ``given`` are signals whose values over the
    horizon are told at run time (`model.given`).

    ``input_rate`` (inf: none) bounds the change of an input from one interval to the next, hard like the bounds:

        min(u_{i-1} - rate, upper_i) <= u_i <= max(u_{i-1} + rate, lower_i)

    so that where bounds leave no input within the rate the bounds win.

    ``hessian``: with "gauss_newton" the costs' Hessians are the curvature of the problem; they have to be convex in the inputs and
    the states that these reach. With "exact" it is the Lagrangian's, made convex where it is not: for costs that are bent downwards, or
    linear in the states (economic ones) of a nonlinear model. `build` chooses by `curvatures`. Of a problem that is not convex the
    solver finds a local solution: the one downhill of its ``first_guess``, which is the input before, repeated, or the plan that
    IPOPT finds from ``start``. ``solver`` = "ipopt" leaves every solve to IPOPT, step by step only.
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
    input_rate: ca.Function
    rated: tuple[int, ...]
    setpoint: tuple[float, ...]
    start: tuple[float, ...]
    input_before: tuple[float, ...]
    given: tuple[Signal, ...] = ()
    estimator: Estimator = field(default_factory=ExactState)
    iterations_max: int = 20
    blocks: tuple[int, ...] = ()
    hessian: Hessian = "gauss_newton"
    solver: Solver = "sqp"
    first_guess: FirstGuess = "cold"

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
        given: Sequence[Signal] = (),
        input_rate: Mapping[str, Bound] | None = None,
        input_before: Mapping[str, float] | None = None,
        estimator: Estimator | None = None,
        iterations_max: int = 20,
        blocks: Sequence[int] = (),
        hessian: Hessian | None = None,
        solver: Solver = "sqp",
        first_guess: FirstGuess = "cold",
    ) -> Controller:
        """Make a controller from Python functions of a `Stage`.

        ``parameters`` returns the model parameters that theta or a given signal changes, by name; the others keep the
        model's values. ``fallback`` defaults to the lower input bounds. Bounds of inputs and of their rate are numbers or
        expressions of theta, p, now and given. ``blocks`` = (1, 1, 2, 4) holds the input for one, one, two and
        four intervals (move blocking: fewer variables, so a longer horizon for the same work); by default it changes at
        every interval. Costs and limits count at every interval all the same, bounds at the first one of a block. Source:
        Cagienard, Grieder, Kerrigan and Morari, Journal of Process Control 17 (2007). Raises ValueError naming the field at fault.
        """
        if not is_integer(horizon) or not 1 <= horizon <= HORIZON_MAX:
            raise ValueError(f"controller: horizon = {horizon!r}, allowed is an integer in [1, {HORIZON_MAX}]")
        choices = (
            ("hessian", hessian, (None, "gauss_newton", "exact")),
            ("solver", solver, ("sqp", "ipopt")),
            ("first_guess", first_guess, ("cold", "ipopt")),
        )
        for label, value, allowed in choices:
            if value not in allowed:
                raise ValueError(f"controller: {label} = {value!r}, allowed is {', '.join(map(str, allowed))}")
        if not is_integer(iterations_max) or iterations_max < 1:
            raise ValueError(f"controller: iterations_max = {iterations_max!r}, allowed is an integer >= 1")
        held = tuple(blocks)
        if held and (not all(is_integer(b) and b >= 1 for b in held) or sum(held) != horizon):
            raise ValueError(f"controller: blocks = {held!r}, allowed are integers >= 1 that add up to horizon = {horizon}")
        named = [signal.name for signal in given]
        if len(set(named)) < len(named):
            raise ValueError(f"controller: given = {named}, allowed are different names")
        wanted = _named_values("setpoint", setpoint or {}, (*model.state_names, *model.input_names))
        begin = _named_values("start", start or {}, model.state_names)
        before = _named_values("input_before", input_before or {}, model.input_names)
        symbols = Symbols(model, theta, given)
        for label, bounds in (("input_lower", input_lower), ("input_upper", input_upper)):
            if set(bounds) != set(model.input_names):
                raise ValueError(f"controller: {label} names {sorted(bounds)}, expected {list(model.input_names)}")
        for name in model.input_names:
            low, high = input_lower[name], input_upper[name]
            if is_finite(low) and is_finite(high) and low >= high:  # type: ignore[operator]
                raise ValueError(f"controller: input_lower of {name} = {low} must be less than input_upper = {high}")
        declared = dict(fallback) if fallback is not None else dict(input_lower)
        if set(declared) != set(model.input_names):
            raise ValueError(f"controller: fallback names {sorted(declared)}, expected {list(model.input_names)}")
        rate = _rates(input_rate or {}, model.input_names)
        built = cls(
            model=model,
            theta=theta,
            horizon=int(horizon),
            parameters=symbols.parameters(parameters),
            stage_cost=symbols.cost("stage_cost", stage_cost, with_input=True),
            terminal_cost=symbols.cost("terminal_cost", terminal_cost, with_input=False),
            limits=tuple(symbols.limit(limit) for limit in limits),
            input_lower=symbols.inputs("input_lower", input_lower),
            input_upper=symbols.inputs("input_upper", input_upper),
            fallback=symbols.inputs("fallback", declared),
            input_rate=symbols.inputs("input_rate", rate, np.inf),
            rated=tuple(i for i, name in enumerate(model.input_names) if name in rate),
            setpoint=wanted,
            start=begin,
            input_before=before,
            given=tuple(given),
            estimator=estimator or ExactState(),
            iterations_max=int(iterations_max),
            blocks=tuple(int(length) for length in held),
            solver=solver,
            first_guess=first_guess,
        )
        return replace(built, hessian=hessian or built._suitable_hessian)

    @cached_property
    def curvatures(self) -> dict[str, Curvature]:
        """The least and the largest curvature that was found of the costs."""
        arguments = (self.model, self.theta, self.setpoint, self.start)
        costs = {"stage_cost": self.stage_cost, "terminal_cost": self.terminal_cost}
        return {label: curvature_of(cost, *arguments) for label, cost in costs.items()}

    @property
    def _suitable_hessian(self) -> Hessian:
        found = self.curvatures.values()
        if not all(one.convex for one in found):
            return "exact"
        # The costs' own Hessian is all there is where states have a part in it, or where nothing else is bent.
        return "gauss_newton" if any(one.of_states for one in found) or self._linear else "exact"

    @property
    def _linear(self) -> bool:
        """Whether dynamics and limits are linear in (x, u)."""
        x, u, p = self.model.f.sx_in()
        bent = [self.model.f(x, u, p)]
        for limit in self.limits:
            arguments = limit.rows.sx_in()
            bent.append(limit.rows(x, u, *arguments[2:]))
        return all(ca.is_linear(e, ca.vertcat(x, u)) for e in bent)

    @property
    def given_names(self) -> tuple[str, ...]:
        return tuple(signal.name for signal in self.given)

    @property
    def input_blocks(self) -> tuple[int, ...]:
        """For how many intervals each input of the plan is held; they add up to the horizon."""
        return self.blocks or (1,) * self.horizon

    @cached_property
    def carried(self) -> tuple[int, ...]:
        """Indices of the inputs whose last value is a part of the problem's state: of a bounded rate, or read as ``u_last``."""
        read = [cost.jac_sparsity(0, 6) for cost in (self.stage_cost, self.terminal_cost)]
        read += [limit.rows.jac_sparsity(0, 5) for limit in self.limits]
        return tuple(sorted({*self.rated, *(column for pattern in read for column in pattern.get_col())}))

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
            self.input_lower, self.input_upper, self.fallback, self.input_rate, *(limit.rows for limit in self.limits),
        ]  # fmt: skip
        limits = [(limit.of, limit.at, limit.penalty, limit.scale) for limit in self.limits]
        names = [self.model.state_names, self.model.input_names, self.model.output_names, self.model.sampling_time_s]
        sizes = [
            self.theta.dimension,
            self.horizon,
            self.iterations_max,
            self.input_blocks,
            *names,
            self.model.parameter_blocks,
            self.rated,
            self.given_names,
            self.hessian,
        ]
        content = pickle.dumps(([f.serialize() for f in functions], limits, sizes))
        return hashlib.sha256(content).hexdigest()

    def theta_vector(self, theta: ArrayLike | None) -> NDArray[np.float64]:
        """theta checked against the space; None is theta_0."""
        return self.theta.default if theta is None else self.theta.validate(theta)


def _named_values(label: str, given: Mapping[str, float], names: Sequence[str]) -> tuple[float, ...]:
    unknown = sorted(set(given) - set(names))
    if unknown:
        raise ValueError(f"controller: {label} names unknown {unknown}, allowed are {', '.join(names)}")
    for name, value in given.items():
        if not is_finite(value):
            raise ValueError(f"controller: {label} of {name} = {value!r}, allowed is a finite number")
    return tuple(float(given.get(name, 0.0)) for name in names)


def _rates(rate: Mapping[str, Bound], names: Sequence[str]) -> dict[str, Bound]:
    unknown = sorted(set(rate) - set(names))
    if unknown:
        raise ValueError(f"controller: input_rate names unknown {unknown}, allowed are {', '.join(names)}")
    for name, value in rate.items():
        if not callable(value) and not (is_finite(value) and value > 0):
            raise ValueError(f"controller: input_rate of {name} = {value!r}, allowed is a finite number > 0 or an expression")
    return dict(rate)
