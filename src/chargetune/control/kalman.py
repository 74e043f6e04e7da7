"""Extended Kalman filter, in CasADi expressions; every setting of it may be a run-time value."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from chargetune.control.estimators import finite
from chargetune.model.model import Model, Named
from chargetune.runtime.counted import counted
from chargetune.runtime.split import split

__all__ = ["ExtendedKalman", "FilterMemory", "Setting"]

# A number, the name of a scalar parameter of the model, or an expression (p, u) of its parameters and the input of the interval.
Setting = float | str | Callable[[Named, Named], Any]
SETTINGS = ("measurement_sd", "process_sd", "start_sd", "gate_sd")


class FilterMemory(NamedTuple):
    """What the filter carries from step to step, numbers or symbols.

    x (nx,) the state, covariance (nx, nx) its covariance, step the measurements so far; of each measured output (ny,) the samples
    ``in_a_row`` outside the gate since the last one inside, all that were ``rejected``, and all that were ``lost`` (not finite).
    """

    x: Any
    covariance: Any
    step: Any
    in_a_row: Any
    rejected: Any
    lost: Any


class _Gate(NamedTuple):
    """Of one sample: whether it is inside the gate, whether it is on the side that is believed, and the gate on that side."""

    inside: Any
    believed: Any
    at: Any


@dataclass(frozen=True)
class ExtendedKalman:
    """Extended Kalman filter on the ``measured`` outputs of the controller's model.

    With A = df/dx, C = dh/dx at the prediction, R = diag(measurement_sd^2), Q = diag(process_sd^2) per interval:
    K = P C' (C P C' + R)^-1, x_hat = x + K (y - h(x, u)), P = (I - K C) P (I - K C)' + K R K', then x = f(x_hat, u), P = A P A' + Q.
    The measurement of index k is the output at the end of interval k - 1, so h is taken with the input applied there
    (zero before the first). Before the first one P = diag(start_sd^2). ``measurement_sd`` should hold the model's error as well as the
    sensor's where no disturbance of the model stands for it: in fast charging the model error dominates. Outputs are processed one
    by one, which is exact for a diagonal R.

    Each standard deviation is a number (compiled in), the name of a scalar model parameter, or an expression (p, u) of parameters and the
    input of the interval (that before the measurement; for process_sd that which follows): the latter two are run-time values, and
    theta can set them.

    iterations
        Gauss-Newton iterations of each update: with more than one h is linearised again at the estimate, for bent outputs.
    gate_sd
        A sample further from its prediction than so many standard deviations sqrt(C P C' + R) of the innovation is left out, as one
        that is not finite always is. None, the default: no gate, since a filter without a disturbance model takes model errors of
        tens of its standard deviations for outliers. 5 is usual with one.
    believed
        "above" or "below": a sample outside the gate on this side of its prediction is not left out, but counts as one at the gate. This is
        for the side on which a limit lies: there a sample that is left out would let the input go on rising. Limiting an innovation is
        what a robust filter does with all of them (Masreliez and Martin, IEEE TAC 22 (1977) 361).
    rejections_max
        After so many in a row the next ones are taken until one is inside the gate again: what lasts is no outlier, even where
        process_sd is 0 and P does not grow.
    first
        (y, p) -> states by name that the first measurement sets, before it is used; their start_sd is then the spread of that.

    Source: Plett, Battery Management Systems, vol. 2, ch. 3; Simon, Optimal State Estimation, sec. 6.1 and 13.2; iterated update: Bell
    and Cathey, IEEE TAC 38 (1993) 294; gate: Bar-Shalom, Li and Kirubarajan, Estimation with Applications, sec. 5.4.
    """

    measured: tuple[str, ...]
    measurement_sd: tuple[Setting, ...]
    process_sd: tuple[Setting, ...]
    start_sd: tuple[Setting, ...]
    iterations: int = 1
    gate_sd: Setting | None = None
    rejections_max: int = 10
    believed: Literal["above", "below"] | None = None
    first: Callable[[Mapping[str, Any], Named], Mapping[str, Any]] | None = None

    def __post_init__(self) -> None:
        if len(self.measured) != len(self.measurement_sd) or not self.measured:
            raise ValueError(
                f"estimator: measurement_sd has {counted(len(self.measurement_sd), 'value')}, "
                f"expected one for each of {list(self.measured)}"
            )
        if len(set(self.measured)) < len(self.measured):
            raise ValueError(f"estimator: measured = {list(self.measured)}, allowed are different names")
        for name in SETTINGS:
            values = [v for v in self._settings(name) if not isinstance(v, str) and not callable(v)]
            strict = name in ("measurement_sd", "gate_sd")
            if not all(math.isfinite(v) and (v > 0.0 if strict else v >= 0.0) for v in values):
                raise ValueError(f"estimator: {name} = {list(values)}, allowed are finite numbers {'>' if strict else '>='} 0")
        if self.believed not in (None, "above", "below"):
            raise ValueError(f"estimator: believed = {self.believed!r}, allowed is 'above', 'below' or None")
        for name in ("iterations", "rejections_max"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise ValueError(f"estimator: {name} = {value!r}, allowed is an integer >= 1")

    @classmethod
    def of(
        cls,
        model: Model,
        *,
        measurement_sd: Mapping[str, Setting],
        process_sd: Mapping[str, Setting],
        start_sd: Mapping[str, Setting],
        **more: Any,
    ) -> ExtendedKalman:
        """The filter with its standard deviations by name; of states that are not named they are 0. Raises ValueError for unknown names."""
        for field, given, allowed in (
            ("measurement_sd", measurement_sd, model.output_names),
            ("process_sd", process_sd, model.state_names),
            ("start_sd", start_sd, model.state_names),
        ):
            unknown = [name for name in given if name not in allowed]
            if unknown:
                raise ValueError(f"estimator: {field} names {unknown}, allowed are {', '.join(allowed)}")
        process, start = (tuple(given.get(name, 0.0) for name in model.state_names) for given in (process_sd, start_sd))
        return cls(tuple(measurement_sd), tuple(measurement_sd.values()), process, start, **more)

    def signals(self, model: Model) -> tuple[str, ...]:
        unknown = sorted(set(self.measured) - set(model.output_names))
        if unknown:
            raise ValueError(f"estimator: measured = {unknown}, allowed are {', '.join(model.output_names)}")
        for name in SETTINGS:
            named = [sd for sd in self._settings(name) if isinstance(sd, str)]
            if any(model.parameter_blocks.get(sd) != 1 for sd in named):
                raise ValueError(f"estimator: {name} names {named}, allowed are scalar parameters of model {model.name}")
        for name in ("process_sd", "start_sd"):
            if len(getattr(self, name)) != len(model.states):
                raise ValueError(
                    f"estimator: {name} has {counted(len(getattr(self, name)), 'value')}, "
                    f"expected one for each of {list(model.state_names)}"
                )
        return self.measured

    def initial(self, model: Model, state: NDArray[np.float64]) -> NDArray[np.float64]:
        # The first covariance is a run-time value, so `correct` puts it in.
        return np.concatenate([np.asarray(state, dtype=float), np.zeros(sum(self._sizes(model)[1:]))])

    def memory(self, model: Model, packed: Any) -> FilterMemory:
        """The parts of the filter's memory, from NumPy arrays as well as from symbols."""
        sizes = self._sizes(model)
        if isinstance(packed, np.ndarray):
            x, lower, step, *counts = np.split(packed, np.cumsum(sizes)[:-1])
            return FilterMemory(x, np.array(_symmetric(ca.DM(lower), len(x))), step[0], *counts)
        x, lower, step, *counts = split(packed, sizes)
        return FilterMemory(x, _symmetric(lower, sizes[0]), step, *counts)

    def correct(self, model: Model, memory: Any, y: Mapping[str, Any], u: Any, p: Any) -> tuple[Any, Any]:
        nx, named = len(model.states), (Named(model.parameter_blocks, p), _inputs(model, u))
        before = self.memory(model, memory)
        begins, start = before.step < 0.5, self.values("start_sd", *named)
        prior, covariance = before.x, ca.if_else(begins, ca.diag(ca.vertcat(*start) ** 2), before.covariance)
        if self.first is not None:
            prior = self._first(model, prior, y, named[0], begins)
        noise = [sd**2 for sd in self.values("measurement_sd", *named)]
        at = ca.SX.sym("at", nx)
        outputs = model.h(at, u, p)
        outputs = ca.vertcat(*(outputs[model.output_names.index(name)] for name in self.measured))

        x, spread = prior, covariance
        known = [finite(y[name]) for name in self.measured]
        inside: list[Any] = []
        used: list[Any] = []
        taken: list[Any] = []
        for _ in range(self.iterations):
            values, rows = ca.substitute([outputs, ca.jacobian(outputs, at)], [at], [x])
            around, x, spread = x, prior, covariance
            if not used:
                gates = self._gates(y, named, values, rows, covariance, noise)
                inside = [one.inside for one in gates]
                for j, one in enumerate(gates):
                    whole = ca.logic_or(one.inside, before.in_a_row[j] >= self.rejections_max)
                    taken.append(ca.if_else(whole, y[self.measured[j]], one.at))
                    used.append(ca.logic_and(known[j], ca.logic_or(whole, one.believed)))
            for j in range(len(self.measured)):
                row = rows[j, :]
                towards = ca.mtimes(spread, row.T)
                gain = ca.if_else(used[j], 1, 0) * towards / (ca.mtimes(row, towards) + noise[j])
                innovation = taken[j] - values[j] - ca.mtimes(row, x - around)
                x = x + gain * ca.if_else(used[j], innovation, 0)
                # Joseph's form: the covariance stays positive whatever rounding does to the gain.
                half = spread - ca.mtimes(gain, towards.T)
                spread = _mirrored(half - ca.mtimes(ca.mtimes(half, row.T), gain.T) + noise[j] * ca.mtimes(gain, gain.T))
        # A lost sample says nothing of whether the others were outliers; samples that are taken outside the gate keep it open.
        in_a_row = [ca.if_else(known[j], ca.if_else(inside[j], 0, before.in_a_row[j] + 1), before.in_a_row[j]) for j in range(len(known))]
        rejected = [before.rejected[j] + ca.logic_and(known[j], ca.logic_not(used[j])) for j in range(len(known))]
        lost = [before.lost[j] + ca.logic_not(known[j]) for j in range(len(known))]
        return x, ca.vertcat(x, _lower(spread), before.step + 1, *in_a_row, *rejected, *lost)

    def predict(self, model: Model, x_hat: Any, memory: Any, u: Any, p: Any) -> Any:
        before = self.memory(model, memory)
        at = ca.SX.sym("at", len(model.states))
        (transition,) = ca.substitute([ca.jacobian(model.f(at, u, p), at)], [at], [x_hat])
        process = ca.vertcat(*self.values("process_sd", Named(model.parameter_blocks, p), _inputs(model, u))) ** 2
        ahead = ca.mtimes([transition, before.covariance, transition.T]) + ca.diag(process)
        return ca.vertcat(model.f(x_hat, u, p), _lower(ahead), before.step, before.in_a_row, before.rejected, before.lost)

    def _gates(
        self, y: Mapping[str, Any], named: tuple[Named, Named], values: Any, rows: Any, covariance: Any, noise: list[Any]
    ) -> list[_Gate]:
        """The gate of each measured output."""
        if self.gate_sd is None:
            return [_Gate(1, 0, 0.0)] * len(self.measured)
        (width,), out = self.values("gate_sd", *named), []
        sign = {"above": 1.0, "below": -1.0, None: 0.0}[self.believed]
        for j, name in enumerate(self.measured):
            off, variance = y[name] - values[j], ca.mtimes([rows[j, :], covariance, rows[j, :].T]) + noise[j]
            out.append(_Gate(off**2 <= width**2 * variance, sign * off > 0, values[j] + sign * width * ca.sqrt(variance)))
        return out

    def _first(self, model: Model, prior: Any, y: Mapping[str, Any], p: Named, begins: Any) -> Any:
        given = self.first(y, p) if self.first is not None else {}
        unknown = sorted(set(given) - set(model.state_names))
        if unknown:
            raise ValueError(f"estimator: first sets {unknown}, allowed are {', '.join(model.state_names)}")
        takes = {name: ca.logic_and(begins, finite(value)) for name, value in given.items()}
        return ca.vertcat(*(ca.if_else(takes[n], given[n], prior[i]) if n in given else prior[i] for i, n in enumerate(model.state_names)))

    def _settings(self, name: str) -> tuple[Setting, ...]:
        value = getattr(self, name)
        return value if isinstance(value, tuple) else () if value is None else (value,)

    def values(self, name: str, p: Named, u: Named) -> list[Any]:
        """The expressions of measurement_sd, process_sd, start_sd or gate_sd."""
        return [ca.SX(p[v] if isinstance(v, str) else v(p, u) if callable(v) else v) for v in self._settings(name)]

    def _sizes(self, model: Model) -> tuple[int, ...]:
        nx, ny = len(model.states), len(self.measured)
        return nx, nx * (nx + 1) // 2, 1, ny, ny, ny


def _inputs(model: Model, u: Any) -> Named:
    return Named(dict.fromkeys(model.input_names, 1), u)


def _lower(matrix: Any) -> Any:
    """The lower triangle of a symmetric matrix, column by column."""
    size = matrix.shape[0]
    return ca.vertcat(*(matrix[i, j] for j in range(size) for i in range(j, size)))


def _symmetric(lower: Any, size: int) -> Any:
    """The matrix of `_lower`."""
    places = {(i, j): k for k, (i, j) in enumerate((i, j) for j in range(size) for i in range(j, size))}
    return ca.vertcat(*(ca.horzcat(*(lower[places[max(i, j), min(i, j)]] for j in range(size))) for i in range(size)))


def _mirrored(matrix: Any) -> Any:
    return _symmetric(_lower(ca.densify(matrix)), matrix.shape[0])
