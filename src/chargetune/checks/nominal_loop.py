"""What can be seen to be wrong with a controller only by running it: on a plant that is its own model."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from chargetune.checks.estimator import check_detectability
from chargetune.checks.finding import Evidence, Finding
from chargetune.checks.influence import check_influence
from chargetune.checks.solves import check_costs, check_solves
from chargetune.checks.static import amount, beyond_axis, check_horizon, check_signs, check_start, model_at, noticeable, row_values, unit_of
from chargetune.control.controller import Controller, LimitRows
from chargetune.episode.compiled import simulate
from chargetune.episode.episode import Episode
from chargetune.model.given import Given, checked_given, windows
from chargetune.model.model import Model
from chargetune.plants.simulated import SimulatedPlant
from chargetune.runtime.counted import counted

__all__ = ["check_formulation", "check_limits", "check_longer_horizon", "perfect_plant"]

# Penalties are tried at these multiples to see which would be exact.
STRICTER = (10.0, 100.0, 1000.0)
# A longer horizon is worth speaking of when it lowers the closed-loop cost by this share.
WORTH = 0.05
HORIZON_MAX = 50


def perfect_plant(controller: Controller, theta: ArrayLike | None = None) -> SimulatedPlant:
    """The plant of which the controller at theta knows everything: its own model from its own start, under the same given signals."""
    start = dict(zip(controller.model.state_names, controller.start, strict=True))
    before = dict(zip(controller.model.input_names, controller.input_before, strict=True))
    if not controller.parameters.jac_sparsity(0, 2).nnz():
        return SimulatedPlant(model_at(controller, theta), start, input_before=before)
    model, values = controller.model, controller.theta_vector(theta)
    x, u, signals = (ca.SX.sym(n, k) for n, k in (("x", len(model.states)), ("u", len(model.inputs)), ("given", len(controller.given))))
    p = controller.parameters(values, model.nominal, signals)
    functions = (ca.Function(name, [x, u, signals], [of(x, u, p)]) for name, of in (("f", model.f), ("h", model.h)))
    names = controller.given_names
    follower = Model(
        f"{model.name} under {', '.join(names)}",
        model.states,
        model.inputs,
        model.outputs,
        tuple((name, (0.0,)) for name in names),
        model.sampling_time_s,
        *functions,
    )
    return SimulatedPlant(follower, start, input_before=before, given=names)


def check_formulation(
    controller: Controller,
    *,
    steps: int,
    plant: SimulatedPlant | None = None,
    signs: Mapping[tuple[str, str], int] | None = None,
    finer: Model | None = None,
    quick: bool = False,
    given: Given | None = None,
    along: str | None = None,
) -> tuple[Finding, ...]:
    """All checks of a controller that need no verdict on an episode; an unsafe start is told alone.

    ``plant`` is what the influence of theta is looked for on, by default a perfect model of the untuned controller.
    ``signs``: see `check_signs`; ``finer`` is the model with a shorter sampling time, for limits between samples.
    ``quick`` leaves out what builds other solvers when nothing is suspicious: longer horizons. ``given``: the given signals of
    the controller and the plants. ``along``: a state that tells the place in an episode, beside the time.
    """
    names = tuple(dict.fromkeys((*controller.given_names, *(plant.given if plant else ()))))
    # What is checked is the formulation: with forecasts that are right.
    given = {n: v if v.ndim == 1 else v[:, 0] for n, v in checked_given(names, given, steps, controller.horizon).items()}
    first = _signals(controller, given, steps)[0][0]
    found = list(check_start(controller, given=first))
    if found:
        # From there every closed loop breaks the limit, whatever else is right or wrong.
        return tuple(found)
    perfect = perfect_plant(controller)
    own = {name: given[name] for name in controller.given_names}
    run = simulate(controller, perfect, steps=steps, given=own)
    found += check_costs(controller)
    if run.state is not None and len(run):
        found += check_solves(run)
        found += check_detectability(controller, run, _signals(controller, given, len(run))[0], along)
        found += check_signs(controller, signs or {}, run.state, run.input, given=first)
        found += check_horizon(controller, run.state, run.input, given=first)
        found += check_limits(controller, run, finer=finer, given=own)
        if not quick and all(f.code != "short-horizon" for f in found):
            found += check_longer_horizon(controller, run, given=own)
    if controller.theta.dimension:
        on, told = (plant, given) if plant else (perfect, own)
        found += check_influence(lambda theta: simulate(controller, on, steps=steps, theta=theta, given=told).input, controller, first)
    return tuple(found)


def check_limits(
    controller: Controller, run: Episode, *, finer: Model | None = None, theta: ArrayLike | None = None, given: Given | None = None
) -> list[Finding]:
    """Limits that are broken although the model is perfect; ``run`` is the closed loop on `perfect_plant`.

    Broken where the controller limits them: the penalty is inexact, or nothing can keep them. Kept there and broken at
    the other end of an interval, or inside it by ``finer``: between samples.
    """
    if run.state is None:
        raise ValueError("the episode has no state: a perfect model is a simulation")
    out: list[Finding] = []
    for j, limit in enumerate(controller.limits):
        if limit.at == "terminal":
            continue
        ends = {"start": _rows_along(controller, j, run, theta, given), "end": _rows_along(controller, j, run, theta, given, after=True)}
        if limit.at == "end" and not _depends_on_input(limit):
            # A state at the start of an interval is the same as at the end of the one before.
            ends["start"] = ends["end"]
        seen = np.max([ends[name] for name in ("start", "end") if limit.at in (name, "both")], axis=0)
        if np.isnan(seen).any():
            out.append(_not_known(controller, limit, run, seen))
            continue
        inside = np.maximum(ends["start"], ends["end"]) + _hump(controller, j, finer, run, theta, given)
        if np.max(seen) > noticeable(limit):
            out += _broken_where_seen(controller, j, run, seen, theta, given)
        elif np.max(inside) > noticeable(limit):
            at_ends = max(float(np.max(values)) for values in ends.values())
            out.append(_between(controller, limit, run, seen, inside, at_ends=at_ends))
    return out


def check_longer_horizon(controller: Controller, run: Episode, theta: ArrayLike | None = None, given: Given | None = None) -> list[Finding]:
    """A horizon so short that the perfect model does clearly better, or keeps a limit, with a longer one."""
    longer = max(controller.horizon, min(HORIZON_MAX, max(4 * controller.horizon, 20)))
    if longer == controller.horizon:
        return []
    seeing = replace(controller, horizon=longer, blocks=())
    far = simulate(seeing, perfect_plant(controller, theta), steps=len(run), theta=theta, compiled=False, given=given)
    near_cost, far_cost = _costs(controller, run, theta, given), _costs(controller, far, theta, given)
    near, better = float(np.sum(near_cost)), float(np.sum(far_cost))
    if len(far) < len(run) or not better < near - WORTH * abs(near):
        return []
    minutes = run.time_s / 60
    return [
        Finding(
            "short-horizon",
            "warning",
            f"with a horizon of {counted(longer, 'interval')} instead of {controller.horizon} the closed loop on a perfect model costs "
            f"{100 * (1 - better / near):.0f} % less: this one is too short to see what it is for",
            f"a horizon of {counted(longer, 'interval')}, or a terminal cost that stands for what comes later",
            {"horizon_intervals": float(controller.horizon), "cost": near, "longer_intervals": float(longer), "cost_longer": better},
            Evidence(
                "time (min)",
                "stage cost, summed",
                {f"N = {controller.horizon}": (minutes, np.cumsum(near_cost)), f"N = {longer}": (minutes, np.cumsum(far_cost))},
            ),
        )
    ]


def _broken_where_seen(
    controller: Controller, j: int, run: Episode, seen: NDArray[np.float64], theta: ArrayLike | None, given: Given | None
) -> list[Finding]:
    """What it means that the limit is broken where the controller sees it: whether a larger penalty would have kept it."""
    limit, worst = controller.limits[j], float(np.max(seen))
    minutes, name = run.time_s / 60, beyond_axis(controller, limit)
    broken, unit = amount(controller, limit.of, worst), unit_of(controller, limit.of)

    def with_penalty(factor: float) -> NDArray[np.float64]:
        limits = tuple(replace(part, penalty=part.penalty * factor) if k == j else part for k, part in enumerate(controller.limits))
        strict = replace(controller, limits=limits)
        episode = simulate(strict, perfect_plant(strict, theta), steps=len(run), theta=theta, compiled=False, given=given)
        return _seen(controller, j, episode, theta, given)

    if np.max(with_penalty(STRICTER[-1])) <= noticeable(limit):
        factor, kept = next((f, rows) for f in STRICTER if np.max(rows := with_penalty(f)) <= noticeable(limit))
        return [
            Finding(
                "inexact-penalty",
                "error",
                f"the penalty of {limit.of} is not exact: a perfect model breaks the limit by {broken}, "
                f"with {factor:g} times the penalty it does not",
                f"a penalty of {limit.of} of at least {factor * limit.penalty:g}{f' per {unit}' if unit else ''} (it is {limit.penalty:g})",
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
            f"a perfect model breaks the limit of {limit.of} by {broken}, also with {STRICTER[-1]:g} times the penalty",
            "a longer horizon, an input range that can keep it, or another start",
            {"excess": worst, "penalty": limit.penalty},
            Evidence("time (min)", name, {"closed loop": (minutes, seen)}, {"limit": 0.0}),
        )
    ]


def _seen(controller: Controller, j: int, run: Episode, theta: ArrayLike | None, given: Given | None) -> NDArray[np.float64]:
    at = controller.limits[j].at
    rows = [_rows_along(controller, j, run, theta, given, after=name == "end") for name in ("start", "end") if at in (name, "both")]
    return np.asarray(np.max(rows, axis=0), dtype=np.float64)


def _rows_along(
    controller: Controller, j: int, run: Episode, theta: ArrayLike | None, given: Given | None, *, after: bool = False
) -> NDArray[np.float64]:
    """The largest row of a limit at the start, or ``after`` at the end, of every interval of an episode, shape (K,)."""
    if run.state is None:
        raise ValueError("the episode has no state")
    x, ahead = run.state[:-1], run.state[1:]
    now, then = _signals(controller, given, len(run))
    told = {"now": x, "last": _before(controller, run), "given": now, "bounds": then if after else now}
    return row_values(controller, j, ahead if after else x, run.input, theta, **told)


def _before(controller: Controller, run: Episode) -> NDArray[np.float64]:
    """The input before each interval, shape (K, nu)."""
    return np.vstack([controller.input_before, run.input[:-1]])


def _signals(controller: Controller, given: Given | None, count: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The controller's given signals in each interval and in the one after it, shapes (K, signals)."""
    told = {name: value for name, value in (given or {}).items() if name in controller.given_names}
    values = checked_given(controller.given_names, told, count, controller.horizon)
    seen = windows([values[name] for name in controller.given_names], count, controller.horizon)
    _, now, then, *_ = np.moveaxis(seen.reshape(count, controller.horizon + 2, -1), 1, 0)
    return now, then


def _not_known(controller: Controller, limit: LimitRows, run: Episode, seen: NDArray[np.float64]) -> Finding:
    lost = np.isnan(seen)
    return Finding(
        "limit-not-kept",
        "warning",
        f"{limit.of} or its bound is no number in {np.sum(lost)} of {counted(len(run), 'interval')} of a perfect model, first after "
        f"{run.time_s[np.argmax(lost)] / 60:.3g} min: a limit that is not known is not kept",
        f"an expression of {limit.of} and of its bound that is defined wherever the model goes",
        {"intervals": float(np.sum(lost)), "first_min": float(run.time_s[np.argmax(lost)] / 60)},
        Evidence("time (min)", beyond_axis(controller, limit), {"closed loop": (run.time_s / 60, seen)}, {"limit": 0.0}),
    )


def _between(
    controller: Controller, limit: LimitRows, run: Episode, seen: NDArray[np.float64], inside: NDArray[np.float64], *, at_ends: float
) -> Finding:
    coarse = at_ends <= noticeable(limit)
    return Finding(
        "between-samples",
        "warning",
        f"a perfect model breaks the limit of {limit.of} by {amount(controller, limit.of, float(np.max(inside)))} "
        + ("inside the control intervals, though both ends keep it" if coarse else f"where it is not limited (only at the {limit.at})"),
        "a shorter sampling time" if coarse else f'limit {limit.of} at both ends of every interval (at = "both")',
        {"excess": float(np.max(inside)), "excess_where_limited": float(np.max(seen)), "sampling_time_s": run.sampling_time_s},
        Evidence(
            "time (min)",
            beyond_axis(controller, limit),
            {"where it is limited": (run.time_s / 60, seen), "anywhere in the interval": (run.time_s / 60, inside)},
            {"limit": 0.0},
        ),
    )


def _hump(
    controller: Controller, j: int, finer: Model | None, run: Episode, theta: ArrayLike | None, given: Given | None
) -> NDArray[np.float64] | float:
    """By how much a limit's row inside each interval is above both of its ends, (K,), each interval from the state at its start.

    Only the hump counts: the finer model's end differs from the coarser one's by what parameters held over an interval cost.
    """
    if finer is None or run.state is None:
        return 0.0
    if controller.parameters.jac_sparsity(0, 2).nnz():
        raise ValueError("finer: a model is given, allowed is none where a given signal changes the model's parameters")
    count, x = len(run), run.state[:-1]
    model = finer.with_parameters(**dict(model_at(controller, theta).parameters))
    p = ca.repmat(ca.DM(model.nominal), 1, count)
    follow, state = model.f.map(count), x.T
    now, then = _signals(controller, given, count)
    before = _before(controller, run)
    rows = [row_values(controller, j, x, run.input, theta, last=before, given=now)]
    for _ in range(round(run.sampling_time_s / finer.sampling_time_s)):
        state = np.array(follow(state, run.input.T, p))
        rows.append(row_values(controller, j, state.T, run.input, theta, now=x, last=before, given=now, bounds=then))
    return np.asarray(np.max(rows, axis=0) - np.maximum(rows[0], rows[-1]), dtype=np.float64)


def _costs(controller: Controller, run: Episode, theta: ArrayLike | None, given: Given | None) -> NDArray[np.float64]:
    """l(x_k, u_k) of every interval of a closed loop, with x_k as ``now``, and the penalty of what it violates there, shape (K,).

    That is what the solve at k takes for its first interval.
    """
    if run.state is None:
        raise ValueError("the episode has no state")
    values, count, x = controller.theta_vector(theta), len(run), run.state[:-1]
    signals = _signals(controller, given, count)[0].T
    fixed, nominal, wanted = (ca.repmat(ca.DM(v), 1, count) for v in (values, controller.model.nominal, np.array(controller.setpoint)))
    p = controller.parameters.map(count)(fixed, nominal, signals)
    along = (x.T, run.input.T, fixed, p, wanted, x.T, _before(controller, run).T, signals)
    cost = np.array(controller.stage_cost.map(count)(*along)).ravel()
    for j, limit in enumerate(controller.limits):
        if limit.at != "terminal":
            beyond = _seen(controller, j, run, theta, given)
            cost = cost + limit.penalty * np.where(beyond > noticeable(limit), beyond, 0.0)
    return np.asarray(cost, dtype=np.float64)


def _depends_on_input(limit: LimitRows) -> bool:
    return bool(limit.rows.jac_sparsity(0, 1).nnz())
