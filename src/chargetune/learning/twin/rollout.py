"""Outputs of a twin under recorded inputs, with exact slopes, as compiled functions."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from functools import partial
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from chargetune.learning.twin.twin import Twin
from chargetune.runtime.cache import built_once
from chargetune.runtime.compiler import compile_library, find_compiler
from chargetune.runtime.hoisting import hoist
from chargetune.runtime.numpy_call import numpy_call
from chargetune.runtime.split import split
from chargetune.runtime.threads import parallel_map

__all__ = ["parameters", "predict", "predict_each", "slopes", "slopes_each", "start_state"]

# Intervals of the shortest roll-out that is built; longer ones are this times a power of two.
SHORTEST = 45


# Unknowns that are simulated in one call: enough that nothing waits for the interpreter, few enough for every core to have some.
AT_ONCE = 8


def parameters(twin: Twin, m: NDArray[np.float64]) -> NDArray[np.float64]:
    """The model's parameter vector p for unknowns m, shape (np,)."""
    return np.array(_mapping(_Key(twin))[0](m, *_numbers(twin))).ravel()


def start_state(twin: Twin, m: NDArray[np.float64]) -> NDArray[np.float64]:
    """The state at the start of a trial for unknowns m, shape (nx,)."""
    return np.array(_mapping(_Key(twin))[1](m, *_numbers(twin))).ravel()


def predict(twin: Twin, m: NDArray[np.float64], inputs: NDArray[np.float64]) -> NDArray[np.float64]:
    """Measured outputs at both ends of every interval under ``inputs`` (K, nu), shape (K, 2, number of measured outputs)."""
    return predict_each(twin, m, [inputs])[0]


def predict_each(twin: Twin, m: NDArray[np.float64], inputs: Sequence[NDArray[np.float64]]) -> list[NDArray[np.float64]]:
    """`predict` under the inputs of each of several episodes, at once; for m of shape (n, d) each result is (n, K, 2, outputs)."""
    return _roll(twin, 0, m, inputs, (2, len(twin.noise_sd)))


def slopes(twin: Twin, m: NDArray[np.float64], inputs: NDArray[np.float64]) -> NDArray[np.float64]:
    """Exact slopes of `predict` with respect to m, shape (K, 2, number of measured outputs, d)."""
    return slopes_each(twin, m, [inputs])[0]


def slopes_each(twin: Twin, m: NDArray[np.float64], inputs: Sequence[NDArray[np.float64]]) -> list[NDArray[np.float64]]:
    """`slopes` under the inputs of each of several episodes, at once."""
    return _roll(twin, 1, m, inputs, (2, len(twin.noise_sd), sum(twin.sizes)))


def _roll(
    twin: Twin, which: int, m: NDArray[np.float64], inputs: Sequence[NDArray[np.float64]], shape: tuple[int, ...]
) -> list[NDArray[np.float64]]:
    """What the function of that number says of each interval, in this shape, after the first axes of m."""
    nu, length = len(twin.model.inputs), _padded(max(len(u) for u in inputs))
    padded = np.zeros((len(inputs), length, nu + len(twin.given)))
    for row, u in zip(padded, inputs, strict=True):
        row[: len(u), :nu] = u
    # What follows a given signal comes in with the inputs.
    for i, values in enumerate(twin.given.values()):
        padded[:, :, nu + i] = np.asarray(values)[np.minimum(np.arange(length), len(values) - 1)]
    function = partial(_evaluated, _Key(twin), which, padded)
    several, d = m.shape[:-1], m.shape[-1]
    rows = m.reshape(-1, d)
    parts = parallel_map(function, [rows[i : i + AT_ONCE] for i in range(0, len(rows), AT_ONCE)]) if len(rows) > 1 else [function(rows)]
    out = np.concatenate(parts).reshape(len(rows), *padded.shape[:2], *shape)
    return [out[:, k, : len(u)].reshape(*several, len(u), *shape) for k, u in enumerate(inputs)]


class _Key:
    """A twin as key of a cache: its structure without its numbers, because the functions take these as arguments."""

    def __init__(self, twin: Twin) -> None:
        self.twin = twin
        model = twin.model
        # The functions live as long as this key, so no others have their hashes meanwhile.
        names = (model.state_names, model.output_names, tuple(model.parameter_blocks.items()))
        self._content = (model.f.__hash__(), model.h.__hash__(), *names, twin.unknowns, tuple(twin.noise_sd), tuple(twin.given))

    def __hash__(self) -> int:
        return hash(self._content)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Key) and self._content == other._content


def _numbers(twin: Twin) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(nominal parameters, nominal start state)."""
    return twin.model.nominal, np.array([float(twin.start.get(name, 0.0)) for name in twin.model.state_names])


def _symbols(twin: Twin) -> tuple[Any, Any, Any, Any, Any, Any]:
    """(m, nominal parameters, nominal start, p(m), x0(m), biases(m) by measured output) as expressions."""
    model = twin.model
    m = ca.SX.sym("m", sum(twin.sizes))
    nominal, begin = ca.SX.sym("nominal", model.nominal.size), ca.SX.sym("begin", len(model.states))
    pieces = split(m, twin.sizes)
    parts = {one.slot: piece for one, piece in zip(twin.unknowns, pieces, strict=True)}
    kinds = {one.name: one.kind for one in twin.unknowns if one.kind in ("factor", "offset")}
    blocks, first = [], 0
    for name, values in model.parameters:
        block, change = nominal[first : first + len(values)], parts.get((name, "block"))
        blocks.append(block if change is None else block * ca.exp(change) if kinds[name] == "factor" else block + change)
        first += len(values)
    starts = [begin[i] + parts.get((name, "start"), 0.0) for i, name in enumerate(model.state_names)]
    bias = [parts.get((name, "bias"), 0.0) for name in twin.noise_sd]
    return m, nominal, begin, ca.vertcat(*blocks), ca.vertcat(*starts), ca.vertcat(*bias)


@built_once(16)
def _mapping(key: _Key) -> tuple[ca.Function, ca.Function]:
    """(m, nominal, begin) -> p, and -> x0."""
    m, nominal, begin, p, x0, _ = _symbols(key.twin)
    return ca.Function("p", [m, nominal, begin], [p]), ca.Function("x0", [m, nominal, begin], [x0])


def _padded(count: int) -> int:
    """Functions are built for a few lengths only; what is appended to a shorter trace is simulated and cut off."""
    length = SHORTEST
    while length < count:
        length *= 2
    return length


def _evaluated(key: _Key, which: int, inputs: NDArray[np.float64], m: NDArray[np.float64]) -> NDArray[np.float64]:
    """The function of that number at several m (n, d), each under several inputs (episodes, K, nu): one call, n * episodes results."""
    count = len(m) * len(inputs)
    given = [np.repeat(m, len(inputs), axis=0), *(np.tile(one, (count, 1)) for one in _numbers(key.twin)), np.tile(inputs, (len(m), 1, 1))]
    (out,) = numpy_call(_mapped(key, inputs.shape[1], which, count), *given)
    return out


@built_once(128)
def _mapped(key: _Key, length: int, which: int, count: int) -> ca.Function:
    one = _simulated(key, length)[which]
    return one if count == 1 else one.map(count)


@built_once(32)
def _simulated(key: _Key, count: int) -> tuple[ca.Function, ca.Function]:
    """((m, nominal, begin, inputs) -> outputs, their Jacobian with respect to m) for ``count`` intervals.

    State and its sensitivity are rolled out together: one small function an interval, exact by the chain rule. Machine code
    where there is a C compiler: a posterior and an ensemble take thousands of roll-outs.
    """
    twin = key.twin
    model = twin.model
    nx, nu, d = len(model.states), len(model.inputs) + len(twin.given), sum(twin.sizes)
    m, nominal, begin, p, x0, bias = _symbols(twin)
    x, u, sensitivity = ca.SX.sym("x", nx), ca.SX.sym("u", nu), ca.SX.sym("S", nx, d)
    own, told = split(u, (len(model.inputs), len(twin.given)))
    places = dict(zip(model.parameter_blocks, np.cumsum([0, *model.parameter_blocks.values()]), strict=False))
    for i, name in enumerate(twin.given):
        p[int(places[name])] = told[i]
    rows = [model.output_names.index(name) for name in twin.noise_sd]

    def outputs(state: Any) -> Any:
        return model.h(state, own, p)[rows] + bias

    after, at = model.f(x, own, p), ca.SX.sym("after", nx)
    ahead = ca.mtimes(ca.jacobian(after, x), sensitivity) + ca.jacobian(after, m)
    start, end = outputs(x), outputs(at)
    slope_start = ca.mtimes(ca.jacobian(start, x), sensitivity) + ca.jacobian(start, m)
    slope_end = ca.mtimes(ca.jacobian(end, at), ahead) + ca.jacobian(end, m)
    end, slope_end = (ca.substitute([e], [at], [after])[0] for e in (end, slope_end))
    fixed = [m, nominal, begin]
    # Row by row, so that the result reshapes to (interval, end, output, unknown).
    slopes = ca.vec(ca.vertcat(slope_start, slope_end).T)
    plain, of_plain = hoist("plain", [x, u], fixed, [after, ca.vertcat(start, end)])
    with_slopes, of_slopes = hoist("with_slopes", [x, sensitivity, u], fixed, [after, ahead, slopes])

    inputs = ca.MX.sym("inputs", nu, count)
    given = [ca.MX.sym(name, e.shape[0]) for name, e in zip(("m", "nominal", "begin"), fixed, strict=True)]
    at_start = ca.Function("at_start", fixed, [x0, ca.densify(ca.jacobian(x0, m))])
    state, first = at_start(*given)
    _, seen = plain.mapaccum("values", count)(state, inputs, ca.repmat(of_plain(*given), 1, count))
    _, _, steep = with_slopes.mapaccum("slopes", count, 2)(state, first, inputs, ca.repmat(of_slopes(*given), 1, count))
    simulate = ca.Function("simulate", [*given, inputs], [seen])
    sloped = ca.Function("sloped", [*given, inputs], [steep])
    if find_compiler() is None:
        return simulate, sloped
    try:
        generator = ca.CodeGenerator("twin", {"with_header": False})
        generator.add(simulate)
        generator.add(sloped)
        library = str(compile_library("twin", (generator.dump(),)))
        return ca.external("simulate", library), ca.external("sloped", library)
    except (RuntimeError, OSError) as error:
        warnings.warn(f"the twin runs on the virtual machine, several times slower: {error}", RuntimeWarning, stacklevel=2)
        return simulate, sloped
