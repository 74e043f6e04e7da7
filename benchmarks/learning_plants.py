"""Plants and studies of the learning benchmark; each problem is the learner's, `exact` is what it is judged by."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import casadi as ca

from chargetune.battery.cell.cell import Cell, default_cell
from chargetune.battery.cell.equivalent_circuit import ecm_model, start_state
from chargetune.battery.charging.limits import LimitSettings
from chargetune.battery.charging.problem import ChargingProblem
from chargetune.battery.charging.settings import ControllerSettings, Objective, SensorSettings
from chargetune.battery.charging.tunables import Backoff, LimitBackoff, ResistanceRatio, Tunables
from chargetune.battery.plants.electrochemical import Electrochemical
from chargetune.battery.studies.study_file import load_config
from chargetune.model.model import Model, Signal
from chargetune.plants.sensors import Sensors
from chargetune.plants.simulated import SimulatedPlant

__all__ = ["DFN", "PLANTS", "STUDIES", "StructuralPlant", "UnknownCell", "exact", "make_problem"]

# theta of each study: nine nodes of R0, eleven of a signed backoff, and the paper's backoff and R1.
STUDIES = {
    "r0": Tunables(R0=ResistanceRatio(0.1, 4.0)),
    "signed": Tunables(backoff=Backoff(nodes=11, lower_V=-0.3, upper_V=0.3)),
    "backoff": Tunables(backoff=Backoff(lower_V=0.0, upper_V=0.2)),
    "model": Tunables(R1=ResistanceRatio()),
}
# PyBaMM's DFN by ambient temperature in K, largest current in A, and whether temperature and anode potential are limited too.
DFN = {
    "dfn": (298.15, 10.0, False), "dfn-283K": (283.15, 10.0, False), "dfn-3C": (298.15, 15.0, False),
    "dfn-limits": (298.15, 10.0, True), "dfn-3C-limits": (298.15, 15.0, True),
}  # fmt: skip
# What the voltage limit may be exceeded by.
TOLERANCE_V = 1e-3
PLANTS = ("ecm", "unknown", "structural", *DFN)
EXAMPLE = Path(__file__).resolve().parents[1] / "examples" / "dfn_safe_charge.toml"


@dataclass(frozen=True)
class StructuralPlant:
    """A cell that no R-RC circuit is: a second pair, an R0 that falls through the episode, another OCV."""

    cell: Cell
    resistance_ohm: float = 0.012
    time_constant_s: float = 300.0
    drift: float = 0.12
    duration_s: float = 3600.0
    ocv_V: float = 0.004

    def plant(self, soc_start: float, sampling_time_s: float, sensors: Sensors) -> SimulatedPlant:
        count = len(self.cell.soc)
        cell = replace(
            self.cell,
            R2_ohm=(self.resistance_ohm,) * count,
            C2_F=(self.time_constant_s / self.resistance_ohm,) * count,
            ocv_V=tuple(v + self.ocv_V for v in self.cell.ocv_V),
        )
        base = ecm_model(cell, sampling_time_s)
        nx = len(base.states)
        x, u, p = (ca.SX.sym(name, size) for name, size in (("x", nx + 1), ("u", 1), ("p", base.nominal.size)))
        scaled, first = ca.SX(p), 0
        for name, values in base.parameters:
            if name == "R0_ohm":
                block = slice(first, first + len(values))
                scaled[block] = p[block] * (1 - self.drift * x[nx] / self.duration_s)
            first += len(values)
        model = Model(
            "R-RC-RC circuit with drift", (*base.states, Signal("elapsed_s", "s")), base.inputs, base.outputs, base.parameters,
            sampling_time_s, ca.Function("f", [x, u, p], [ca.vertcat(base.f(x[:nx], u, scaled), x[nx] + sampling_time_s)]),
            ca.Function("h", [x, u, p], [base.h(x[:nx], u, scaled)]),
        )  # fmt: skip
        return SimulatedPlant(model, start_state(cell, soc_start), sensors)


@dataclass(frozen=True)
class UnknownCell:
    """The circuit with another capacity, SOC at the start and OCV than the learner believes."""

    cell: Cell
    capacity: float
    soc: float
    ocv_V: float

    def plant(self, soc_start: float, sampling_time_s: float, sensors: Sensors) -> SimulatedPlant:
        cell = replace(
            self.cell, capacity_Ah=self.cell.capacity_Ah * (1 + self.capacity), ocv_V=tuple(v + self.ocv_V for v in self.cell.ocv_V)
        )
        return SimulatedPlant(ecm_model(cell, sampling_time_s), start_state(cell, soc_start + self.soc), sensors)


def make_problem(plant: str, study: str, seed: int, noise_V: float) -> ChargingProblem:
    """What the learner sees: noisy outputs, its own wrong model. Raises ValueError for an unknown plant or study."""
    if plant not in PLANTS or study not in STUDIES:
        raise ValueError(f"plant = {plant!r}, study = {study!r}; allowed are {', '.join(PLANTS)} and {', '.join(STUDIES)}")
    sensors = SensorSettings(voltage_noise_sd_V=noise_V)
    if plant in DFN:
        ambient_K, current_max_A, limits = DFN[plant]
        return _dfn(ambient_K, current_max_A, study, sensors, limits=limits)
    cell = default_cell()
    problem = ChargingProblem(
        cell,
        controller=ControllerSettings(mismatch_seed=seed),
        limits=LimitSettings(tolerance_V=TOLERANCE_V),
        sensors=sensors,
        objective=Objective(charge_time_to_soc=0.95, verdict_samples=5),
        theta=STUDIES[study],
    )
    if plant == "structural":
        return replace(problem, plant=StructuralPlant(cell))
    if plant == "unknown":
        import numpy as np

        draw = np.random.default_rng([seed, 1]).uniform(-1.0, 1.0, 3) * (0.05, 0.02, 0.005)
        return replace(problem, plant=UnknownCell(cell, *(float(v) for v in draw)))
    return problem


def _dfn(ambient_K: float, current_max_A: float, study: str, sensors: SensorSettings, *, limits: bool) -> ChargingProblem:
    """SOC measured, overpotential by the controller's own model; the seed decides the noise and nothing else.

    ``limits``: not the voltage's alone but also at most 318.15 K and no lithium plating, both with a backoff in theta.
    """
    problem = load_config(EXAMPLE).problem(EXAMPLE.parent)
    cell, plant = problem.cell, problem.plant
    if cell.thermal is None or not isinstance(plant, Electrochemical):
        raise TypeError(f"{EXAMPLE.name} is to describe a cell with a temperature and an electrochemical plant")
    theta, bounds = STUDIES[study], LimitSettings(current_max_A=current_max_A, tolerance_V=TOLERANCE_V)
    if limits:
        theta = replace(theta, temperature_backoff=LimitBackoff(-8.0, 8.0), anode_backoff=LimitBackoff(-0.05, 0.05, nodes=6))
        bounds = replace(bounds, temperature_max_K=318.15, tolerance_K=0.2, anode_min_V=0.0, tolerance_anode_V=1e-3)
    return ChargingProblem(
        replace(cell, thermal=replace(cell.thermal, ambient_K=ambient_K)),
        plant=replace(plant, ambient_K=ambient_K),
        limits=bounds,
        sensors=sensors,
        objective=Objective(charge_time_to_soc=0.8, verdict_samples=5),
        theta=theta,
    )


def exact(problem: ChargingProblem) -> ChargingProblem:
    """The same plant and controller, judged without noise."""
    return replace(problem, sensors=SensorSettings(), objective=replace(problem.objective, verdict_samples=1))
