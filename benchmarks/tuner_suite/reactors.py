"""Reactors: the stirred tanks of Sorourifar and of PC-Gym, the batch reactor of do-mpc, a crystalliser."""

from __future__ import annotations

import casadi as ca
import numpy as np
from mpc_systems import measured
from tuner_suite.plant import SuitePlant, believed, drawn, factors, simulated_plant

import chargetune as ct

__all__ = ["batch_reactor", "crystalliser", "pcgym_cstr", "sorourifar_cstr"]


def sorourifar_cstr(seed: int) -> SuitePlant:
    """Moles of B from A -> B -> C, 2 A -> D; B and the reactor are measured, and the reactor must stay below 116 degC.

    The paper's 150 degC is out of reach of its own inflow, and its interval of 18 s leaves a wrong model no time to show; here it is 72 s.
    """

    def rate(x, u, p):
        kelvin = x["reactor"] + 273.15
        k1 = p["k1"] * 1e12 * ca.exp(-9758.3 / kelvin)
        k2 = 1.287e12 * ca.exp(-9758.3 / kelvin)
        k3 = 9.043e9 * ca.exp(-7704.0 / kelvin)
        heat = 4.2 * (k1 * x["a"] + k2 * x["b"] + k3 * x["a"] ** 2)
        return (
            u["feed"] * (1.0 - x["a"]) - k1 * x["a"] - k3 * x["a"] ** 2,
            -u["feed"] * x["b"] + k1 * x["a"] - k2 * x["b"],
            u["feed"] * (130.0 - x["reactor"])
            + p["exchange"] * 0.215 / (0.9342 * 3.01 * 10.01) * (x["jacket"] - x["reactor"])
            - heat / (0.9342 * 3.01),
            (p["cooling"] + p["exchange"] * 0.215 * (x["reactor"] - x["jacket"])) / (5.0 * 2.0),
        )

    nominal = {"k1": 1.287, "exchange": 4032.0, "cooling": -4500.0}
    model = measured("stirred tank", "a b reactor jacket", "feed", rate, 0.02, substeps=6, **nominal)
    spread = {"k1": 0.3, "exchange": 0.4, "cooling": 0.4}
    own = drawn("sorourifar", seed, **spread)
    start = {"a": 1.0, "b": 1.0, "reactor": 100.0, "jacket": 100.0}
    space = ct.ParameterSpace((*factors(*nominal), ct.Parameter("backoff_K", 0.0, 6.0, default=0.0, unit="K")))
    controller = ct.Controller.build(
        model,
        space,
        horizon=6,
        parameters=believed(model, *nominal),
        stage_cost=lambda s: -10.01 * s.u["feed"] * s.x["b"] * 0.02 + 1e-3 * (s.u["feed"] - s.u_last["feed"]) ** 2,
        input_lower={"feed": 5.0},
        input_upper={"feed": 35.0},
        input_before={"feed": 20.0},
        limits=[ct.SoftLimit("reactor", upper=lambda s: 116.0 - s.theta["backoff_K"], at="end", penalty=10.0)],
        start=start,
        estimator=ct.Propagated(("b", "reactor")),
    )
    return simulated_plant(
        "sorourifar-cstr",
        "Sorourifar et al., IFAC-PapersOnLine 54-3 (2021) 243, Table 1; as in the examples of mpcrl",
        controller=controller,
        truth=model.with_parameters(**{k: v * own[k] for k, v in nominal.items()}),
        start=start,
        noise_sd={"a": 2e-3, "b": 2e-3, "reactor": 0.05, "jacket": 0.05},
        limits=[ct.ScoredLimit("reactor", upper=116.0, tolerance=0.2)],
        objective=lambda e: float(10.01 * 0.02 * np.sum(e.input[:, 0] * e.signal("b")[0])),
        steps=25,
        safe_theta=(1.0, 1.0, 1.0, 6.0),
        unknowns=[ct.Uncertain(k, sd=s / 2) for k, s in spread.items()],
        input_before={"feed": 20.0},
    )


def pcgym_cstr(seed: int) -> SuitePlant:
    """Concentration of A follows two steps; the reactor, open-loop unstable, must stay below 327 K."""

    def rate(x, u, p):
        reaction = p["k0"] * 1e10 * ca.exp(-8750.0 / x["T"]) * x["Ca"]
        return (
            100.0 / 100.0 * (1.0 - x["Ca"]) - reaction,
            350.0 - x["T"] + 5e4 / 239.0 * reaction + p["UA"] * 1e4 / (239.0 * 100.0) * (u["Tc"] - x["T"]),
        )

    nominal = {"k0": 7.2, "UA": 5.0}
    model = measured("stirred tank", "Ca T", "Tc", rate, 0.26, substeps=4, **nominal)
    spread = {"k0": 0.25, "UA": 0.1}
    own = drawn("pcgym", seed, **spread)
    start = {"Ca": 0.8, "T": 325.0}
    space = ct.ParameterSpace(
        (*factors(*nominal, most=1.4), ct.Parameter("backoff_K", 0.0, 4.0, default=0.0, unit="K"),
         ct.Parameter("move_weight", 1e-6, 1e-3, default=1e-4, scale="log"))
    )  # fmt: skip
    controller = ct.Controller.build(
        model,
        space,
        horizon=10,
        parameters=believed(model, *nominal),
        stage_cost=lambda s: (s.x["Ca"] - s.given["target"]) ** 2 + s.theta["move_weight"] * (s.u["Tc"] - s.u_last["Tc"]) ** 2,
        terminal_cost=lambda s: 5 * (s.x["Ca"] - s.given["target"]) ** 2,
        input_lower={"Tc": 285.0},
        input_upper={"Tc": 305.0},
        input_before={"Tc": 300.0},
        fallback={"Tc": 295.0},
        limits=[ct.SoftLimit("T", upper=lambda s: 327.0 - s.theta["backoff_K"], at="end", penalty=1.0)],
        given=[ct.Signal("target")],
        start=start,
    )
    k = np.arange(60)
    given = {"target": np.where(k < 18, 0.85, np.where(k < 34, 0.75, 0.9))}
    return simulated_plant(
        "pcgym-cstr",
        "PC-Gym (Bloor et al., 2024), cstr; Seborg, Edgar, Mellichamp and Doyle, Process Dynamics and Control",
        controller=controller,
        truth=model.with_parameters(**{k: v * own[k] for k, v in nominal.items()}),
        start=start,
        noise_sd={"Ca": 5e-4, "T": 0.03},
        limits=[ct.ScoredLimit("T", upper=327.0, tolerance=0.15)],
        objective=lambda e: -float(np.sum(np.abs(e.signal("Ca")[1] - given["target"][: len(e)]))),
        steps=50,
        safe_theta=(1.0, 1.0, 4.0, 1e-4),
        unknowns=[ct.Uncertain(k, sd=s / 2) for k, s in spread.items()],
        given=given,
        input_before={"Tc": 300.0},
    )


def batch_reactor(seed: int) -> SuitePlant:
    """As much product as the biomass allows, which is assayed after the batch: the controller has its own model and the volume."""

    def rate(x, u, p):
        growth = p["growth"] * x["sugar"] / (p["monod"] + x["sugar"] + x["sugar"] ** 2 / 5.0)
        thinner = u["feed"] / x["volume"]
        return (
            growth * x["biomass"] - thinner * x["biomass"],
            -growth * x["biomass"] / p["yield_"] - 0.004 * x["biomass"] / 1.2 + thinner * (200.0 - x["sugar"]),
            0.004 * x["biomass"] - thinner * x["product"],
            u["feed"],
        )

    nominal = {"growth": 0.02, "monod": 0.05, "yield_": 0.4}
    model = measured("batch reactor", "biomass sugar product volume", "feed", rate, 4.0, substeps=6, **nominal)
    spread = {"growth": 0.2, "monod": 0.2, "yield_": 0.2}
    own = drawn("batch", seed, **spread)
    start = {"biomass": 1.0, "sugar": 0.5, "product": 0.0, "volume": 120.0}
    space = ct.ParameterSpace((*factors("growth", "yield_"), ct.Parameter("backoff", 0.0, 0.6, default=0.0, unit="g/L")))
    controller = ct.Controller.build(
        model,
        space,
        horizon=8,
        iterations_max=10,
        parameters=believed(model, "growth", "yield_"),
        stage_cost=lambda s: -s.x["product"] + 30 * (s.u["feed"] - s.u_last["feed"]) ** 2,
        terminal_cost=lambda s: -s.x["product"],
        input_lower={"feed": 0.0},
        input_upper={"feed": 0.2},
        limits=[
            ct.SoftLimit("biomass", upper=lambda s: 3.7 - s.theta["backoff"], at="end", penalty=100.0, scale=0.1),
            ct.SoftLimit("sugar", lower=-0.01, at="end", penalty=100.0, scale=0.1),
        ],
        start=start,
        estimator=ct.Propagated(("volume",)),
    )
    return simulated_plant(
        "batch-reactor",
        "Srinivasan, Palanki and Bonvin, Computers and Chemical Engineering 27 (2003) 1; as in the examples of do-mpc",
        controller=controller,
        truth=model.with_parameters(**{k: v * own[k] for k, v in nominal.items()}),
        start=start,
        noise_sd={"biomass": 5e-3, "sugar": 2e-3, "product": 2e-3, "volume": 1e-2},
        limits=[ct.ScoredLimit("biomass", upper=3.7, tolerance=0.02)],
        objective=lambda e: float(e.signal("product")[1][-1]),
        steps=38,
        safe_theta=(1.0, 1.0, 0.6),
        unknowns=[ct.Uncertain(k, sd=s / 2) for k, s in spread.items()],
    )


def crystalliser(seed: int) -> SuitePlant:
    """As much K2SO4 as crystallises in 30 h of cooling; supersaturation, known after the batch, must stay below 16 g/L."""

    def soluble(celsius):
        return -686.2686 + 3.579165 * (celsius + 273.15) - 0.00292874 * (celsius + 273.15) ** 2

    def rate(x, u, p):
        # Moments are in units of 1e3, 1e4, 1e6 and 1e8; c in g/cm3; time in h.
        m0, m1, m2, m3 = 1e3 * x["m0"], 1e4 * x["m1"], 1e6 * x["m2"], 1e8 * x["m3"]
        kelvin = u["T"] + 273.15
        over = ca.sqrt((1e3 * x["c"] - soluble(u["T"])) ** 2 + 1e-4)
        births = p["births"] * ca.exp(-6.8e3 / kelvin) * over**0.92 * ca.fmax(m3, 1.0) ** 1.3
        growth = p["growth"] * ca.exp(-4.9e3 / kelvin) * over**1.9
        inner = 0.51 * m2 * 1e-8 + 7.3 * m3 * 1e-12
        return (
            births / 1e3,
            growth * (0.51 * m0 + 7.3 * m1 * 1e-4) * 1e4 / 1e4,
            2 * growth * (0.51 * m1 * 1e-4 + 7.3 * m2 * 1e-8) * 1e8 / 1e6,
            3 * growth * inner * 1e12 / 1e8,
            -0.5 * 2.7 * 7.5 * growth * inner,
        )

    nominal = {"births": 0.92, "growth": 48.0}
    names = "m0 m1 m2 m3 c"

    def equations(x, u, p):
        after = ct.rk4(lambda v: ca.vertcat(*rate(dict(zip(names.split(), ca.vertsplit(v), strict=True)), u, p)), x.vector, 1.0, 3)
        outputs = {name: x[name] for name in names.split()} | {"over": 1e3 * x["c"] - soluble(u["T"])}
        return dict(zip(names.split(), ca.vertsplit(after), strict=True)), outputs

    model = ct.Model.build(
        "crystalliser",
        states=[ct.Signal(n) for n in names.split()],
        inputs=[ct.Signal("T")],
        outputs=[ct.Signal(n) for n in (*names.split(), "over")],
        parameters=nominal,
        sampling_time_s=1.0,
        equations=equations,
    )
    spread = {"births": 0.4, "growth": 0.3}
    own = drawn("crystals", seed, **spread)
    start = {"m0": 1.47800986666666, "m1": 2.29958230590611, "m2": 1.80086324079725, "m3": 2.48516167940593, "c": 0.15861523304}
    space = ct.ParameterSpace((*factors(*nominal), ct.Parameter("backoff", 0.0, 5.0, default=0.0, unit="g/L")))
    controller = ct.Controller.build(
        model,
        space,
        horizon=6,
        parameters=believed(model, *nominal),
        stage_cost=lambda s: 1e2 * s.x["c"] + 1e-3 * (s.u["T"] - s.u_last["T"]) ** 2,
        terminal_cost=lambda s: 5e2 * s.x["c"],
        input_lower={"T": 10.0},
        input_upper={"T": 40.0},
        input_rate={"T": 3.0},
        input_before={"T": 39.0},
        fallback={"T": 39.0},
        limits=[ct.SoftLimit("over", upper=lambda s: 16.0 - s.theta["backoff"], penalty=10.0)],
        start=start,
        estimator=ct.Propagated(),
    )
    return simulated_plant(
        "crystalliser",
        "de Moraes et al., Industrial and Engineering Chemistry Research 62 (2023) 9515; as in PC-Gym",
        controller=controller,
        truth=model.with_parameters(**{k: v * own[k] for k, v in nominal.items()}),
        start=start,
        noise_sd={"m0": 5e-3, "m1": 5e-3, "m2": 5e-3, "m3": 5e-3, "c": 5e-5, "over": 5e-2},
        limits=[ct.ScoredLimit("over", upper=16.0, tolerance=0.2)],
        objective=lambda e: 1e3 * float(start["c"] - e.signal("c")[1][-1]),
        steps=30,
        safe_theta=(1.0, 1.0, 5.0),
        unknowns=[ct.Uncertain(k, sd=s / 2) for k, s in spread.items()],
        input_before={"T": 39.0},
    )
