"""Disturbance models: a model with unknown offsets and slowly varying parameters as further states, for an estimator."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
from numpy.typing import ArrayLike

from chargetune.model.detectability import check_setpoint
from chargetune.model.model import Model, Named, Signal

__all__ = ["Ramp", "with_disturbances"]


@dataclass(frozen=True)
class Ramp:
    """A disturbance d that changes steadily: d+ = a d + s r, r+ = exp(-|s| / decay) r, with its rate r as a further state.

    s is the sampling time in s, or what ``along`` (u, p) says the disturbance changes with, such as the charge of an interval. ``decay``,
    in the unit of s, is how far a rate reaches; None: for ever.
    """

    along: Callable[[Named, Named], Any] | None = None
    decay: float | None = None

    def __post_init__(self) -> None:
        if self.decay is not None and not _positive(self.decay):
            raise ValueError(f"ramp: decay = {self.decay!r}, allowed is a finite number > 0")


def with_disturbances(
    model: Model,
    *,
    outputs: Sequence[str] = (),
    inputs: Sequence[str] = (),
    parameters: Sequence[str] | Mapping[str, Sequence[str]] = (),
    ramps: Mapping[str, Ramp] | None = None,
    time_constants_s: Mapping[str, float] | None = None,
    settings: Mapping[str, ArrayLike] | None = None,
    measured: Sequence[str] | None = None,
    setpoint: Mapping[str, float] | None = None,
) -> Model:
    """The model with disturbances d as states after its own ones; with integrating ones an MPC is free of offset.

        x+ = f(x, u + d_u, p exp(d_p)),   y = h(x, u + d_u, p exp(d_p)) + d_y,   d+ = a d

    a = 1 (integrating), or exp(-Ts / tau) for a state that ``time_constants_s`` names. The states are ``<output>_offset``,
    ``<input>_offset`` and ``<parameter>_log_factor``, the logarithm of a factor on a whole block of p. Where one factor is common to
    several blocks, ``parameters`` maps its name to theirs: {"resistance": ("R0_ohm", "R1_ohm")}.

    ramps
        Disturbance states that have a rate of change, a further state ``<state>_rate``: what changes steadily is then predicted without
        lag, at the price of more noise. A decay is a scalar parameter ``<state>_rate_decay`` of the new model.
    time_constants_s
        By the name of a disturbance state, in s; each is a scalar parameter ``<state>_time_constant_s`` of the new model.
    settings
        Further blocks of p that f and h do not read: an estimator's standard deviations, which theta can then set.
    measured, setpoint
        Where a set-point (states and inputs of ``model`` by name, 0 where not named) is given, the disturbances must be detectable there
        from the ``measured`` outputs (default: all), by the rank test of Pannocchia and Rawlings. A parameter is often seen only in
        motion: `detectability.undetectable` tests along an episode.

    Raises ValueError for an unknown signal, two states of one name, a disturbance that cannot be detected.
    Source: Pannocchia and Rawlings, AIChE J. 49 (2003) 426; Maeder, Borrelli and Morari, Automatica 45 (2009) 2214.
    """
    groups = dict(parameters) if isinstance(parameters, Mapping) else {name: (name,) for name in parameters}
    blocks = model.parameter_blocks
    _known(model, "outputs", outputs, model.output_names)
    _known(model, "inputs", inputs, model.input_names)
    for name, group in groups.items():
        _known(model, f"parameters ({name})" if isinstance(parameters, Mapping) else "parameters", group, tuple(blocks))
    factored = [block for group in groups.values() for block in group]
    if len(set(factored)) < len(factored):
        raise ValueError(f"disturbances of {model.name}: parameters = {factored}, allowed is one factor for each block")
    units = {s.name: s.unit for s in (*model.outputs, *model.inputs)}
    added = [Signal(f"{name}_offset", units[name]) for name in (*outputs, *inputs)] + [Signal(f"{name}_log_factor") for name in groups]
    rates = dict(ramps or {})
    _known(model, "ramps", tuple(rates), tuple(s.name for s in added))
    added += [Signal(f"{s.name}_rate", "1" if rates[s.name].along else f"{s.unit}/s") for s in added if s.name in rates]
    names = [s.name for s in added]
    if not names:
        raise ValueError(f"disturbances of {model.name}: none is given, allowed is at least one output, input or parameter")
    if len({*names, *model.state_names}) < len(names) + len(model.states):
        raise ValueError(f"disturbances of {model.name}: states {[*model.state_names, *names]}, allowed are different names")
    constants = dict(time_constants_s or {})
    _known(model, "time_constants_s", tuple(constants), tuple(names))
    for name, value in constants.items():
        if not _positive(value):
            raise ValueError(f"disturbances of {model.name}: time_constants_s of {name} = {value!r}, allowed is a finite number > 0")
    decays = {f"{name}_rate_decay": ramp.decay for name, ramp in rates.items() if ramp.decay is not None}
    more = {f"{name}_time_constant_s": value for name, value in constants.items()} | decays | dict(settings or {})
    if set(more) & set(blocks):
        taken = sorted(set(more) & set(blocks))
        raise ValueError(f"disturbances of {model.name}: settings {taken} are parameters of the model, allowed are new names")

    def equations(x: Named, u: Named, p: Named) -> tuple[dict[str, Any], dict[str, Any]]:
        own = ca.vertcat(*(x[name] for name in model.state_names))
        pushed = ca.vertcat(*(u[name] + (x[f"{name}_offset"] if name in inputs else 0) for name in model.input_names))
        factor = {block: ca.exp(x[f"{name}_log_factor"]) for name, group in groups.items() for block in group}
        changed = [p[block] * factor[block] if block in factor else p[block] for block in blocks]
        scaled = ca.vertcat(*changed) if changed else ca.SX(0, 1)
        after, y = model.f(own, pushed, scaled), model.h(own, pushed, scaled)
        following = {name: after[i] for i, name in enumerate(model.state_names)}
        for name in names:
            decay = ca.exp(-model.sampling_time_s / p[f"{name}_time_constant_s"]) if name in constants else 1
            following[name] = decay * x[name]
        for name, ramp in rates.items():
            rate, step = f"{name}_rate", ramp.along(u, p) if ramp.along else model.sampling_time_s
            following[name] += step * x[rate]
            if ramp.decay is not None:
                following[rate] *= ca.exp(-ca.fabs(step) / p[f"{rate}_decay"])
        seen = {name: y[i] + (x[f"{name}_offset"] if name in outputs else 0) for i, name in enumerate(model.output_names)}
        return following, seen

    built = Model.build(
        f"{model.name} with disturbances",
        states=(*model.states, *added),
        inputs=model.inputs,
        outputs=model.outputs,
        parameters=dict(model.parameters) | more,
        sampling_time_s=model.sampling_time_s,
        equations=equations,
    )
    if setpoint is not None:
        check_setpoint(built, model.output_names if measured is None else measured, setpoint)
    return built


def _positive(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value) and value > 0


def _known(model: Model, field: str, names: Sequence[str], allowed: tuple[str, ...]) -> None:
    unknown = [name for name in names if name not in allowed]
    if unknown:
        raise ValueError(f"disturbances of {model.name}: {field} = {unknown}, allowed are {', '.join(allowed) or '(none)'}")
    if len(set(names)) < len(names):
        raise ValueError(f"disturbances of {model.name}: {field} = {list(names)}, allowed are different names")
