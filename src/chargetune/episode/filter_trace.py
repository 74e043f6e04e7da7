"""What a Kalman filter did along an episode: its standard deviations, and the samples that it left out."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from chargetune.control.controller import Controller
from chargetune.control.kalman import ExtendedKalman
from chargetune.episode.episode import Episode
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


def filter_trace(controller: Controller, episode: Episode, theta: ArrayLike | None = None, delay_steps: int = 0) -> FilterTrace:
    """Run the controller's `ExtendedKalman` again along a recorded episode, which has its estimate and not its memory.

    The measurement at rest before the first interval is not recorded. The estimate after it is: the filter starts from that, with what
    it predicts as measurement, so that it counts neither as rejected nor as lost. ``delay_steps``: how many intervals late samples came.
    Raises ValueError for a controller with another estimator, or with given signals.
    """
    estimator, model = controller.estimator, controller.model
    if not isinstance(estimator, ExtendedKalman):
        raise ValueError(f"estimator = {type(estimator).__name__}, allowed is ExtendedKalman: others leave nothing out")
    if controller.given:
        given = ", ".join(controller.given_names)
        raise ValueError(f"the controller has given signals {given}, allowed is one without: an episode does not hold them")
    count, names = len(episode), estimator.signals(model)
    p = np.array(controller.parameters(controller.theta_vector(theta), model.nominal, [])).ravel()
    first = episode.estimate[0]
    at_rest = np.array(model.h(first, np.zeros(len(model.inputs)), p)).ravel()
    received = np.empty((count, len(names)))
    for i, name in enumerate(names):
        received[: 1 + delay_steps, i] = at_rest[model.output_names.index(name)]
        received[1 + delay_steps :, i] = episode.signal(name)[1][: max(count - 1 - delay_steps, 0)]
    last = np.vstack([np.zeros_like(episode.input[:1]), episode.input[:-1]])
    step = cached(f"filter {controller.structure}", lambda: _step(controller))
    roll = cached(f"filter {controller.structure} {count}", lambda: step.mapaccum("filter", count, 1))
    _, estimate, sd, rejected, lost = numpy_call(
        roll, estimator.initial(model, first), received, last, episode.input, np.tile(p, (count, 1))
    )
    totals = (np.rint(values[-1]).astype(np.int64) for values in (rejected, lost))
    return FilterTrace(model.state_names, names, estimate, sd, *totals)


def _step(controller: Controller) -> ca.Function:
    """(memory, y, last input, input, p) -> (memory, estimate, sd, rejected, lost)."""
    estimator, model = controller.estimator, controller.model
    if not isinstance(estimator, ExtendedKalman):
        raise TypeError("the filter of a controller without one")
    names, nx, nu = estimator.signals(model), len(model.states), len(model.inputs)
    memory = ca.SX.sym("memory", estimator.initial(model, np.zeros(nx)).size)
    y = ca.SX.sym("y", len(names))
    last, u, p = ca.SX.sym("last", nu), ca.SX.sym("u", nu), ca.SX.sym("p", model.nominal.size)
    x, corrected = estimator.correct(model, memory, {name: y[i] for i, name in enumerate(names)}, last, p)
    after = estimator.memory(model, corrected)
    ahead = estimator.predict(model, x, corrected, u, p)
    results = [ahead, x, ca.sqrt(ca.diag(after.covariance)), after.rejected, after.lost]
    return ca.Function("filter", [memory, y, last, u, p], [ca.densify(r) for r in results])
