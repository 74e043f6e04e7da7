"""What can be seen to be wrong with a controller only by running it: on a plant that is its own model."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from chargetune.checks.finding import Evidence, Finding
from chargetune.checks.influence import check_influence
from chargetune.checks.static import check_horizon, check_signs, check_start, model_at, noticeable, row_values
from chargetune.control.controller import Controller, LimitRows
from chargetune.episode.compiled import simulate
from chargetune.episode.episode import Episode
from chargetune.model.model import Model
from chargetune.plants.simulated import SimulatedPlant

__all__ = ["check_formulation", "check_limits", "check_longer_horizon", "perfect_plant"]

# Penalties are tried at these multiples to see which would be exact.
STRICTER = (10.0, 100.0, 1000.0)
# A longer horizon is worth speaking of when it lowers the closed-loop cost by this share.
WORTH = 0.05
HORIZON_MAX = 50


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
    """All checks of a controller that need no verdict on an episode; an unsafe start is told alone.

    ``plant`` is what the influence of theta is looked for on, by default a perfect model of the untuned controller.
    ``signs``: see `check_signs`; ``finer`` is the model with a shorter sampling time, for limits between samples.
    ``quick`` leaves out what builds other solvers when nothing is suspicious: longer horizons.
    """
    found = list(check_start(controller))
    if found:
        # From there every closed loop breaks the limit, whatever else is right or wrong.
        return tuple(found)
    perfect = perfect_plant(controller)
    run = simulate(controller, perfect, steps=steps)
    if run.state is not None and len(run):
        found += check_signs(controller, signs or {}, run.state, run.input)
        found += check_horizon(controller, run.state, run.input)
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
    longer = max(controller.horizon, min(HORIZON_MAX, max(4 * controller.horizon, 20)))
    if longer == controller.horizon:
        return []
    longer_controller = replace(controller, horizon=longer, blocks=())
    far = simulate(longer_controller, perfect_plant(controller, theta), steps=len(run), theta=theta, compiled=False)
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


def _broken_where_seen(controller: Controller, j: int, run: Episode, seen: NDArray[np.float64], theta: ArrayLike | None) -> list[Finding]:
    """What it means that the limit is broken where the controller sees it: whether a larger penalty would have kept it."""
    limit, worst = controller.limits[j], float(np.max(seen))
    minutes, name = run.time_s / 60, f"{limit.of} beyond its limit"

    def with_penalty(factor: float) -> NDArray[np.float64]:
        limits = tuple(replace(part, penalty=part.penalty * factor) if k == j else part for k, part in enumerate(controller.limits))
        strict = replace(controller, limits=limits)
        return _seen(controller, j, simulate(strict, perfect_plant(strict, theta), steps=len(run), theta=theta, compiled=False), theta)

    if np.max(with_penalty(STRICTER[-1])) <= noticeable(limit):
        factor, kept = next((f, rows) for f in STRICTER if np.max(rows := with_penalty(f)) <= noticeable(limit))
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


def _between(limit: LimitRows, run: Episode, seen: NDArray[np.float64], inside: NDArray[np.float64], *, at_ends: float) -> Finding:
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
    """l(x_k, u_k) of every interval of a closed loop, with x_k as ``now``, and the penalty of what it violates there, shape (K,).

    That is what the solve at k takes for its first interval.
    """
    if run.state is None:
        raise ValueError("the episode has no state")
    values, count, x = controller.theta_vector(theta), len(run), run.state[:-1]
    p = controller.parameters(values, controller.model.nominal)
    fixed: list[Any] = [ca.repmat(ca.DM(v), 1, count) for v in (values, p, np.array(controller.setpoint))]
    cost = np.array(controller.stage_cost.map(count)(x.T, run.input.T, *fixed, x.T)).ravel()
    for j, limit in enumerate(controller.limits):
        if limit.at != "terminal":
            beyond = _seen(controller, j, run, theta)
            cost = cost + limit.penalty * np.where(beyond > noticeable(limit), beyond, 0.0)
    return np.asarray(cost, dtype=np.float64)


def _depends_on_input(limit: LimitRows) -> bool:
    return bool(limit.rows.jac_sparsity(0, 1).nnz())
