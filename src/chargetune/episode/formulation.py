"""What can be seen to be wrong with a controller only by running it: on a perfect model, at other theta, on its plant."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from chargetune.control.controller import Controller, Limit
from chargetune.control.finding import Evidence, Finding
from chargetune.control.formulation import check_horizon, check_signs, check_start, model_at, noticeable, row_values
from chargetune.control.mpc import problem_of
from chargetune.episode.compiled import simulate
from chargetune.episode.episode import Episode
from chargetune.model.model import Model
from chargetune.model.parameters import ParameterSpace
from chargetune.plants.simulated import SimulatedPlant

__all__ = [
    "check_formulation", "check_influence", "check_limits", "check_longer_horizon", "check_response", "check_theta", "perfect_plant",
]  # fmt: skip

# An input that moves by less than this share of its range did not move: the solver's tolerance is a tenth of it.
MOVED = 1e-3
# Penalties are tried at these multiples to see which would be exact.
STRICTER = (10.0, 100.0, 1000.0)
# A longer horizon is worth speaking of when it lowers the closed-loop cost by this share.
WORTH = 0.05
HORIZON_MAX = 50
# Plant and model agree in sign unless their changes are correlated by less than this.
OPPOSITE = -0.3
# Random theta at which the influence of an entry is looked for, and at which limits are tried.
BASES, TRIED = 2, 32
# When none of them brings the excess below this share of the untuned one, tuning is not likely to bring it to nothing.
HOPELESS = 0.5


def perfect_plant(controller: Controller, theta: ArrayLike | None = None) -> SimulatedPlant:
    """The plant of which the controller at theta knows everything: its own model from its own start."""
    return SimulatedPlant(model_at(controller, theta), dict(zip(controller.model.state_names, controller.start, strict=True)))


def check_formulation(
    controller: Controller,
    *,
    steps: int,
    plant: SimulatedPlant | None = None,
    signs: Mapping[tuple[str, str], int] | None = None,
    finer: Model | None = None,
    quick: bool = False,
) -> tuple[Finding, ...]:
    """All checks of a controller that need no verdict on an episode.

    ``plant`` is what the influence of theta is looked for on, by default a perfect model of the untuned controller.
    ``signs``: see `check_signs`; ``finer`` is the model with a shorter sampling time, for limits between samples.
    ``quick`` leaves out what builds other solvers when nothing is suspicious: longer horizons.
    """
    perfect = perfect_plant(controller)
    run = simulate(controller, perfect, steps=steps)
    states = run.state if run.state is not None else np.zeros((1, len(perfect.model.states)))
    found = [*check_start(controller)]
    if len(run):
        found += check_signs(controller, signs or {}, states, run.input)
        found += check_horizon(controller, states, run.input)
        if not found or all(f.code != "unsafe-start" for f in found):
            found += check_limits(controller, run, finer=finer)
        if not quick and all(f.code != "short-horizon" for f in found):
            found += check_longer_horizon(controller, run)
    if controller.theta.dimension:
        on = plant or perfect
        found += check_influence(lambda theta: simulate(controller, on, steps=steps, theta=theta).input, controller)
    return tuple(found)


def check_limits(controller: Controller, run: Episode, *, finer: Model | None = None, theta: ArrayLike | None = None) -> list[Finding]:
    """Limits that are broken although the model is perfect; ``run`` is the closed loop on `perfect_plant`.

    Broken where the controller limits them: the penalty is inexact, or nothing can keep them. Kept there and broken at
    the other end of an interval, or inside it by ``finer``: between samples.
    """
    if run.state is None:
        raise ValueError("the episode has no state: a perfect model is a simulation")
    out: list[Finding] = []
    x, after, u = run.state[:-1], run.state[1:], run.input
    for j, limit in enumerate(controller.limits):
        if limit.at == "terminal":
            continue
        ends = {"start": row_values(controller, j, x, u, theta), "end": row_values(controller, j, after, u, theta, now=x)}
        if limit.at == "end" and not _depends_on_input(limit):
            # A state at the start of an interval is the same as at the end of the one before.
            ends["start"] = ends["end"]
        seen = np.max([ends[name] for name in ("start", "end") if limit.at in (name, "both")], axis=0)
        inside = np.maximum(ends["start"], ends["end"]) + _hump(controller, j, finer, run, theta)
        if np.max(seen) > noticeable(limit):
            out += _broken_where_seen(controller, j, run, seen, theta)
        elif np.max(inside) > noticeable(limit):
            out.append(_between(limit, run, seen, inside, at_ends=max(float(np.max(values)) for values in ends.values())))
    return out


def check_longer_horizon(controller: Controller, run: Episode, theta: ArrayLike | None = None) -> list[Finding]:
    """A horizon so short that the perfect model does clearly better, or keeps a limit, with a longer one."""
    longer = min(HORIZON_MAX, max(4 * controller.horizon, 20))
    if longer == controller.horizon:
        return []
    far = simulate(replace(controller, horizon=longer), perfect_plant(controller, theta), steps=len(run), theta=theta, compiled=False)
    near_cost, far_cost = _costs(controller, run, theta), _costs(controller, far, theta)
    near, better = float(np.sum(near_cost)), float(np.sum(far_cost))
    if len(far) < len(run) or not better < near - WORTH * abs(near):
        return []
    minutes = run.time_s / 60
    return [
        Finding(
            "short-horizon",
            "warning",
            f"with a horizon of {longer} intervals instead of {controller.horizon} the closed loop on a perfect model costs "
            f"{100 * (1 - better / near):.0f} % less: this one is too short to see what it is for",
            f"a horizon of {longer} intervals, or a terminal cost that stands for what comes later",
            {"horizon_intervals": float(controller.horizon), "cost": near, "longer_intervals": float(longer), "cost_longer": better},
            Evidence(
                "time (min)",
                "stage cost, summed",
                {f"N = {controller.horizon}": (minutes, np.cumsum(near_cost)), f"N = {longer}": (minutes, np.cumsum(far_cost))},
            ),
        )
    ]


def check_influence(inputs: Callable[[NDArray[np.float64]], NDArray[np.float64]], controller: Controller) -> list[Finding]:
    """Entries of theta that do not change what the controller does.

    ``inputs(theta)`` runs a closed loop and gives its inputs (K, nu). Each entry is put to both of its bounds, alone, from
    theta_0 and from random theta; its influence is the largest change of any input as a share of its range.
    """
    space, draw = controller.theta, np.random.default_rng(0)
    bases = [space.to_unit(space.default), *(draw.uniform(size=space.dimension) for _ in range(BASES))]
    ranges, influence = _ranges(controller), np.zeros(space.dimension)
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

    ``worst(theta)`` is the largest excess over any limit less its tolerance, positive when one is broken. Tried are
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
                f"the theta declared safe breaks a limit in simulation, by {excess:.4g} beyond its tolerance",
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
            f"none of {len(tried)} theta keeps every limit or halves the excess: the least is {least:.4g}, untuned {excess_of[0]:.4g}",
            "let theta have more power over the limits: a backoff, a parameter that reaches the limited output, wider bounds",
            {"tried": float(len(tried)), "least_excess": least, "untuned_excess": float(excess_of[0])},
            Evidence(
                "theta tried",
                "excess beyond tolerance",
                {"excess": (np.arange(len(tried), dtype=np.float64), np.array(excess_of))},
                {"limit": 0.0},
            ),
        )
    ]


def check_response(controller: Controller, run: Episode, theta: ArrayLike | None = None) -> list[Finding]:
    """Outputs of the plant that move against what the controller's model predicts from the same states and inputs.

    Compared are changes within intervals, y(x_{k+1}, u_k) - y(x_k, u_k), and across the jumps of the input; the plant is
    reversed when their correlation is clearly negative.
    """
    model, u = model_at(controller, theta), run.input
    if len(run) < 2:
        return []
    count = len(run)
    p = ca.repmat(ca.DM(model.nominal), 1, count)
    h, f = model.h.map(count), model.f.map(count)
    before = np.vstack([np.zeros_like(u[:1]), u[:-1]])
    x = run.estimate.T
    at_start, at_rest, at_end = (np.array(v).T for v in (h(x, u.T, p), h(x, before.T, p), h(f(x, u.T, p), u.T, p)))
    out = []
    for name in (n for n in model.output_names if n in run.output_names):
        start, end = run.signal(name)
        i = model.output_names.index(name)
        plant = np.concatenate([end - start, start[1:] - end[:-1]])
        predicted = np.concatenate([at_end[:, i] - at_start[:, i], (at_start - at_rest)[1:, i]])
        known = np.isfinite(plant) & np.isfinite(predicted)
        size = np.linalg.norm(plant[known]) * np.linalg.norm(predicted[known])
        likeness = float(plant[known] @ predicted[known] / size) if size > 0 else 0.0
        if likeness < OPPOSITE:
            out.append(
                Finding(
                    "wrong-sign",
                    "error",
                    f"{name} of the plant moves against what the model predicts (correlation {likeness:.2f})",
                    f"the sign of the input or of {name} is reversed between plant and controller: current is positive when it charges",
                    {"correlation": likeness},
                    Evidence(
                        "time (s)",
                        f"change of {name} in an interval",
                        {"plant": (run.time_s, end - start), "model": (run.time_s, at_end[:, i] - at_start[:, i])},
                        {"zero": 0.0},
                    ),
                )
            )
    return out


def _broken_where_seen(controller: Controller, j: int, run: Episode, seen: NDArray[np.float64], theta: ArrayLike | None) -> list[Finding]:
    """The limit is broken where the controller sees it: would a larger penalty have kept it?"""
    limit, worst = controller.limits[j], float(np.max(seen))
    minutes, name = run.time_s / 60, f"{limit.of} beyond its limit"
    for factor in STRICTER:
        limits = tuple(replace(part, penalty=part.penalty * factor) if k == j else part for k, part in enumerate(controller.limits))
        strict = simulate(replace(controller, limits=limits), perfect_plant(controller, theta), steps=len(run), theta=theta, compiled=False)
        kept = _seen(controller, j, strict, theta)
        if float(np.max(kept)) <= noticeable(limit):
            return [
                Finding(
                    "inexact-penalty",
                    "error",
                    f"the penalty of {limit.of} is not exact: a perfect model breaks the limit by {worst:.4g}, "
                    f"with {factor:g} times the penalty it does not",
                    f"a penalty of {limit.of} of at least {factor * limit.penalty:g} (it is {limit.penalty:g})",
                    {
                        "excess": worst,
                        "penalty": limit.penalty,
                        "penalty_exact": factor * limit.penalty,
                        "excess_exact": float(np.max(kept)),
                    },
                    Evidence("time (min)", name, {"as it is": (minutes, seen), f"penalty x {factor:g}": (minutes, kept)}, {"limit": 0.0}),
                )
            ]
    return [
        Finding(
            "limit-not-kept",
            "warning",
            f"a perfect model breaks the limit of {limit.of} by {worst:.4g}, also with {STRICTER[-1]:g} times the penalty",
            "a longer horizon, an input range that can keep it, or another start",
            {"excess": worst, "penalty": limit.penalty},
            Evidence("time (min)", name, {"closed loop": (minutes, seen)}, {"limit": 0.0}),
        )
    ]


def _seen(controller: Controller, j: int, run: Episode, theta: ArrayLike | None) -> NDArray[np.float64]:
    if run.state is None:
        raise ValueError("the episode has no state")
    at, x, after = controller.limits[j].at, run.state[:-1], run.state[1:]
    rows = []
    if at in ("start", "both"):
        rows.append(row_values(controller, j, x, run.input, theta))
    if at in ("end", "both"):
        rows.append(row_values(controller, j, after, run.input, theta, now=x))
    return np.asarray(np.max(rows, axis=0), dtype=np.float64)


def _between(limit: Limit, run: Episode, seen: NDArray[np.float64], inside: NDArray[np.float64], *, at_ends: float) -> Finding:
    coarse = at_ends <= noticeable(limit)
    return Finding(
        "between-samples",
        "warning",
        f"a perfect model breaks the limit of {limit.of} by {float(np.max(inside)):.4g} "
        + ("inside the control intervals, though both ends keep it" if coarse else f"where it is not limited (only at the {limit.at})"),
        "a shorter sampling time" if coarse else f'limit {limit.of} at both ends of every interval (at = "both")',
        {"excess": float(np.max(inside)), "excess_where_limited": float(np.max(seen)), "sampling_time_s": run.sampling_time_s},
        Evidence(
            "time (min)",
            f"{limit.of} beyond its limit",
            {"where it is limited": (run.time_s / 60, seen), "anywhere in the interval": (run.time_s / 60, inside)},
            {"limit": 0.0},
        ),
    )


def _hump(controller: Controller, j: int, finer: Model | None, run: Episode, theta: ArrayLike | None) -> NDArray[np.float64] | float:
    """By how much a limit's row inside each interval is above both of its ends, (K,), each interval from the state at its start.

    Only the hump counts: the finer model's end differs from the coarser one's by what parameters held over an interval cost.
    """
    if finer is None or run.state is None:
        return 0.0
    count, x = len(run), run.state[:-1]
    model = finer.with_parameters(**dict(model_at(controller, theta).parameters))
    p = ca.repmat(ca.DM(model.nominal), 1, count)
    follow, state = model.f.map(count), x.T
    rows = [row_values(controller, j, x, run.input, theta)]
    for _ in range(round(run.sampling_time_s / finer.sampling_time_s)):
        state = np.array(follow(state, run.input.T, p))
        rows.append(row_values(controller, j, state.T, run.input, theta, now=x))
    return np.asarray(np.max(rows, axis=0) - np.maximum(rows[0], rows[-1]), dtype=np.float64)


def _costs(controller: Controller, run: Episode, theta: ArrayLike | None) -> NDArray[np.float64]:
    """Stage costs along a closed loop and the penalty of what it violates, shape (K,)."""
    if run.state is None:
        raise ValueError("the episode has no state")
    values, count, x = controller.theta_vector(theta), len(run), run.state[1:]
    p = controller.parameters(values, controller.model.nominal)
    fixed: list[Any] = [ca.repmat(ca.DM(v), 1, count) for v in (values, p, np.array(controller.setpoint))]
    cost = np.array(controller.stage_cost.map(count)(x.T, run.input.T, *fixed, x.T)).ravel()
    for j, limit in enumerate(controller.limits):
        if limit.at != "terminal":
            beyond = _seen(controller, j, run, theta)
            cost = cost + limit.penalty * np.where(beyond > noticeable(limit), beyond, 0.0)
    return np.asarray(cost, dtype=np.float64)


def _ranges(controller: Controller) -> NDArray[np.float64]:
    problem, nu = problem_of(controller), len(controller.model.inputs)
    q = problem.prepare(controller.theta.default, controller.setpoint, controller.model.nominal)
    lower, upper = (np.array(bound).ravel()[:nu] for bound in problem.bounds(np.array(controller.start), q))
    return np.asarray(np.maximum(upper - lower, 1e-9), dtype=np.float64)


def _depends_on_input(limit: Limit) -> bool:
    return bool(limit.rows.jac_sparsity(0, 1).nnz())
