"""The twin of a charging problem: the controller's own circuit with unknown resistances and capacitances as plant."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from chargetune.battery.cell.equivalent_circuit import ecm_model, start_state
from chargetune.battery.charging.controller import controller_of, measured_rows, row_tolerances
from chargetune.battery.charging.problem import ChargingProblem, stand_in
from chargetune.battery.charging.verdict import NotMeasuredError, charge_samples, score_episode, violation_mVs
from chargetune.control.controller import Controller
from chargetune.episode.episode import Episode
from chargetune.episode.score import Score

if TYPE_CHECKING:
    from chargetune.learning.twin.simulated_twin import TwinSimulator
    from chargetune.learning.twin.twin import Twin
    from chargetune.learning.twin.twin_loop import Member

__all__ = ["ChargingTwin"]

# A sensor without stated noise is trusted to this.
LEAST_NOISE = {"voltage_V": 1e-3, "temperature_K": 0.05, "anode_potential_V": 1e-3}
# A circuit's prediction is off by at least about this where it was not measured.
LEAST_ERROR = {"voltage_V": 3e-3, "temperature_K": 0.3, "anode_potential_V": 3e-3}
# Of the variance of that error, what an identified OCV leaves without current.
OCV_SHARE = 1.0
# Windows of the SOC in which a predicted excess is told to the search.
WINDOWS = 24


@dataclass(frozen=True)
class ChargingTwin:
    """Closed loops of ``problem`` on circuits whose R and C tables are the controller's own times exp(m).

    ``spread`` is the prior standard deviation of m, ``smooth`` the correlation of neighbouring SOC nodes. The prior knows
    nothing of the plant: it is centred on what the controller believes. ``capacity_spread`` (relative), ``soc_spread`` and
    ``ocv_spread_V`` are those of the capacity, of the SOC at the start and of a constant error of the OCV, 0 where these are known.
    Where that error is stated the OCV is taken as known but for it.
    """

    # A study's configuration is this problem already, so its identity does not hold it twice.
    problem: ChargingProblem = field(metadata={"identity": False})
    spread: float = 0.4
    smooth: float = 0.3
    capacity_spread: float = 0.0
    soc_spread: float = 0.0
    ocv_spread_V: float = 0.0

    @cached_property
    def twin(self) -> Twin:
        """Unknown tables over SOC; measured voltage, temperature and limited anode potential where the cell has them."""
        from chargetune.learning.twin.twin import Twin, Uncertain

        problem = self.problem
        belief = problem.controller_cell
        circuit = ecm_model(problem.cell, problem.controller.sampling_time_s)
        ambient = {} if self.ambient_K is None else {"ambient_K": self.ambient_K}
        model = circuit.with_parameters(**{n: getattr(belief, n) for n in belief.tables}, **ambient)
        unknowns = [Uncertain(name, self.spread, smooth=self.smooth) for name in belief.tables]
        unknowns += [Uncertain("capacity_Ah", self.capacity_spread)] if self.capacity_spread else []
        unknowns += [Uncertain("soc", self.soc_spread, "start")] if self.soc_spread else []
        unknowns += [Uncertain("voltage_V", self.ocv_spread_V, "bias")] if self.ocv_spread_V else []
        start = start_state(belief, problem.episode.soc_start) | ({} if self.ambient_K is None else {"temperature_K": self.ambient_K})
        return Twin(model, tuple(unknowns), self.noise_sd, start, self.error_sd, self.error_at_rest)

    @property
    def ambient_K(self) -> float | None:
        """Of the study's charges, also the cell's at their start; None for a cell without a temperature.

        It is what the study declares of its plant, as a chamber's operator knows it; the controller's own model keeps that of its cell.
        """
        return self.problem.context["ambient_K"] if self.problem.cell.thermal else None

    @property
    def noise_sd(self) -> dict[str, float]:
        """Of each output that is learnt from: voltage, temperature and limited anode potential where the cell has them."""
        cell, limits, sensors = self.problem.cell, self.problem.limits, self.problem.sensors
        anode = cell.anode is not None and limits.anode_min_V is not None
        names = ("voltage_V", *(["temperature_K"] if cell.thermal else []), *(["anode_potential_V"] if anode else []))
        return {name: max(sensors.noise_sd.get(name, 0.0), LEAST_NOISE[name]) for name in names}

    @property
    def error_sd(self) -> dict[str, float]:
        """By how much each of them is off at least where it was not measured."""
        return {name: LEAST_ERROR[name] for name in self.noise_sd}

    @property
    def error_at_rest(self) -> float:
        """The share of that variance without current."""
        # Of the cell's own circuit the OCV is known, and but for an unknown that is its error. Else it was identified, worst near full.
        return OCV_SHARE if self.problem.plant and not self.ocv_spread_V else 0.0

    @property
    def features(self) -> Mapping[str, tuple[float, float]]:
        """What the circuit's error depends on: SOC, current and, where it is measured, temperature."""
        problem = self.problem
        ranges = {"soc": (0.0, 1.0), "current_A": (problem.limits.current_min_A, problem.current_max_A)}
        if self.ambient_K is not None:
            ranges["temperature_K"] = (self.ambient_K, (problem.limits.temperature_max_K or self.ambient_K + 30.0) + 5.0)
        return ranges

    @property
    def controller(self) -> Controller:
        return controller_of(self.problem)

    def measured_rows(self, episode: Episode) -> NDArray[np.float64]:
        return measured_rows(self.problem, episode)

    @property
    def row_tolerances(self) -> NDArray[np.float64]:
        return row_tolerances(self.problem)

    def simulate(self, members: Sequence[Member]) -> list[Episode | None]:
        """Charges with their true outputs; the estimator reads them with the noise of the study's sensors."""
        return self._simulator.simulate(members)

    @cached_property
    def _simulator(self) -> TwinSimulator:
        from chargetune.learning.twin.simulated_twin import TwinSimulator

        # The bias of a sensor is not known; it may be an unknown of the twin.
        sensors = replace(self.problem.sensors.sensors(), bias={})
        return TwinSimulator(self.controller, self.twin, self.features, self.problem.episode.steps, sensors=sensors)

    def violation(self, episode: Episode) -> float:
        """Overshoot of the upper voltage limit beyond its tolerance, as judged, over time, mV s."""
        return violation_mVs(self.problem, episode)

    def score(self, episode: Episode) -> Score | None:
        """The verdict in `WINDOWS` of the SOC; None when a signal is not finite."""
        try:
            return score_episode(self._exact, episode, metrics=False)
        except NotMeasuredError:
            return None

    def samples(self, episode: Episode) -> dict[str, tuple[NDArray[np.float64], NDArray[np.int_]]]:
        return charge_samples(self._exact, episode)

    @cached_property
    def _exact(self) -> ChargingProblem:
        exact = stand_in(self.problem)
        return replace(exact, objective=replace(exact.objective, soc_windows=WINDOWS))

    @property
    def unpredicted(self) -> tuple[str, ...]:
        """Limits of the problem that the circuit does not predict: nothing is known of them before they are tried."""
        known = {limit.name for limit in self._exact.limits_by_name.values()}
        return tuple(limit.name for limit in self.problem.limits_by_name.values() if limit.name not in known)
