"""Systems of the literature as controllers, from their published equations: previews, rates, economic costs, a swing-up.

Each function answers a `Case`: what `run_episode` and `simulate` need. `benchmarks/generic.py` compares each with IPOPT on the same
expressions; this file, run as a script, prints one line a system.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import casadi as ca
import numpy as np

from chargetune import Controller, Model, ParameterSpace, Signal, SimulatedPlant, SoftLimit, rk4, run_episode

NONE = ParameterSpace(())


@dataclass(frozen=True)
class Case:
    """One closed loop. ``tolerance``: what inputs may differ by from those of IPOPT, as a share of their bounds' distance."""

    name: str
    controller: Controller
    plant: SimulatedPlant
    steps: int
    tolerance: float = 1e-3
    given: Mapping[str, np.ndarray] = field(default_factory=dict)


def signals(names):
    return tuple(Signal(name) for name in names.split())


def measured(name, states, inputs, rate, sampling_time_s, substeps=1, **parameters):
    """A continuous model dx/dt = rate(x, u, p) of which every state is measured."""

    def equations(x, u, p):
        def of_vector(vector):
            return ca.vertcat(*rate(dict(zip(states.split(), ca.vertsplit(vector), strict=True)), u, p))

        after = rk4(of_vector, x.vector, sampling_time_s, substeps)
        return dict(zip(states.split(), ca.vertsplit(after), strict=True)), {name: x[name] for name in states.split()}

    return Model.build(
        name,
        states=signals(states),
        inputs=signals(inputs),
        outputs=signals(states),
        parameters=parameters,
        sampling_time_s=sampling_time_s,
        equations=equations,
    )


def linear_cost(steps=8):
    """x+ = 0.9 x + u, l = -x, x <= 2: a linear program, 1, 1, 0.29, 0.2, .."""
    model = Model.build(
        "line",
        states=signals("x"),
        inputs=signals("u"),
        outputs=signals("x"),
        parameters={},
        sampling_time_s=1.0,
        equations=lambda x, u, _: ({"x": 0.9 * x["x"] + u["u"]}, {"x": x["x"]}),
    )
    own = Controller.build(
        model,
        NONE,
        horizon=6,
        stage_cost=lambda s: -s.x["x"],
        input_lower={"u": 0.0},
        input_upper={"u": 1.0},
        limits=[SoftLimit("x", upper=2.0, at="end")],
    )
    return Case("linear cost", own, SimulatedPlant(model, {}), steps, 1e-6)


def oscillating_masses(steps=40):
    """Two masses on springs, as discretised in the examples of do-mpc (Fiedler et al., 2023)."""
    a = ca.DM([[0.763, 0.460, 0.115, 0.020], [-0.899, 0.763, 0.420, 0.115], [0.115, 0.020, 0.763, 0.460], [0.420, 0.115, -0.899, 0.763]])
    b = ca.DM([0.014, 0.063, 0.221, 0.367])
    names = "p1 v1 p2 v2"

    def equations(x, u, _):
        after = ca.mtimes(a, x.vector) + b * u["u"]
        return dict(zip(names.split(), ca.vertsplit(after), strict=True)), {name: x[name] for name in names.split()}

    model = Model.build(
        "masses",
        states=signals(names),
        inputs=signals("u"),
        outputs=signals(names),
        parameters={},
        sampling_time_s=0.5,
        equations=equations,
    )
    own = Controller.build(
        model,
        NONE,
        horizon=7,
        stage_cost=lambda s: ca.sumsqr(s.x.vector) + 1e-4 * (s.u["u"] - s.u_last["u"]) ** 2,
        terminal_cost=lambda s: ca.sumsqr(s.x.vector),
        input_lower={"u": -0.5},
        input_upper={"u": 0.5},
        limits=[SoftLimit(name, lower=-4.0, upper=4.0, at="end") for name in names.split()],
        fallback={"u": 0.0},
    )
    return Case("oscillating masses", own, SimulatedPlant(model, {"p1": 2.0, "v1": 1.0, "p2": -1.5, "v2": 0.5}), steps, 1e-3)


def stirred_tank(steps=40):
    """The stirred tank reactor of Klatt and Engell (1998) as in the examples of do-mpc; costs on the change of both inputs."""

    def rate(x, u, _):
        kelvin = x["reactor"] + 273.15
        k1 = k2 = 1.287e12 * ca.exp(-9758.3 / kelvin)
        k3 = 9.043e9 * ca.exp(-8560.0 / kelvin)
        feed, warmer = u["feed"], x["reactor"] - x["jacket"]
        heat = 4.2 * k1 * x["a"] - 11.0 * k2 * x["b"] - 41.85 * k3 * x["a"] ** 2
        return (
            feed * (5.1 - x["a"]) - k1 * x["a"] - k3 * x["a"] ** 2,
            -feed * x["b"] + k1 * x["a"] - k2 * x["b"],
            -heat / (0.9342 * 3.01) + feed * (130.0 - x["reactor"]) - 4032.0 * 0.215 * warmer / (0.9342 * 3.01 * 10.01),
            (u["cooling"] + 4032.0 * 0.215 * warmer) / (5.0 * 2.0),
        )

    model = measured("stirred tank", "a b reactor jacket", "feed cooling", rate, 0.005, substeps=2)
    own = Controller.build(
        model,
        NONE,
        horizon=20,
        stage_cost=lambda s: (
            (s.x["b"] - 0.6) ** 2
            + 0.1 * ((s.u["feed"] - s.u_last["feed"]) / 100) ** 2
            + 1e-3 * ((s.u["cooling"] - s.u_last["cooling"]) / 2000) ** 2
        ),
        terminal_cost=lambda s: (s.x["b"] - 0.6) ** 2,
        input_lower={"feed": 5.0, "cooling": -8500.0},
        input_upper={"feed": 100.0, "cooling": 0.0},
        input_rate={"feed": 20.0},
        input_before={"feed": 20.0, "cooling": -2000.0},
        fallback={"feed": 20.0, "cooling": -2000.0},
        limits=[SoftLimit("reactor", upper=140.0, at="end", penalty=1.0, scale=1.0)],
        start={"a": 0.8, "b": 0.5, "reactor": 134.14, "jacket": 130.0},
    )
    start = {"a": 0.8, "b": 0.5, "reactor": 134.14, "jacket": 130.0}
    before = {"feed": 20.0, "cooling": -2000.0}
    return Case("stirred tank", own, SimulatedPlant(model, start, input_before=before), steps, 2e-2)


def four_tanks(steps=60):
    """The quadruple tank of Johansson (2000), minimum phase; the set-points of the lower tanks change and are seen ahead."""

    def rate(x, u, _):
        def out(area, level):
            return area * ca.sqrt(2 * 981.0 * ca.fmax(level, 1e-6))

        flow = {name: out(area, x[name]) for name, area in (("h1", 0.071), ("h2", 0.057), ("h3", 0.071), ("h4", 0.057))}
        one, two = 3.33 * u["v1"], 3.35 * u["v2"]
        return (
            (flow["h3"] - flow["h1"] + 0.7 * one) / 28,
            (flow["h4"] - flow["h2"] + 0.6 * two) / 32,
            (0.4 * two - flow["h3"]) / 28,
            (0.3 * one - flow["h4"]) / 32,
        )

    model = measured("four tanks", "h1 h2 h3 h4", "v1 v2", rate, 10.0)
    own = Controller.build(
        model,
        NONE,
        horizon=15,
        stage_cost=lambda s: (
            (s.x["h1"] - s.given["h1_ref"]) ** 2 + (s.x["h2"] - s.given["h2_ref"]) ** 2 + 0.5 * ca.sumsqr(s.u.vector - s.u_last.vector)
        ),
        terminal_cost=lambda s: (s.x["h1"] - s.given["h1_ref"]) ** 2 + (s.x["h2"] - s.given["h2_ref"]) ** 2,
        input_lower={"v1": 0.0, "v2": 0.0},
        input_upper={"v1": 6.0, "v2": 6.0},
        input_before={"v1": 3.0, "v2": 3.0},
        given=signals("h1_ref h2_ref"),
    )
    k = np.arange(steps)
    given = {"h1_ref": np.where(k < 20, 12.0, np.where(k < 40, 16.0, 10.0)), "h2_ref": np.where(k < 30, 13.0, 11.0)}
    start = {"h1": 12.4, "h2": 12.7, "h3": 1.8, "h4": 1.4}
    return Case("four tanks", own, SimulatedPlant(model, start, input_before={"v1": 3.0, "v2": 3.0}), steps, 1e-3, given)


def rotating_masses(steps=40, horizon=20):
    """Three discs between two motors, as in the examples of do-mpc; the middle one follows a set-point that is seen ahead."""

    def rate(x, u, _):
        c, d, inertia = (2.697e-3, 2.66e-3, 3.05e-3, 2.86e-3), (6.78e-5, 8.01e-5, 8.82e-5), 2.25e-4
        at = (x["m1"], x["q1"], x["q2"], x["q3"], x["m2"])
        turns = [(c[i] * (at[i] - at[i + 1]) + c[i + 1] * (at[i + 2] - at[i + 1]) - d[i] * x[f"w{i + 1}"]) / inertia for i in range(3)]
        return (x["w1"], x["w2"], x["w3"], *turns, (u["u1"] - x["m1"]) / 0.05, (u["u2"] - x["m2"]) / 0.05)

    model = measured("rotating masses", "q1 q2 q3 w1 w2 w3 m1 m2", "u1 u2", rate, 0.1, substeps=2)
    own = Controller.build(
        model,
        NONE,
        horizon=horizon,
        stage_cost=lambda s: (s.x["q2"] - s.given["angle"]) ** 2 + 1e-2 * ca.sumsqr(s.u.vector - s.u_last.vector),
        terminal_cost=lambda s: (s.x["q2"] - s.given["angle"]) ** 2,
        input_lower={"u1": -3.0, "u2": -3.0},
        input_upper={"u1": 3.0, "u2": 3.0},
        fallback={"u1": 0.0, "u2": 0.0},
        given=signals("angle"),
    )
    given = {"angle": np.where(np.arange(steps + horizon) < 15, 0.0, 1.0)}
    return Case("rotating masses", own, SimulatedPlant(model, {"q1": 0.5, "q3": -0.5}), steps, 1e-3, given)


def building(steps=96, horizon=48):
    """Air, walls and floor heating under prices, weather and a night set-back, every 15 min; what it costs is linear in the heat."""

    def rate(x, u, p):
        # kW, kWh/K and h; air, walls, floor.
        return (
            (0.1 * (p["ambient"] - x["air"]) + 0.8 * (x["walls"] - x["air"]) + 1.0 * (x["floor"] - x["air"]) + 0.3 * p["sun"]) / 1.0,
            (0.8 * (x["air"] - x["walls"]) + 0.05 * (p["ambient"] - x["walls"])) / 8.0,
            (1.0 * (x["air"] - x["floor"]) + u["heat"]) / 3.0,
        )

    model = measured("building", "air walls floor", "heat", rate, 0.25, ambient=0.0, sun=0.0)
    own = Controller.build(
        model,
        NONE,
        horizon=horizon,
        stage_cost=lambda s: s.given["price"] * s.u["heat"] + 0.002 * (s.u["heat"] - s.u_last["heat"]) ** 2,
        parameters=lambda s: {name: s.given[name] for name in ("ambient", "sun")},
        input_lower={"heat": 0.0},
        input_upper={"heat": 8.0},
        input_rate={"heat": 2.0},
        limits=[SoftLimit("air", lower=lambda s: s.given["least"], upper=25.0, at="end", penalty=50.0, scale=0.1)],
        start={"air": 20.0, "walls": 19.0, "floor": 22.0},
        given=signals("price ambient sun least"),
    )
    hour = 0.25 * np.arange(steps + horizon)
    day = hour % 24
    given = {
        "price": 0.25 + 0.1 * np.sin(2 * np.pi * (day - 6) / 12),
        "ambient": 2.0 + 5.0 * np.sin(2 * np.pi * (day - 9) / 24),
        "sun": np.maximum(0.0, np.sin(np.pi * (day - 7) / 11)) * ((day > 7) & (day < 18)),
        "least": np.where((day < 6) | (day > 22), 17.0, 20.0),
    }
    plant = SimulatedPlant(model, {"air": 20.0, "walls": 19.0, "floor": 22.0}, given=("ambient", "sun"))
    return Case("building", own, plant, steps, 2e-2, given)


def fed_batch(steps=60):
    """The fed-batch reactor of Srinivasan et al. (2003) as in the examples of do-mpc: as much product as the biomass allows."""

    def rate(x, u, _):
        growth = 0.02 * x["sugar"] / (0.05 + x["sugar"] + x["sugar"] ** 2 / 5.0)
        thinner = u["feed"] / x["volume"]
        return (
            growth * x["biomass"] - thinner * x["biomass"],
            -growth * x["biomass"] / 0.4 - 0.004 * x["biomass"] / 1.2 + thinner * (200.0 - x["sugar"]),
            0.004 * x["biomass"] - thinner * x["product"],
            u["feed"],
        )

    model = measured("fed batch", "biomass sugar product volume", "feed", rate, 1.0, substeps=4)
    start = {"biomass": 1.0, "sugar": 0.5, "product": 0.0, "volume": 120.0}
    own = Controller.build(
        model,
        NONE,
        horizon=20,
        stage_cost=lambda s: -s.x["product"] + (s.u["feed"] - s.u_last["feed"]) ** 2,
        terminal_cost=lambda s: -s.x["product"],
        input_lower={"feed": 0.0},
        input_upper={"feed": 0.2},
        limits=[
            SoftLimit("biomass", upper=3.7, at="end", penalty=100.0, scale=0.1),
            SoftLimit("sugar", lower=-0.01, at="end", penalty=100.0, scale=0.1),
        ],
        start=start,
    )
    return Case("fed batch", own, SimulatedPlant(model, start), steps, 2e-2)


def swing_up(steps=100):
    """Cart and pole from hanging to upright, of the examples of leap-c (University of Freiburg): begun at IPOPT's plan."""

    def rate(x, u, _):
        bob, mass, length, g = 0.1, 1.1, 0.8, 9.81
        sin, cos = ca.sin(x["angle"]), ca.cos(x["angle"])
        den, swing = mass - bob * cos**2, bob * length * sin * x["w"] ** 2
        turn = (-swing * cos + u["push"] * cos + mass * g * sin) / (length * den)
        return x["v"], x["w"], (-swing + bob * g * cos * sin + u["push"]) / den, turn

    def away(s):
        return 1e3 * s.x["place"] ** 2 + 1e3 * s.x["angle"] ** 2 + 0.005 * s.x["v"] ** 2 + 0.005 * s.x["w"] ** 2

    model = measured("cart and pole", "place angle v w", "push", rate, 0.04)
    own = Controller.build(
        model,
        NONE,
        horizon=50,
        stage_cost=lambda s: away(s) + 0.1 * s.u["push"] ** 2,
        terminal_cost=away,
        input_lower={"push": -80.0},
        input_upper={"push": 80.0},
        fallback={"push": 0.0},
        limits=[SoftLimit("place", lower=-2.4, upper=2.4, at="end", penalty=1e4, scale=0.1)],
        start={"angle": np.pi},
        first_guess="ipopt",
    )
    return Case("swing-up", own, SimulatedPlant(model, {"angle": np.pi}), steps, 1e-3)


CASES = (linear_cost, oscillating_masses, stirred_tank, four_tanks, rotating_masses, building, fed_batch, swing_up)


if __name__ == "__main__":
    for make in CASES:
        case = make()
        episode = run_episode(case.controller, case.plant, steps=case.steps, given=case.given)
        print(f"{case.name:20s} {episode.ending.value:6s} {len(episode)} intervals, not solved: {100 * episode.unsolved_share:.0f} %")
