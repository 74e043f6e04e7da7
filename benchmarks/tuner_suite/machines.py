"""A cart with a pole, and the charge of a cell."""

from __future__ import annotations

import casadi as ca
import numpy as np
from learning_plants import exact, make_problem
from mpc_systems import measured
from tuner_suite.plant import SuitePlant, believed, drawn, factors, simulated_plant

import chargetune as ct
from chargetune.battery.charging.evaluate import evaluate, run_charge
from chargetune.battery.charging.soc_windows import ChargingWindows
from chargetune.battery.charging.twin_loop import ChargingTwin
from chargetune.battery.charging.verdict import score_episode

__all__ = ["cart_pole", "charge"]


def cart_pole(seed: int) -> SuitePlant:
    """The cart moves 1 m and its pole must not lean more than 0.12 rad; it has friction, of which nobody knows."""

    def rate(x, u, p):
        bob, mass, g = 0.1, p["mass"], 9.81
        sin, cos = ca.sin(x["angle"]), ca.cos(x["angle"])
        den, swing = mass - bob * cos**2, bob * p["length"] * sin * x["w"] ** 2
        push = u["push"] - p["friction"] * x["v"]
        turn = (-swing * cos + push * cos + mass * g * sin) / (p["length"] * den)
        return x["v"], x["w"], (-swing + bob * g * cos * sin + push) / den, turn

    nominal = {"mass": 1.1, "length": 0.8, "friction": 0.0}
    model = measured("cart and pole", "place angle v w", "push", rate, 0.08, substeps=2, **nominal)
    spread = {"mass": 0.4, "length": 0.4}
    own = drawn("cart", seed, **spread, friction=0.5)
    start = {"place": -1.0}
    space = ct.ParameterSpace(
        (*factors("mass", "length", most=1.6), ct.Parameter("backoff_rad", 0.0, 0.08, default=0.0, unit="rad"),
         ct.Parameter("push_weight", 1e-4, 1.0, default=3e-2, scale="log"))
    )  # fmt: skip
    controller = ct.Controller.build(
        model,
        space,
        horizon=14,
        parameters=believed(model, "mass", "length"),
        stage_cost=lambda s: s.x["place"] ** 2 + s.x["angle"] ** 2 + 0.01 * s.x["v"] ** 2 + s.theta["push_weight"] * s.u["push"] ** 2,
        terminal_cost=lambda s: 20 * (s.x["place"] ** 2 + s.x["angle"] ** 2 + s.x["v"] ** 2 + s.x["w"] ** 2),
        input_lower={"push": -20.0},
        input_upper={"push": 20.0},
        fallback={"push": 0.0},
        limits=[
            ct.SoftLimit(
                "angle", lower=lambda s: -0.12 + s.theta["backoff_rad"], upper=lambda s: 0.12 - s.theta["backoff_rad"],
                at="end", penalty=1e2, scale=0.1,
            )
        ],
        start=start,
    )  # fmt: skip
    return simulated_plant(
        "cart-pole",
        "Barto, Sutton and Anderson, IEEE Trans. Systems, Man and Cybernetics 13 (1983) 834; numbers of the examples of leap-c",
        controller=controller,
        truth=model.with_parameters(mass=1.1 * own["mass"], length=0.8 * own["length"], friction=0.8 * own["friction"]),
        start=start,
        noise_sd={"place": 1e-3, "angle": 5e-4, "v": 2e-3, "w": 2e-3},
        limits=[ct.ScoredLimit("angle", lower=-0.12, upper=0.12, tolerance=2e-3)],
        objective=lambda e: -0.08 * float(np.sum(np.abs(e.signal("place")[1]))),
        steps=40,
        safe_theta=(1.0, 1.0, 0.08, 3e-2),
        unknowns=[ct.Uncertain(k, sd=s / 2) for k, s in spread.items()],
    )


def charge(seed: int) -> SuitePlant:
    """A charge to 95 % in the least time below 4.2 V; theta are nine resistances of the controller's model, wrong by up to a half."""
    problem = make_problem("ecm", "r0", seed, 2e-3)
    known = exact(problem)
    return SuitePlant(
        name="charge",
        source="the case study of this package (docs/how-it-works.md)",
        space=problem.space,
        evaluate=lambda theta, noise: ct.Evaluation(*evaluate(problem, theta, noise)),
        judge=lambda theta: score_episode(known, run_charge(known, theta)),
        safe_theta=tuple(float(v) for v in problem.space.upper),
        twin=ChargingTwin(problem),
        windows=ChargingWindows(problem),
    )
