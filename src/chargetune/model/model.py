"""Model: a discrete-time system x+ = f(x, u, p), y = h(x, u, p) in CasADi expressions."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from chargetune.model.integrators import rk4
from chargetune.runtime.counted import counted
from chargetune.runtime.numeric import is_finite
from chargetune.runtime.split import split

__all__ = ["Model", "Named", "Signal"]


@dataclass(frozen=True)
class Signal:
    """A named scalar with its unit."""

    name: str
    unit: str = "1"

    def __post_init__(self) -> None:
        if not self.name.isidentifier():
            raise ValueError(f"signal name {self.name!r}: allowed are letters, digits and underscores, not starting with a digit")


class Named(Mapping[str, Any]):
    """A CasADi column vector whose entries (or blocks) are read by name: ``x["soc"]``."""

    def __init__(self, blocks: Mapping[str, int], vector: Any) -> None:
        self.vector = vector
        if vector.shape[0] != sum(blocks.values()):
            raise ValueError(f"vector has {counted(vector.shape[0], 'row')}, expected {sum(blocks.values())} for {', '.join(blocks)}")
        self._blocks = dict(zip(blocks, split(vector, blocks.values()), strict=True))

    def __getitem__(self, name: str) -> Any:
        if name not in self._blocks:
            raise KeyError(f"unknown name {name!r}, allowed are {', '.join(self._blocks) or '(none)'}")
        return self._blocks[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._blocks)

    def __len__(self) -> int:
        return len(self._blocks)


Equations = Callable[[Named, Named, Named], tuple[Mapping[str, Any], Mapping[str, Any]]]


@dataclass(frozen=True)
class Model:
    """A discrete-time system; every number in it that a person may change is a run-time parameter p.

    f
        CasADi function (x, u, p) -> x at the next sampling instant, shapes (nx,), (nu,), (np,) -> (nx,).
    h
        CasADi function (x, u, p) -> y, shape (ny,). It has direct feedthrough in general, so an output has two
        values in an interval: h(x_k, u_k) just after the input jumps and h(x_{k+1}, u_k) just before it jumps again.
    parameters
        Name and nominal values of each block of p, in order.
    """

    name: str
    states: tuple[Signal, ...]
    inputs: tuple[Signal, ...]
    outputs: tuple[Signal, ...]
    parameters: tuple[tuple[str, tuple[float, ...]], ...]
    sampling_time_s: float
    f: ca.Function
    h: ca.Function

    def __post_init__(self) -> None:
        if not _positive(self.sampling_time_s):
            raise ValueError(f"model {self.name}: sampling_time_s = {self.sampling_time_s!r}, allowed is a finite number > 0")
        _check_names(self.name, self.states, self.inputs, self.outputs)
        for name, values in self.parameters:
            if not all(math.isfinite(v) for v in values):
                raise ValueError(f"model {self.name}: parameter {name} = {list(values)}, allowed are finite numbers")

    @classmethod
    def build(
        cls,
        name: str,
        *,
        states: Sequence[Signal],
        inputs: Sequence[Signal],
        outputs: Sequence[Signal],
        parameters: Mapping[str, ArrayLike],
        sampling_time_s: float,
        equations: Equations,
    ) -> Model:
        """Make a model from a Python function of named CasADi symbols.

        ``equations(x, u, p)`` returns two mappings: next value of every state and value of every output.
        Raises ValueError when a state or output is missing or unknown.
        """
        _check_names(name, states, inputs, outputs)
        blocks = {key: np.atleast_1d(np.asarray(value, dtype=float)) for key, value in parameters.items()}
        x = ca.SX.sym("x", len(states))
        u = ca.SX.sym("u", len(inputs))
        p = ca.SX.sym("p", sum(v.size for v in blocks.values()))
        nxt, out = equations(
            Named({s.name: 1 for s in states}, x),
            Named({s.name: 1 for s in inputs}, u),
            Named({key: v.size for key, v in blocks.items()}, p),
        )
        f = ca.Function("f", [x, u, p], [_stack(nxt, states, f"model {name}: next states")], ["x", "u", "p"], ["x_next"])
        h = ca.Function("h", [x, u, p], [_stack(out, outputs, f"model {name}: outputs")], ["x", "u", "p"], ["y"])
        return cls(
            name=name,
            states=tuple(states),
            inputs=tuple(inputs),
            outputs=tuple(outputs),
            parameters=tuple((key, tuple(float(v) for v in value)) for key, value in blocks.items()),
            sampling_time_s=sampling_time_s,
            f=f,
            h=h,
        )

    @classmethod
    def from_casadi(
        cls,
        name: str,
        f: ca.Function,
        h: ca.Function | None = None,
        *,
        states: Sequence[Signal | str],
        inputs: Sequence[Signal | str],
        outputs: Sequence[Signal | str] | None = None,
        parameters: Mapping[str, ArrayLike] | None = None,
        sampling_time_s: float,
        continuous: bool = False,
        substeps: int = 1,
    ) -> Model:
        """Make a model from CasADi functions (x, u) or (x, u, p), as do-mpc, acados and safe-control-gym have them.

        f is the next state, or with ``continuous`` dx/dt, which `rk4` integrates over an interval in ``substeps``. Without ``h`` the
        outputs are the states. ``parameters`` names the blocks of p in order with their values. Raises ValueError when sizes do not
        fit, and when a function cannot be written out in scalar operations, as an integrator within it cannot.
        """
        blocks = {key: np.atleast_1d(np.asarray(value, dtype=float)) for key, value in (parameters or {}).items()}
        named = [tuple(s if isinstance(s, Signal) else Signal(s) for s in signals) for signals in (states, inputs, outputs or states)]
        sizes = [len(named[0]), len(named[1]), sum(value.size for value in blocks.values())]
        x, u, p = (ca.SX.sym(label, size) for label, size in zip("xup", sizes, strict=True))
        follow = _scalar(f"model {name}: f", f, sizes, sizes[0])

        def rate(at: Any) -> Any:
            return follow(at, u, p)

        after = rk4(rate, x, sampling_time_s, substeps) if continuous else rate(x)
        if h is None and outputs is not None and [s.name for s in named[2]] != [s.name for s in named[0]]:
            raise ValueError(f"model {name}: outputs = {[s.name for s in named[2]]} without h, allowed are the states")
        seen = x if h is None else _scalar(f"model {name}: h", h, sizes, len(named[2]))(x, u, p)
        functions = [
            ca.Function(n, [x, u, p], [ca.densify(e)], ["x", "u", "p"], [o]) for n, e, o in (("f", after, "x_next"), ("h", seen, "y"))
        ]
        flat = tuple((key, tuple(float(v) for v in value)) for key, value in blocks.items())
        return cls(name, named[0], named[1], named[2], flat, sampling_time_s, functions[0], functions[1])

    @property
    def state_names(self) -> tuple[str, ...]:
        return tuple(s.name for s in self.states)

    @property
    def input_names(self) -> tuple[str, ...]:
        return tuple(s.name for s in self.inputs)

    @property
    def output_names(self) -> tuple[str, ...]:
        return tuple(s.name for s in self.outputs)

    @property
    def parameter_blocks(self) -> dict[str, int]:
        return {name: len(values) for name, values in self.parameters}

    @property
    def nominal(self) -> NDArray[np.float64]:
        """p as a vector, shape (np,)."""
        return np.array([v for _, values in self.parameters for v in values])

    def with_parameters(self, **blocks: ArrayLike) -> Model:
        """The same equations with other nominal values of p; ValueError names an unknown block or a wrong length."""
        new = {name: np.atleast_1d(np.asarray(value, dtype=float)) for name, value in blocks.items()}
        sizes = self.parameter_blocks
        for name, value in new.items():
            if name not in sizes:
                raise ValueError(f"model {self.name}: unknown parameter {name!r}, allowed are {', '.join(sizes)}")
            if value.shape != (sizes[name],):
                raise ValueError(f"model {self.name}: parameter {name} has shape {value.shape}, expected ({sizes[name]},)")
        merged = tuple((name, tuple(float(v) for v in new.get(name, np.array(values)))) for name, values in self.parameters)
        return Model(self.name, self.states, self.inputs, self.outputs, merged, self.sampling_time_s, self.f, self.h)


def _scalar(where: str, function: ca.Function, sizes: Sequence[int], rows: int) -> Callable[[Any, Any, Any], Any]:
    """A CasADi function as one of (x, u, p) in scalar operations."""
    count = 3 if function.n_in() > 2 else 2
    expected = list(sizes[:count]) if count == 3 or not sizes[2] else list(sizes)
    shapes = [function.numel_in(i) for i in range(function.n_in())]
    if shapes != expected or function.numel_out(0) != rows:
        raise ValueError(f"{where} maps sizes {shapes} to {function.numel_out(0)}, expected (x, u, p) of {expected} to {rows}")
    try:
        plain = function if function.is_a("SXFunction") else function.expand()
    except RuntimeError as error:
        raise ValueError(f"{where} cannot be written out in scalar operations (CasADi's expand): {error}") from error
    if any(plain.instruction_id(k) == ca.OP_CALL for k in range(plain.n_instructions())):
        raise ValueError(f"{where} cannot be written out in scalar operations: it calls a function that is none, such as an integrator")

    def called(x: Any, u: Any, p: Any) -> Any:
        return ca.vec(plain.call([x, u, p][:count])[0])

    return called


def _check_names(model: str, states: Sequence[Signal], inputs: Sequence[Signal], outputs: Sequence[Signal]) -> None:
    for field, signals, minimum in (("states", states, 1), ("inputs", inputs, 1), ("outputs", outputs, 0)):
        names = [s.name for s in signals]
        if len(names) < minimum or len(set(names)) != len(names):
            raise ValueError(f"model {model}: {field} = {names}, allowed are at least {minimum} different names")


def _stack(values: Mapping[str, Any], signals: Sequence[Signal], where: str) -> Any:
    names = [s.name for s in signals]
    if set(values) != set(names):
        missing, unknown = sorted(set(names) - set(values)), sorted(set(values) - set(names))
        said = [f"{word} {', '.join(found)}" for word, found in (("missing", missing), ("unknown", unknown)) if found]
        raise ValueError(f"{where}: {', '.join(said)}; expected exactly {', '.join(names) or '(none)'}")
    return ca.vertcat(*(values[n] for n in names)) if names else ca.SX(0, 1)


def _positive(value: object) -> bool:
    return is_finite(value) and value > 0  # type: ignore[operator]
