"""What a Kalman filter did along an episode: its standard deviations, and the samples that it left out."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from chargetune.control.controller import Controller
from chargetune.control.kalman import ExtendedKalman
from chargetune.episode.episode import Episode
from chargetune.model.given import Given, checked_given, windows
from chargetune.runtime.cache import cached
from chargetune.runtime.numpy_call import numpy_call

__all__ = ["FilterTrace", "filter_trace"]


@dataclass(frozen=True)
class FilterTrace:
    """The filter of K control steps; states and measured outputs by name.

    estimate, sd (K, nx): after each measurement; rejected, lost (ny,): samples that the gate refused, and that were not finite.
    """

    state_names: tuple[str, ...]
    measured: tuple[str, ...]
    estimate: NDArray[np.float64]
    sd: NDArray[np.float64]
    rejected: NDArray[np.int64]
    lost: NDArray[np.int64]


def filter_trace(
    controller: Controller, episode: Episode, theta: ArrayLike | None = None, delay_steps: int = 0, *, given: Given | None = None
) -> FilterTrace:
    """Run the controller's `ExtendedKalman` again along a recorded episode, which has its estimate and not its memory.

    The measurement at rest before the first interval is not recorded. The estimate after it is: the filter starts from that, with what
    it predicts as measurement, so that it counts neither as rejected nor as lost. ``delay_steps``: how many intervals late samples came.
    ``given``: the given signals of the episode, which does not hold them. Raises ValueError for a controller with another estimator.
    """
    estimator, model = controller.estimator, controller.model
    if not isinstance(estimator, ExtendedKalman):
        raise ValueError(f"estimator = {type(estimator).__name__}, allowed is ExtendedKalman: others leave nothing out")
    count, names = len(episode), estimator.signals(model)
    told = checked_given(controller.given_names, given, count, controller.horizon)
    seen = windows([told[name] for name in controller.given_names], count, controller.horizon).reshape(count, controller.horizon + 2, -1)
    values = controller.theta_vector(theta)

    def parameters(signals: NDArray[np.float64]) -> NDArray[np.float64]:
        if not controller.given:
            return np.tile(np.array(controller.parameters(values, model.nominal, [])).ravel(), (count, 1))
        return np.array([np.array(controller.parameters(values, model.nominal, one)).ravel() for one in signals]).reshape(count, -1)

    # A measurement belongs to the signals of the interval that it ends, a prediction to those of the one that it begins.
    before, p = parameters(seen[:, 0]), parameters(seen[:, 1])
    first = episode.estimate[0]
    at_rest = np.array(model.h(first, np.array(controller.input_before), before[0])).ravel()
    received = np.empty((count, len(names)))
    for i, name in enumerate(names):
        received[: 1 + delay_steps, i] = at_rest[model.output_names.index(name)]
        received[1 + delay_steps :, i] = episode.signal(name)[1][: max(count - 1 - delay_steps, 0)]
    last = np.vstack([controller.input_before, episode.input[:-1]])
    step = cached(f"filter {controller.structure}", lambda: _step(controller))
    roll = cached(f"filter {controller.structure} {count}", lambda: step.mapaccum("filter", count, 1))
    _, estimate, sd, rejected, lost = numpy_call(roll, estimator.initial(model, first), received, last, episode.input, before, p)
    totals = (np.rint(values[-1]).astype(np.int64) for values in (rejected, lost))
    return FilterTrace(model.state_names, names, estimate, sd, *totals)


def _step(controller: Controller) -> ca.Function:
    """(memory, y, last input, input, p of the interval before, p) -> (memory, estimate, sd, rejected, lost)."""
    estimator, model = controller.estimator, controller.model
    if not isinstance(estimator, ExtendedKalman):
        raise TypeError("the filter of a controller without one")
    names, nx, nu = estimator.signals(model), len(model.states), len(model.inputs)
    memory = ca.SX.sym("memory", estimator.initial(model, np.zeros(nx)).size)
    y = ca.SX.sym("y", len(names))
    last, u = ca.SX.sym("last", nu), ca.SX.sym("u", nu)
    before, p = ca.SX.sym("before", model.nominal.size), ca.SX.sym("p", model.nominal.size)
    x, corrected = estimator.correct(model, memory, {name: y[i] for i, name in enumerate(names)}, last, before)
    after = estimator.memory(model, corrected)
    ahead = estimator.predict(model, x, corrected, u, p)
    results = [ahead, x, ca.sqrt(ca.diag(after.covariance)), after.rejected, after.lost]
    return ca.Function("filter", [memory, y, last, u, before, p], [ca.densify(r) for r in results])
