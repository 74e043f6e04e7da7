"""Plants of heat and flow: four tanks, an extraction column, the TCLab board, a building with prices."""

from __future__ import annotations

import casadi as ca
import numpy as np
from mpc_systems import measured
from tuner_suite.plant import SuitePlant, believed, drawn, factors, simulated_plant

import chargetune as ct

__all__ = ["building", "extraction", "four_tanks", "tclab"]


def four_tanks(seed: int) -> SuitePlant:
    """The lower levels follow steps that are seen ahead; the first tank must not rise above 16.1 cm."""

    def rate(x, u, p):
        flow = {n: a * ca.sqrt(2 * 981.0 * ca.fmax(x[n], 1e-6)) for n, a in (("h1", 0.071), ("h2", 0.057), ("h3", 0.071), ("h4", 0.057))}
        one, two = p["k1"] * u["v1"], p["k2"] * u["v2"]
        return (
            (flow["h3"] - flow["h1"] + p["split1"] * one) / 28,
            (flow["h4"] - flow["h2"] + p["split2"] * two) / 32,
            ((1 - p["split2"]) * two - flow["h3"]) / 28,
            ((1 - p["split1"]) * one - flow["h4"]) / 32,
        )

    nominal = {"k1": 3.33, "k2": 3.35, "split1": 0.7, "split2": 0.6}
    model = measured("four tanks", "h1 h2 h3 h4", "v1 v2", rate, 15.0, substeps=2, **nominal)
    spread = {"k1": 0.2, "k2": 0.2, "split1": 0.1, "split2": 0.1}
    own = drawn("four tanks", seed, **spread)
    space = ct.ParameterSpace(
        (*factors("k1", "k2", most=1.6), ct.Parameter("backoff_cm", 0.0, 3.0, default=0.0, unit="cm"),
         ct.Parameter("move_weight", 1e-2, 10.0, default=0.05, scale="log"))
    )  # fmt: skip

    def away(s):
        return (s.x["h1"] - s.given["h1_ref"]) ** 2 + (s.x["h2"] - s.given["h2_ref"]) ** 2

    before = {"v1": 3.0, "v2": 3.0}
    controller = ct.Controller.build(
        model,
        space,
        horizon=8,
        parameters=believed(model, "k1", "k2"),
        stage_cost=lambda s: away(s) + s.theta["move_weight"] * ca.sumsqr(s.u.vector - s.u_last.vector),
        terminal_cost=away,
        input_lower={"v1": 0.0, "v2": 0.0},
        input_upper={"v1": 6.0, "v2": 6.0},
        input_before=before,
        limits=[ct.SoftLimit("h1", upper=lambda s: 16.1 - s.theta["backoff_cm"], at="end", penalty=1e2)],
        given=[ct.Signal("h1_ref"), ct.Signal("h2_ref")],
    )
    k = np.arange(48)
    given = {"h1_ref": np.where(k < 10, 12.0, np.where(k < 28, 16.0, 12.0)), "h2_ref": np.where(k < 20, 13.0, 11.0)}
    return simulated_plant(
        "four-tanks",
        "Johansson, IEEE Trans. Control Systems Technology 8 (2000) 456, minimum phase; as in PC-Gym",
        controller=controller,
        truth=model.with_parameters(**{k: v * own[k] for k, v in nominal.items()}),
        start={"h1": 12.4, "h2": 12.7, "h3": 1.8, "h4": 1.4},
        noise_sd=dict.fromkeys(("h1", "h2", "h3", "h4"), 0.02),
        limits=[ct.ScoredLimit("h1", upper=16.1, tolerance=0.1)],
        objective=lambda e: -float(np.mean([np.abs(e.signal(h)[1] - given[f"{h}_ref"][: len(e)]) for h in ("h1", "h2")])),
        steps=40,
        safe_theta=(1.0, 1.0, 3.0, 0.05),
        unknowns=[ct.Uncertain(k, sd=s / 2) for k, s in spread.items()],
        given=given,
        input_before=before,
    )


def extraction(seed: int) -> SuitePlant:
    """As little solvent as keeps the raffinate of five stages below 0.3, of which alone it is measured, while the feed changes."""
    names = " ".join(f"x{i} y{i}" for i in range(1, 6))

    def rate(x, u, p):
        out, before = [], 0.6
        for i in range(1, 6):
            liquid, gas = x[f"x{i}"], x[f"y{i}"]
            after = x[f"y{i + 1}"] if i < 5 else 0.05
            moved = p["transfer"] * (liquid - gas**2 / p["equilibrium"]) * 5.0
            out += [(p["feed"] * (before - liquid) - moved) / 5.0, (u["solvent"] * (after - gas) + moved) / 5.0]
            before = liquid
        return out

    nominal = {"feed": 20.0, "transfer": 5.0, "equilibrium": 1.0}
    model = measured("extraction", names, "solvent", rate, 0.25, substeps=2, **nominal)
    spread = {"transfer": 0.3, "equilibrium": 0.3}
    own = drawn("extraction", seed, **spread)
    start = dict(zip(names.split(), (0.52, 0.38, 0.45, 0.33, 0.39, 0.28, 0.33, 0.22, 0.27, 0.15), strict=True))
    space = ct.ParameterSpace((*factors(*spread, most=1.8), ct.Parameter("backoff", 0.0, 0.1, default=0.0)))
    controller = ct.Controller.build(
        model,
        space,
        horizon=5,
        parameters=lambda s: believed(model, *spread)(s) | {"feed": s.given["feed"]},
        stage_cost=lambda s: 0.01 * s.u["solvent"] + 1e-4 * (s.u["solvent"] - s.u_last["solvent"]) ** 2,
        input_lower={"solvent": 5.0},
        input_upper={"solvent": 100.0},
        input_before={"solvent": 20.0},
        fallback={"solvent": 60.0},
        limits=[ct.SoftLimit("x5", upper=lambda s: 0.3 - s.theta["backoff"], at="end", penalty=1e3, scale=0.1)],
        start=start,
        estimator=ct.Propagated(("x5",)),
        given=[ct.Signal("feed")],
    )
    k = np.arange(40)
    given = {"feed": np.where(k < 8, 20.0, np.where(k < 20, 32.0, 24.0))}
    return simulated_plant(
        "extraction",
        "Ingham et al., Chemical Engineering Dynamics (2007); as in PC-Gym",
        controller=controller,
        truth=model.with_parameters(**{k: v * own.get(k, 1.0) for k, v in nominal.items()}),
        start=start,
        noise_sd=dict.fromkeys(names.split(), 5e-4),
        limits=[ct.ScoredLimit("x5", upper=0.3, tolerance=3e-3)],
        objective=lambda e: -float(np.mean(e.input[:, 0])),
        steps=30,
        safe_theta=(1.0, 1.0, 0.1),
        unknowns=[ct.Uncertain(k, sd=s / 2) for k, s in spread.items()],
        given=given,
        plant_given=("feed",),
        input_before={"solvent": 20.0},
    )


def tclab(seed: int) -> SuitePlant:
    """Two heaters follow steps; the first must not pass 56 degC. Its sensors lag, of which neither the controller nor the twin knows."""
    nominal = {"loss": 10.0, "power1": 0.01, "power2": 0.0075}

    def balance(one, two, u, p):
        """K/s of both heaters, at temperatures in degC: 4 g, 500 J/kg/K, 10 cm2 to the air at 23 degC, 2 cm2 to each other."""

        def to(area, there, here):
            return area * (p["loss"] * (there - here) + 0.9 * 5.67e-8 * ((there + 273.15) ** 4 - (here + 273.15) ** 4))

        return (
            (to(1e-3, 23.0, one) + to(2e-4, two, one) + p["power1"] * u["q1"]) / 2.0,
            (to(1e-3, 23.0, two) + to(2e-4, one, two) + p["power2"] * u["q2"]) / 2.0,
        )

    model = measured("heaters", "t1 t2", "q1 q2", lambda x, u, p: balance(x["t1"], x["t2"], u, p), 12.0, substeps=2, **nominal)

    def lagging(x, u, p):
        first, second = balance(x["heater1"], x["heater2"], u, p)
        return (x["heater1"] - x["t1"]) / p["lag"], (x["heater2"] - x["t2"]) / p["lag"], first, second

    board = measured("board", "t1 t2 heater1 heater2", "q1 q2", lagging, 12.0, substeps=6, **nominal, lag=15.0)
    spread = {"loss": 0.25, "power1": 0.2, "power2": 0.2}
    own = drawn("tclab", seed, **spread, lag=0.4)
    space = ct.ParameterSpace(
        (*factors("loss", "power1", most=1.8), ct.Parameter("backoff_K", 0.0, 5.0, default=0.0, unit="K"),
         ct.Parameter("move_weight", 1e-4, 1.0, default=1e-3, scale="log"))
    )  # fmt: skip
    controller = ct.Controller.build(
        model,
        space,
        horizon=8,
        parameters=believed(model, "loss", "power1"),
        stage_cost=lambda s: (
            (s.x["t1"] - s.given["t1_ref"]) ** 2
            + (s.x["t2"] - s.given["t2_ref"]) ** 2
            + s.theta["move_weight"] * ca.sumsqr(s.u.vector - s.u_last.vector)
        ),
        input_lower={"q1": 0.0, "q2": 0.0},
        input_upper={"q1": 100.0, "q2": 100.0},
        limits=[ct.SoftLimit("t1", upper=lambda s: 56.0 - s.theta["backoff_K"], at="end", penalty=1e2)],
        start={"t1": 23.0, "t2": 23.0},
        given=[ct.Signal("t1_ref"), ct.Signal("t2_ref")],
    )
    k = np.arange(58)
    given = {"t1_ref": np.where(k < 30, 55.0, 40.0), "t2_ref": np.where(k < 15, 30.0, 42.0)}
    return simulated_plant(
        "tclab",
        "Park, Martin, Kelly and Hedengren, Computers and Chemical Engineering 135 (2020) 106736, second-order energy balance",
        controller=controller,
        truth=board.with_parameters(**{k: v * own[k] for k, v in (nominal | {"lag": 15.0}).items()}),
        start=dict.fromkeys(("t1", "t2", "heater1", "heater2"), 23.0),
        twin_start={"t1": 23.0, "t2": 23.0},
        noise_sd={"t1": 0.05, "t2": 0.05},
        limits=[ct.ScoredLimit("t1", upper=56.0, tolerance=0.3)],
        objective=lambda e: -float(np.mean([np.abs(e.signal(t)[1] - given[f"{t}_ref"][: len(e)]) for t in ("t1", "t2")])),
        steps=50,
        safe_theta=(1.0, 1.0, 5.0, 1e-3),
        unknowns=[ct.Uncertain(k, sd=s / 2) for k, s in spread.items()],
        given=given,
    )


def building(seed: int) -> SuitePlant:
    """What a day of floor heating costs; the air must not be colder than the schedule says. Walls and floor are not measured."""
    names = "air walls floor"

    def equations(x, u, p):
        # kW, kWh/K and h.
        def rate(v):
            air, walls, floor = ca.vertsplit(v)
            return ca.vertcat(
                p["leak"] * (p["ambient"] - air) + 0.8 * (walls - air) + p["emission"] * (floor - air) + 0.3 * p["sun"],
                (0.8 * (air - walls) + 0.05 * (p["ambient"] - walls)) / 8.0,
                (p["emission"] * (air - floor) + u["heat"]) / 3.0,
            )

        after = ct.rk4(rate, x.vector, 0.5, 2)
        outputs = {n: x[n] for n in names.split()} | {"comfort": x["air"] - p["least"]}
        return dict(zip(names.split(), ca.vertsplit(after), strict=True)), outputs

    nominal = {"leak": 0.1, "emission": 1.0}
    model = ct.Model.build(
        "building",
        states=[ct.Signal(n) for n in names.split()],
        inputs=[ct.Signal("heat")],
        outputs=[ct.Signal(n) for n in (*names.split(), "comfort")],
        parameters=nominal | {"ambient": 0.0, "sun": 0.0, "least": 17.0},
        sampling_time_s=0.5,
        equations=equations,
    )
    spread = {"leak": 0.5, "emission": 0.3}
    own = drawn("building", seed, **spread)
    start = {"air": 20.5, "walls": 19.0, "floor": 22.0}
    given_names = ("ambient", "sun", "least")
    space = ct.ParameterSpace((*factors(*nominal, most=2.5), ct.Parameter("backoff_K", 0.0, 2.0, default=0.0, unit="K")))
    controller = ct.Controller.build(
        model,
        space,
        horizon=16,
        stage_cost=lambda s: s.given["price"] * s.u["heat"] + 0.002 * (s.u["heat"] - s.u_last["heat"]) ** 2,
        parameters=lambda s: believed(model, *nominal)(s) | {n: s.given[n] for n in given_names},
        input_lower={"heat": 0.0},
        input_upper={"heat": 8.0},
        limits=[ct.SoftLimit("air", lower=lambda s: s.given["least"] + s.theta["backoff_K"], at="end", penalty=50.0, scale=0.1)],
        start=start,
        estimator=ct.Propagated(("air",)),
        given=[ct.Signal(n) for n in ("price", *given_names)],
    )
    hour = 0.5 * np.arange(64)
    day = hour % 24
    given = {
        "price": 0.25 + 0.1 * np.sin(2 * np.pi * (day - 6) / 12),
        "ambient": 2.0 + 5.0 * np.sin(2 * np.pi * (day - 9) / 24),
        "sun": np.maximum(0.0, np.sin(np.pi * (day - 7) / 11)) * ((day > 7) & (day < 18)),
        "least": np.where((day < 6) | (day > 22), 17.0, 20.0),
    }
    return simulated_plant(
        "building",
        "floor heating of the examples of leap-c and BOPTEST (Blum et al., J. Building Performance Simulation 14 (2021) 586)",
        controller=controller,
        truth=model.with_parameters(**{k: v * own[k] for k, v in nominal.items()}),
        start=start,
        noise_sd=dict.fromkeys((*names.split(), "comfort"), 0.02),
        limits=[ct.ScoredLimit("comfort", lower=0.0, tolerance=0.1)],
        objective=lambda e: -float(0.5 * np.sum(given["price"][: len(e)] * e.input[:, 0])),
        steps=48,
        safe_theta=(1.0, 1.0, 2.0),
        unknowns=[ct.Uncertain(k, sd=s / 2) for k, s in spread.items()],
        given=given,
        plant_given=given_names,
    )
