"""The formulation check of a charging problem: the general checks on the cell's circuit, and what only a battery has."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from chargetune.battery.cell.cell import FLAT_BELOW_V
from chargetune.battery.charging.controller import controller_model, controller_of
from chargetune.battery.charging.evaluate import evaluate, plant_of, run_charge
from chargetune.battery.charging.problem import ChargingProblem, stand_in
from chargetune.battery.charging.ringing import check_ringing
from chargetune.battery.plants.steppable import as_steppable
from chargetune.checks.finding import Evidence, Finding
from chargetune.checks.influence import check_theta
from chargetune.checks.nominal_loop import check_formulation
from chargetune.checks.plant_response import check_response
from chargetune.episode.episode import Ending, Episode
from chargetune.episode.stepwise import run_episode
from chargetune.plants.simulated import SimulatedPlant
from chargetune.runtime.counted import counted

__all__ = ["check_charging"]

# What a current that charges does to each output at the end of an interval.
SIGNS = {"voltage_V": 1, "soc": 1, "anode_potential_V": -1}
# A target missed by less is met: the SOC approaches it asymptotically.
MISSED_SOC = 0.05
# Steps in which a simulated plant shows which way its current counts.
PROBE_STEPS = 4
FINER = 10
# Where the OCV goes on rising beyond full, so far above the full cell's OCV the limit no longer keeps from overcharge, V.
ABOVE_FULL_V = 0.1
# With a measured overpotential a resistance that moves the excess by less than this share of what it moves it otherwise has no say.
SAY = 0.25


def check_charging(problem: ChargingProblem, *, start: ArrayLike | None = None, quick: bool = False) -> tuple[Finding, ...]:
    """Everything that is found wrong with a charging problem, the errors first.

    ``start`` is a theta that is declared safe. ``quick`` leaves out what takes more than the first charge of a study does
    anyway: longer horizons, and all but the first interval of an electrochemical plant. Raises SetUpError for a plant that cannot be
    built: no theta could work.
    """
    circuit = stand_in(problem)
    controller, plant = controller_of(circuit), plant_of(circuit)
    signs = {(name, "current_A"): sign for name, sign in SIGNS.items() if name in controller.model.output_names}
    finer = controller_model(circuit, circuit.controller.sampling_time_s / FINER)
    found = list(
        check_formulation(
            controller,
            steps=circuit.episode.steps,
            plant=plant if isinstance(plant, SimulatedPlant) else None,
            signs=signs,
            finer=finer,
            quick=quick,
            along="soc",
        )
    )
    if any(finding.code == "unsafe-start" for finding in found):
        return tuple(found)
    found += [*_target(circuit), *_above_full(circuit)]
    if circuit.space.dimension:
        weak = _measured_overpotential(circuit)
        found += weak or check_theta(lambda theta: _beyond(circuit, theta), circuit.space)
        if start is not None:
            found += check_theta(lambda theta: _beyond(circuit, theta), circuit.space, start)
    found += check_ringing(circuit)
    found += _plant_signs(problem, 1 if quick else PROBE_STEPS)
    return tuple(sorted(found, key=lambda finding: finding.severity != "error"))


def _beyond(problem: ChargingProblem, theta: NDArray[np.float64]) -> float:
    """The largest excess less its tolerance, in tolerances; infinite when the charge does not come to its end."""
    score, _, _ = evaluate(problem, theta, 0)
    return np.inf if score is None else score.worst


def _target(problem: ChargingProblem) -> list[Finding]:
    """Whether the target can be reached at rest within the voltage limit, by the largest current, and by a perfect model."""
    cell, target, limit = problem.cell, problem.episode.soc_target, problem.voltage_max_V
    resting = float(np.interp(target, cell.ocv_soc, cell.ocv_V))
    hours = problem.episode.steps * problem.controller.sampling_time_s / 3600
    most = problem.episode.soc_start + cell.coulombic_efficiency * problem.current_max_A * hours / cell.capacity_Ah
    settled = float(np.interp(limit, cell.ocv_V, cell.ocv_soc))
    known = replace(problem, cell=problem.controller_cell, controller=replace(problem.controller, mismatch_seed=None))
    episode = run_charge(known)
    soc = episode.signal("soc", true=True)[1]
    reached = float(soc[-1]) if len(soc) and episode.ending is Ending.DONE else np.nan
    numbers = {"soc_target": target, "soc_largest_current": most, "soc_at_rest_at_limit": settled, "soc_perfect_model": reached}
    evidence = Evidence(
        "time (min)", "SOC", {"perfect model": ((episode.time_s + problem.controller.sampling_time_s) / 60, soc)}, {"target": target}
    )
    if resting > limit + problem.limits.tolerance_V:
        message = f"soc_target = {target:g} cannot be reached: at rest it has {resting:.3f} V, voltage_max_V is {limit:g} V"
        remedy = f"soc_target of at most {settled:.3f}, or a higher voltage_max_V"
    elif most < target - MISSED_SOC:
        message = f"soc_target = {target:g} cannot be reached in {60 * hours:.3g} min: the largest current charges to {most:.3f}"
        needed = (target - problem.episode.soc_start) * cell.capacity_Ah / cell.coulombic_efficiency / problem.current_max_A * 3600
        remedy = (
            f"at least {counted(int(np.ceil(needed / problem.controller.sampling_time_s)), 'step')}, or soc_target of at most {most:.3f}"
        )
    elif not reached >= target - MISSED_SOC:
        message = f"soc_target = {target:g}: a controller that knows the cell only gets to {reached:.3f} in {60 * hours:.3g} min"
        remedy = "more steps, a lower soc_target, or wider limits"
    else:
        return []
    return [Finding("unreachable-target", "warning", message, remedy, numbers, evidence)]


def _above_full(problem: ChargingProblem) -> list[Finding]:
    """An upper voltage limit so far above the OCV of the full cell that the charge may go on beyond SOC 1."""
    full, limit = problem.cell.ocv_V[-1], problem.voltage_max_V
    if full < FLAT_BELOW_V or limit <= full + ABOVE_FULL_V:
        return []
    return [
        Finding(
            "limit-above-full",
            "warning",
            f"voltage_max_V = {limit:g} V is {1e3 * (limit - full):.0f} mV above the OCV of the full cell, {full:.4g} V: "
            "it does not keep the cell from being charged beyond SOC 1",
            f"a voltage_max_V of at most {full + ABOVE_FULL_V:.4g} V, or an OCV and a capacity that reach to the voltage of the full cell",
            {"voltage_max_V": limit, "ocv_full_V": full},
        )
    ]


def _measured_overpotential(problem: ChargingProblem) -> list[Finding]:
    """A resistance of an R-C pair in theta although the overpotential that it predicts is measured."""
    tuned = {of: ratio for of, ratio in problem.theta.ratios.items() if of != "R0"}
    if problem.estimator.kind != "exact" or not tuned:
        return []
    out = []
    for of, ratio in tuned.items():
        ranges, curves = {}, {}
        part = problem.space.slices[ratio.name(of)]
        for way in ("exact", "open_loop"):
            variant = replace(problem, estimator=replace(problem.estimator, kind=way))
            values = np.linspace(0.0, 1.0, 9)
            units = [variant.space.to_unit(variant.space.default) for _ in values]
            for unit, value in zip(units, values, strict=True):
                unit[part] = value
            excess = np.array([_voltage_excess(variant, variant.space.from_unit(unit)) for unit in units])
            factors = np.geomspace(ratio.lower, ratio.upper, values.size)
            curves["measured" if way == "exact" else "propagated by the model"] = (factors, 1e3 * excess)
            ranges[way] = 1e3 * float(np.ptp(excess))
        if ranges["exact"] < SAY * ranges["open_loop"]:
            out.append(
                Finding(
                    "no-influence",
                    "warning",
                    f"{ratio.name(of)} has next to no influence: the overpotential is measured at every step, which replaces what {of} "
                    f"predicts; over its whole range the worst voltage moves by {ranges['exact']:.0f} mV (by "
                    f"{ranges['open_loop']:.0f} mV if the model propagated it)",
                    'estimator.kind = "open_loop" (an overpotential cannot be measured on a real cell), or tune R0 or a backoff instead',
                    {"range_measured_mV": ranges["exact"], "range_propagated_mV": ranges["open_loop"]},
                    Evidence(f"factor on {of}", "worst voltage over the limit (mV)", curves, {"limit": 0.0}),
                )
            )
    return out


def _voltage_excess(problem: ChargingProblem, theta: NDArray[np.float64]) -> float:
    return float(np.max(run_charge(problem, theta).signal("voltage_V", true=True))) - problem.voltage_max_V


def _plant_signs(problem: ChargingProblem, steps: int) -> list[Finding]:
    """The first intervals of another simulated plant than the circuit; a real one is left alone.

    Raises SetUpError where it cannot be built at all.
    """
    if problem.plant is None:
        return []
    plant = plant_of(problem)
    if as_steppable(plant) is None:
        return []
    run: Episode = run_episode(controller_of(problem), plant, steps=steps)
    return check_response(controller_of(problem), run)
