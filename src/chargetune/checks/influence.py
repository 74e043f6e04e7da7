"""What theta can do: entries without influence on the closed loop, and limits that no theta keeps."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from chargetune.checks.finding import Evidence, Finding
from chargetune.control.control_step import numbers, problem_of
from chargetune.control.controller import Controller
from chargetune.model.parameter_space import ParameterSpace

__all__ = ["check_influence", "check_theta"]

# An input that moves by less than this share of its range did not move: the solver's tolerance is a tenth of it.
MOVED = 1e-3
# Random theta at which the influence of an entry is looked for, and at which limits are tried.
BASES, TRIED = 2, 32
# When none of them brings the excess below this share of the untuned one, tuning is not likely to bring it to nothing.
HOPELESS = 0.5


def check_influence(
    inputs: Callable[[NDArray[np.float64]], NDArray[np.float64]], controller: Controller, given: NDArray[np.float64] | None = None
) -> list[Finding]:
    """Entries of theta that do not change what the controller does.

    ``inputs(theta)`` runs a closed loop and gives its inputs (K, nu). Each entry is put to both of its bounds, alone, from
    theta_0 and from random theta; its influence is the largest change of any input as a share of its range, with the given
    signals at ``given`` (by default 0).
    """
    space, draw = controller.theta, np.random.default_rng(0)
    bases = [space.to_unit(space.default), *(draw.uniform(size=space.dimension) for _ in range(BASES))]
    ranges, influence = _ranges(controller, given), np.zeros(space.dimension)
    for base in bases:
        reference = inputs(space.from_unit(base))
        for i in range(space.dimension):
            for end in (0.0, 1.0):
                moved = base.copy()
                moved[i] = end
                changed = inputs(space.from_unit(moved))
                same = changed.shape == reference.shape
                influence[i] = max(influence[i], np.max(np.abs(changed - reference) / ranges, initial=0.0) if same else 1.0)
    idle: list[str] = []
    for part in space.parameters:
        still = influence[space.slices[part.name]] < MOVED
        idle += [part.name] if still.all() else [name for name, value in zip(part.entries, still, strict=True) if value]
    if not idle:
        return []
    everything = bool(np.all(influence < MOVED))
    return [
        Finding(
            "no-influence",
            "error" if everything else "warning",
            f"{', '.join(idle)}: no influence on the closed loop, at neither end of the range"
            + (": there is nothing to tune" if everything else ""),
            "leave these entries out of theta, or let the controller meet them: another start, limit, constraint or estimator",
            {f"influence {name}": float(value) for name, value in zip(space.entries, influence, strict=True)},
            Evidence(
                "entry of theta",
                "largest change of an input (share of its range)",
                {"influence": (np.arange(space.dimension, dtype=np.float64), influence)},
                {"noticeable": MOVED},
            ),
        )
    ]


def check_theta(worst: Callable[[NDArray[np.float64]], float], space: ParameterSpace, start: ArrayLike | None = None) -> list[Finding]:
    """Whether some theta at least halves what is beyond the limits, and whether the one declared safe keeps them.

    ``worst(theta)`` is the largest excess over any limit less its tolerance, in tolerances (`Score.worst`), positive when one is
    broken. Tried are
    theta_0, each parameter and all of them at either bound, and random theta.
    """
    if start is not None:
        excess = worst(space.validate(start))
        if excess <= 0:
            return []
        return [
            Finding(
                "unsafe-start",
                "error",
                f"the theta declared safe breaks a limit in simulation, by {excess:.4g} tolerances more than its tolerance",
                "declare a more cautious theta (a larger backoff, larger resistances), and check it again",
                {"excess": excess},
            )
        ]
    draw, middle = np.random.default_rng(0), space.to_unit(space.default)
    tried = [middle]
    for part in (*space.slices.values(), slice(None)):
        for end in (0.0, 1.0):
            tried.append(middle.copy())
            tried[-1][part] = end
    tried += [draw.uniform(size=space.dimension) for _ in range(TRIED)]
    excess_of = []
    for unit in tried:
        excess_of.append(worst(space.from_unit(unit)))
        if excess_of[-1] <= HOPELESS * max(excess_of[0], 0.0):
            return []
    least = float(np.min(excess_of))
    return [
        Finding(
            "no-safe-theta",
            "warning",
            f"none of {len(tried)} theta keeps every limit or halves the excess: the least is {least:.4g} tolerances more than the "
            f"tolerance, untuned {excess_of[0]:.4g}",
            "let theta have more power over the limits: a backoff, a parameter that reaches the limited output, wider bounds",
            {"tried": float(len(tried)), "least_excess": least, "untuned_excess": float(excess_of[0])},
            Evidence(
                "theta tried",
                "excess beyond tolerance (tolerances)",
                {"excess": (np.arange(len(tried), dtype=np.float64), np.array(excess_of))},
                {"limit": 0.0},
            ),
        )
    ]


def _ranges(controller: Controller, given: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
    problem, nu = problem_of(controller), len(controller.model.inputs)
    signals = np.zeros(len(controller.given)) if given is None else given
    q = numbers(controller, controller.theta.default, np.tile(signals, controller.horizon + 2))
    # The last ones: a bound of the rate narrows the first.
    lower, upper = (np.array(bound).ravel()[-nu:] for bound in problem.bounds(problem.first(controller.start, controller.input_before), q))
    return np.asarray(np.maximum(upper - lower, 1e-9), dtype=np.float64)
