"""Small systems that are no battery, for the tests of the controller."""

import casadi as ca
import numpy as np

from chargetune.control.controller import Controller, SoftLimit
from chargetune.control.estimators import ExactState
from chargetune.control.ipopt_reference import multiple_shooting
from chargetune.model.model import Model, Signal
from chargetune.model.parameter_space import Parameter, ParameterSpace
from chargetune.plants.simulated import SimulatedPlant

__all__ = ["SLOTS", "SPACE", "controller", "ipopt_solution", "linear", "model", "plant_model", "random_point"]

SPACE = ParameterSpace((Parameter("t", 0.5, 2.0, 1.0),))


def model(gain=1.0, offset=0.0):
    """A damped mass with a soft spring: position, speed; outputs position and a load with direct feedthrough."""

    def equations(x, u, p):
        position, speed = x["position"], x["speed"]
        push = p["gain"] * u["force"] - 0.5 * ca.sin(position) - 0.3 * speed
        return (
            {"position": position + 0.2 * speed, "speed": speed + 0.2 * push},
            {"load": 0.8 * u["force"] + speed**2 + p["offset"], "position": position, "speed": speed},
        )

    return Model.build(
        "mass",
        states=(Signal("position", "m"), Signal("speed", "m/s")),
        inputs=(Signal("force", "N"),),
        outputs=(Signal("load", "N"), Signal("position", "m"), Signal("speed", "m/s")),
        parameters={"gain": gain, "offset": offset},
        sampling_time_s=0.2,
        equations=equations,
    )


def plant_model():
    return model(gain=0.8, offset=0.05)


# Each slot of the control problem that theta may enter, as the arguments in which it does.
SLOTS = {
    "l": {"stage_cost": lambda s, t: (s.x["position"] - 1) ** 2 + 0.1 * t * s.u["force"] ** 2},
    "Vf": {"terminal_cost": lambda s, t: 5 * t * (s.x["position"] - 1) ** 2},
    "f": {"parameters": lambda s, t: {"gain": s.p["gain"] * t}},
    "h": {"parameters": lambda s, t: {"offset": s.p["offset"] + 0.2 * (t - 1)}},
    "X": {"speed_max": lambda s, t: 0.25 * t},
    "Y": {"load_max": lambda s, t: 0.6 * t},
    "U": {"force_max": lambda s, t: 0.9 * t},
    "E": {"position_end_max": lambda s, t: 0.3 * t},
}


def controller(slot=None, horizon=6, **changes):
    """The controller with theta in one slot (None: in none); otherwise the same numbers."""
    arguments = {
        "stage_cost": lambda s, t: (s.x["position"] - 1) ** 2 + 0.1 * s.u["force"] ** 2,
        "terminal_cost": lambda s, t: 5 * (s.x["position"] - 1) ** 2,
        "parameters": lambda s, t: {},
        "speed_max": lambda s, t: 0.25,
        "load_max": lambda s, t: 0.6,
        "force_max": lambda s, t: 0.9,
        "position_end_max": lambda s, t: 0.3 if slot == "E" else 5.0,
    }
    if slot is not None:
        arguments.update(SLOTS[slot])

    def on(name):
        return lambda s: arguments[name](s, s.theta["t"])

    settings = {
        "horizon": horizon,
        "stage_cost": on("stage_cost"),
        "terminal_cost": on("terminal_cost"),
        "parameters": on("parameters"),
        "input_lower": {"force": -0.9},
        "input_upper": {"force": on("force_max")},
        "limits": [
            SoftLimit("speed", upper=on("speed_max"), at="end", penalty=1e3, scale=0.1),
            SoftLimit("load", upper=on("load_max"), penalty=1e3, scale=0.1),
            SoftLimit("position", upper=on("position_end_max"), at="terminal", penalty=1e3, scale=0.1),
        ],
        "fallback": {"force": 0.0},
        "estimator": ExactState(),
        **changes,
    }
    return Controller.build(model(), SPACE, **settings)


def linear(nx, nu, limits, seed=0, **changes):
    """(controller, plant) of a stable linear system with dense random matrices and upper limits on its first states."""
    draw = np.random.default_rng(seed)
    a, b = draw.normal(size=(nx, nx)), draw.normal(size=(nx, nu))
    a *= 0.95 / np.max(np.abs(np.linalg.eigvals(a)))
    states, inputs = [f"x{i}" for i in range(nx)], [f"u{i}" for i in range(nu)]

    def equations(x, u, p):
        return dict(zip(states, ca.vertsplit(ca.mtimes(a, x.vector) + ca.mtimes(b, u.vector)), strict=True)), x

    signals = [Signal(name) for name in states]
    model = Model.build(
        "linear",
        states=signals,
        inputs=[Signal(name) for name in inputs],
        outputs=signals,
        parameters={},
        sampling_time_s=1.0,
        equations=equations,
    )
    settings = {
        "horizon": 30,
        "stage_cost": lambda s: ca.sumsqr(s.x.vector - 0.3) + 0.1 * s.theta["t"] * ca.sumsqr(s.u.vector),
        "terminal_cost": lambda s: 5 * ca.sumsqr(s.x.vector - 0.3),
        "input_lower": dict.fromkeys(inputs, -0.3),
        "input_upper": dict.fromkeys(inputs, 0.3),
        "limits": [SoftLimit(name, upper=0.4, penalty=1e3, scale=0.1) for name in states[:limits]],
        **changes,
    }
    return Controller.build(model, SPACE, **settings), SimulatedPlant(model, dict.fromkeys(states, 0.6))


def random_point(problem, seed=0):
    """(now, U, q, lower, upper) at a random place where rows are both kept and broken."""
    rng = np.random.default_rng(seed)
    own = problem.controller
    q = problem.prepare(own.theta.default, ca.DM(own.setpoint), own.model.nominal)
    now = problem.first(rng.normal(0, 0.4, len(own.model.states)), own.input_before)
    lower, upper = (np.array(b).ravel() for b in problem.bounds(now, q))
    return now, rng.uniform(lower, upper), q, lower, upper


def ipopt_solution(own, now, inputs):
    """(U, multipliers of the rows) by IPOPT."""
    nlp = multiple_shooting(own)
    size, nx, limits = inputs.size, len(own.model.states), len(own.limits)
    rest = own.horizon * nx
    found = nlp.solver(
        x0=np.concatenate([inputs, np.tile(now, own.horizon), np.zeros(limits)]),
        p=np.concatenate([now, own.theta.default, own.setpoint, own.model.nominal, own.input_before]),
        lbx=np.concatenate([np.full(size, -0.9), np.full(rest, -np.inf), np.zeros(limits)]),
        ubx=np.concatenate([np.full(size, 0.9), np.full(rest + limits, np.inf)]),
        lbg=np.concatenate([np.zeros(rest), np.full(nlp.inequalities, -np.inf)]),
        ubg=0.0,
    )
    assert nlp.solver.stats()["success"]
    return np.array(found["x"]).ravel()[:size], np.array(found["lam_g"]).ravel()[rest:]
