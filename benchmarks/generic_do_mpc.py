"""The systems of examples/mpc_systems.py as a user of do-mpc states them: costs, bounds and forecasts in its own words, IPOPT as it comes.

Only the discrete equations x+ = f(x, u, p) are shared, so that both see one plant. Limits are hard rows here: the closed loops keep them,
and then they have the solutions of the soft ones. Fiedler et al., do-mpc: Towards FAIR nonlinear and robust MPC, Control Engineering
Practice 140, 2023; version of the extra `bench`.
"""

import time
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np

QUIET = {"ipopt.print_level": 0, "print_time": 0, "ipopt.sb": "yes"}
# Not where IPOPT stops by itself: with its own tolerance the flat inputs of the stirred tank are 6 % of their range off.
TIGHT = QUIET | {"ipopt.tol": 1e-11, "ipopt.bound_relax_factor": 0.0}


@dataclass(frozen=True)
class Peer:
    """What do-mpc is told, as functions of x, u, next x and given. ``rows`` stay below 0; ``rates``: bounds of an input's change."""

    bounds: Mapping[str, tuple[float, float]]
    stage: Callable[..., Any]
    terminal: Callable[..., Any] = lambda _: ca.SX(0)
    change: Mapping[str, float] = field(default_factory=dict)
    rows: Callable[..., Mapping[str, Any]] = lambda _: {}
    rates: Mapping[str, float] = field(default_factory=dict)
    parameters: tuple[str, ...] = ()


def away(x):
    """What a state of the swing-up costs."""
    return 1e3 * x["place"] ** 2 + 1e3 * x["angle"] ** 2 + 0.005 * x["v"] ** 2 + 0.005 * x["w"] ** 2


def squares(values):
    """The sum of squares of a mapping's values."""
    return sum(value**2 for value in values.values())


PEERS = {
    "linear cost": Peer({"u": (0.0, 1.0)}, lambda s: -s.x["x"], rows=lambda s: {"x": s.next["x"] - 2.0}),
    "oscillating masses": Peer(
        {"u": (-0.5, 0.5)},
        lambda s: squares(s.x),
        lambda s: squares(s.x),
        {"u": 1e-4},
        lambda s: {f"{side}{name}": sign * s.next[name] - 4.0 for name in s.next for side, sign in (("least_", -1), ("most_", 1))},
    ),
    "stirred tank": Peer(
        {"feed": (5.0, 100.0), "cooling": (-8500.0, 0.0)},
        lambda s: (s.x["b"] - 0.6) ** 2,
        lambda s: (s.x["b"] - 0.6) ** 2,
        {"feed": 0.1 / 100**2, "cooling": 1e-3 / 2000**2},
        lambda s: {"reactor": s.next["reactor"] - 140.0},
        {"feed": 20.0},
    ),
    "four tanks": Peer(
        {"v1": (0.0, 6.0), "v2": (0.0, 6.0)},
        lambda s: (s.x["h1"] - s.given["h1_ref"]) ** 2 + (s.x["h2"] - s.given["h2_ref"]) ** 2,
        lambda s: (s.x["h1"] - s.given["h1_ref"]) ** 2 + (s.x["h2"] - s.given["h2_ref"]) ** 2,
        {"v1": 0.5, "v2": 0.5},
    ),
    "rotating masses": Peer(
        {"u1": (-3.0, 3.0), "u2": (-3.0, 3.0)},
        lambda s: (s.x["q2"] - s.given["angle"]) ** 2,
        lambda s: (s.x["q2"] - s.given["angle"]) ** 2,
        {"u1": 1e-2, "u2": 1e-2},
    ),
    "building": Peer(
        {"heat": (0.0, 8.0)},
        lambda s: s.given["price"] * s.u["heat"],
        change={"heat": 0.002},
        rows=lambda s: {"least": s.given["least_next"] - s.next["air"], "most": s.next["air"] - 25.0},
        rates={"heat": 2.0},
        parameters=("ambient", "sun"),
    ),
    "fed batch": Peer(
        {"feed": (0.0, 0.2)},
        lambda s: -s.x["product"],
        lambda s: -s.x["product"],
        {"feed": 1.0},
        lambda s: {"biomass": s.next["biomass"] - 3.7, "sugar": -0.01 - s.next["sugar"]},
    ),
    "swing-up": Peer(
        {"push": (-80.0, 80.0)},
        lambda s: away(s.x) + 0.1 * s.u["push"] ** 2,
        lambda s: away(s.x),
        rows=lambda s: {"left": -2.4 - s.next["place"], "right": s.next["place"] - 2.4},
    ),
}


def by_do_mpc(case):
    """(states, inputs, seconds) of the closed loop by do-mpc; None where it is not installed.

    States and inputs are those of IPOPT with tight tolerances, the seconds those of its own.
    """
    with warnings.catch_warnings():
        # It warns of parts that are not installed, and calls NumPy's functions on CasADi's values.
        warnings.simplefilter("ignore")
        try:
            import do_mpc
        except ImportError:
            return None
        _, _, seconds = closed_loop(do_mpc, case, QUIET)
        states, inputs, _ = closed_loop(do_mpc, case, TIGHT)
    return states, inputs, seconds


def closed_loop(do_mpc, case, options):
    """(states, inputs, seconds) with these options of IPOPT."""
    peer, own = PEERS[case.name], case.controller.model
    names, inputs, horizon = own.state_names, own.input_names, case.controller.horizon
    model = do_mpc.model.Model("discrete", "SX")
    told = list(case.given) + [f"{name}_next" for name in case.given]
    for kind, variables in (("_x", [*names, *(f"{name}_last" for name in peer.rates)]), ("_u", inputs), ("_tvp", told)):
        for name in variables:
            model.set_variable(kind, name)

    def symbols():
        return [{name: of[name] for name in which} for of, which in ((model.x, names), (model.u, inputs), (model.tvp, told))]

    def following(x, u, g):
        p = ca.vertcat(*(g[name] for name in peer.parameters))
        return dict(zip(names, ca.vertsplit(own.f(ca.vertcat(*x.values()), ca.vertcat(*u.values()), p)), strict=True))

    for name, value in following(*symbols()).items():
        model.set_rhs(name, value)
    for name in peer.rates:
        model.set_rhs(f"{name}_last", model.u[name])
    model.setup()
    # Its symbols are others after the set-up.
    x, u, g = symbols()
    stage = SimpleNamespace(x=x, u=u, given=g, next=following(x, u, g))
    mpc = do_mpc.controller.MPC(model)
    mpc.set_param(n_horizon=horizon, t_step=own.sampling_time_s, store_full_solution=False, nlpsol_opts=options)
    mpc.set_objective(lterm=peer.stage(stage), mterm=peer.terminal(stage))
    mpc.set_rterm(**{name: peer.change.get(name, 0.0) for name in inputs})
    for name, (lower, upper) in peer.bounds.items():
        mpc.bounds["lower", "_u", name], mpc.bounds["upper", "_u", name] = lower, upper
    for name, row in peer.rows(stage).items():
        mpc.set_nl_cons(name, row, ub=0.0)
    for name, rate in peer.rates.items():
        change = u[name] - model.x[f"{name}_last"]
        mpc.set_nl_cons(f"{name}_up", change, ub=rate)
        mpc.set_nl_cons(f"{name}_down", -change, ub=rate)
    now = {"k": 0}
    if told:
        template = mpc.get_tvp_template()
        mpc.set_tvp_fun(lambda _: forecast(template, case.given, now["k"], horizon))
    mpc.setup()
    rated = [inputs.index(name) for name in peer.rates]
    state, before = case.plant.start_state, case.plant.rest_input
    first = np.concatenate([state, before[rated]])
    mpc.x0, mpc.u0 = first, before
    mpc.set_initial_guess()
    states, applied, begin = [state], [], time.perf_counter()
    for k in range(case.steps):
        now["k"] = k
        before = mpc.make_step(np.concatenate([state, before[rated]]).reshape(-1, 1)).ravel()
        state = np.array(own.f(state, before, [case.given[name][k] for name in peer.parameters])).ravel()
        states.append(state)
        applied.append(before)
    return np.array(states), np.array(applied), time.perf_counter() - begin


def forecast(template, given, step, horizon):
    """The signals of an interval and the next ones; beyond the end of a sequence its last value."""
    for name, values in given.items():
        for i in range(horizon + 1):
            at = min(step + i, len(values) - 1)
            template["_tvp", i, name] = values[at]
            template["_tvp", i, f"{name}_next"] = values[min(at + 1, len(values) - 1)]
    return template
