"""What an expression of the control problem may use, and how it becomes a CasADi function."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca

from chargetune.control.limits import Bound, LimitRows, SoftLimit
from chargetune.model.model import Model, Named, Signal
from chargetune.model.parameter_space import ParameterSpace
from chargetune.runtime.numeric import is_finite
from chargetune.runtime.split import split

__all__ = ["Expression", "Stage", "Symbols"]


@dataclass(frozen=True)
class Stage:
    """What an expression of the control problem may use, each read by name, as CasADi symbols.

    x, u, y, p: predicted state, input, output h(x, u, p) and model parameters; theta: the tuned parameters;
    now: the estimated state at the moment of the solve; x_d, u_d: the set-point; u_last: the input of the interval before,
    which at stage 0 is the one that was applied; given: the given signals (references, prices, forecasts) at this stage.
    """

    x: Named
    u: Named
    y: Named
    p: Named
    theta: Named
    now: Named
    x_d: Named
    u_d: Named
    u_last: Named
    given: Named


Expression = Callable[[Stage], Any]


class Symbols:
    """One set of symbols, so that all functions of a controller have the same arguments."""

    def __init__(self, model: Model, theta: ParameterSpace, given: Sequence[Signal]) -> None:
        self.model = model
        sizes = {p.name: p.size for p in theta.parameters}
        nx, nu, np_ = len(model.states), len(model.inputs), sum(model.parameter_blocks.values())
        self.x, self.u, self.p = ca.SX.sym("x", nx), ca.SX.sym("u", nu), ca.SX.sym("p", np_)
        self.theta, self.now = ca.SX.sym("theta", theta.dimension), ca.SX.sym("now", nx)
        self.last, self.given = ca.SX.sym("u_last", nu), ca.SX.sym("given", len(given))
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
            u_last=Named(inputs, self.last),
            given=Named(dict.fromkeys((s.name for s in given), 1), self.given),
        )

    def parameters(self, expression: Callable[[Stage], Mapping[str, Any]]) -> ca.Function:
        """(theta, p_nominal, given) -> p."""
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
        return self._function("parameters", [self.theta, self.p, self.given], ca.vertcat(*rows) if rows else ca.SX(0, 1))

    def cost(self, label: str, expression: Expression, *, with_input: bool) -> ca.Function:
        """(x, u, theta, p, setpoint, now, u_last, given) -> cost."""
        value = ca.SX(expression(self.stage))
        if value.shape != (1, 1):
            raise ValueError(f"controller: {label} has shape {value.shape}, expected a scalar")
        if not with_input and ca.depends_on(value, self.u):
            raise ValueError(f"controller: {label} depends on the input, allowed are x, theta, p, now, u_last, given and the set-point")
        arguments = [self.x, self.u, self.theta, self.p, self.setpoint, self.now, self.last, self.given]
        return self._function(label, arguments, value)

    def limit(self, limit: SoftLimit) -> LimitRows:
        """The limit's rows; ValueError for an unknown name or a place where it cannot be kept."""
        model, s = self.model, self.stage
        if limit.of in model.output_names and not (limit.of in model.state_names and limit.at == "terminal"):
            value = s.y[limit.of]
        elif limit.of in model.state_names:
            value = s.x[limit.of]
        else:
            raise ValueError(f"limit of {limit.of!r}: unknown name, allowed are {', '.join((*model.output_names, *model.state_names))}")
        if limit.at == "terminal" and ca.depends_on(value, self.u):
            raise ValueError(f"limit of {limit.of}: at = 'terminal' needs a value without direct feedthrough of the input")
        rows = ca.vertcat(*(sign * (value - (bound(s) if callable(bound) else bound)) for bound, sign in limit.sides))
        at = limit.at
        if at in ("start", "both") and not ca.depends_on(rows, self.u):
            # Without the input in it the value at the start of an interval is the value at the end of the one before,
            # and the first one is given: only the end can be controlled.
            at = "end"
        arguments = [self.x, self.u, self.theta, self.p, self.now, self.last, self.given]
        return LimitRows(limit.of, self._function(f"limit_{limit.of}", arguments, rows), at, limit.penalty, limit.scale)

    def inputs(self, label: str, bounds: Mapping[str, Bound], otherwise: float | None = None) -> ca.Function:
        """(theta, p, now, given) -> one number an input; ``otherwise`` stands for inputs that are not named."""
        values = []
        for name in self.model.input_names:
            bound = bounds[name] if otherwise is None else bounds.get(name, otherwise)
            value = bound(self.stage) if callable(bound) else bound
            if name in bounds and not callable(bound) and not is_finite(bound):
                raise ValueError(f"controller: {label} of {name} = {bound!r}, allowed is a finite number or an expression")
            values.append(value)
        return self._function(label, [self.theta, self.p, self.now, self.given], ca.vertcat(*(ca.SX(v) for v in values)))

    def _function(self, label: str, arguments: list[ca.SX], value: ca.SX) -> ca.Function:
        try:
            return ca.Function(label, arguments, [ca.cse(value)])
        except RuntimeError as error:
            raise ValueError(f"controller: {label} uses a quantity that is not known there ({error})") from error
