"""A charging study as a TOML file: types and names are checked here, values where they are used."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from chargetune.battery.cell.cell import Cell, default_cell, load_cell
from chargetune.battery.cell.plating import Anode
from chargetune.battery.cell.thermal import Thermal
from chargetune.battery.charging.kalman import Kalman
from chargetune.battery.charging.problem import ChargingProblem
from chargetune.battery.charging.tunables import Backoff, CurrentLimit, LimitBackoff, MeasurementSpread, ResistanceRatio
from chargetune.battery.plants.electrochemical import Electrochemical
from chargetune.plants.sensors import Sensors
from chargetune.study.warm_start import Earlier

__all__ = ["Config", "TunerName", "load_config", "problem_of_document", "read_tables"]


T = TypeVar("T", bound=BaseModel)
TunerName = Literal["default", "ei", "sobol", "twin", "iterative_learning", "composite"]
RESISTANCES: tuple[Literal["R0", "R1", "R2", "R3"], ...] = ("R0", "R1", "R2", "R3")


class _Table(BaseModel):
    # Strict: true is not the number 1, and a misspelt key is not silently the default.
    model_config = ConfigDict(strict=True, extra="forbid", frozen=True)


class EarlierTable(_Table):
    """An earlier study whose trials are initial data of this one: its store, a file or postgresql://..., and its name."""

    store: str = Field(min_length=1)
    study: str = Field(min_length=1)


class StudyTable(_Table):
    """What is tuned how: name in the store, tuner, number of trials, seed, trials proposed at a time, earlier studies."""

    name: str = Field(default="study", min_length=1, max_length=200)
    tuner: TunerName = "default"
    trials: int = Field(default=60, ge=1)
    seed: int = Field(default=0, ge=0)
    batch: int = Field(default=1, ge=1)
    earlier: list[EarlierTable] = Field(default_factory=list)


class CellTable(_Table):
    """The plant's cell; without a file the default cell."""

    file: str | None = None


class PlantTable(_Table):
    """Another plant than the cell's own circuit: an electrochemical model; the cell is then what the controller knows."""

    model: Literal["SPM", "SPMe", "DFN"] = "DFN"
    parameters: str = "OKane2022"
    ambient_K: float = 298.15
    cooling_W_m2K: float = 10.0
    capacity_scale: float = 1.0
    resistance_scale: float = 1.0
    mesh: Literal["coarse", "default"] = "coarse"


class ControllerTable(_Table):
    """The controller and what it wrongly believes; no ``mismatch_seed`` means that it knows the cell."""

    sampling_time_s: float = 10.0
    horizon: int = 5
    mismatch_seed: int | None = None
    overpotential: Literal["model", "exact"] = "model"
    penalty_per_V: float = 1e3


class KalmanTable(_Table):
    """Extended Kalman filter on voltage, current and temperature instead of a measured SOC."""

    voltage_sd_V: float = 0.05
    temperature_sd_K: float = 0.3
    soc_start_sd: float = 0.02
    soc_process_sd: float = 1e-5
    overpotential_process_sd_V: float = 1e-4
    temperature_process_sd_K: float = 0.05


class EstimatorTable(_Table):
    """What the controller knows of the state: the error of its SOC at the start, and a filter."""

    soc_start_error: float = 0.0
    kalman: KalmanTable | None = None


class LimitsTable(_Table):
    """Limits; what is not given comes from the cell, or is no limit.

    ``hard`` and ``scored_only`` name limits that the controller keeps at any price, or does not see.
    """

    current_min_A: float = 0.0
    current_max_A: float | None = None
    voltage_min_V: float | None = None
    voltage_max_V: float | None = None
    tolerance_V: float = 5e-4
    temperature_max_K: float | None = None
    tolerance_K: float = 0.05
    anode_min_V: float | None = None
    tolerance_anode_V: float = 5e-4
    hard: list[str] = Field(default_factory=list)
    scored_only: list[str] = Field(default_factory=list)


class EpisodeTable(_Table):
    """One charge."""

    steps: int = 360
    soc_start: float = 0.05
    soc_target: float = 1.0


class SensorTable(_Table):
    """Imperfect measurement of the simulated plant."""

    voltage_noise_sd_V: float = 0.0
    voltage_bias_V: float = 0.0
    voltage_resolution_V: float = 0.0
    temperature_noise_sd_K: float = 0.0
    temperature_bias_K: float = 0.0
    soc_noise_sd: float = 0.0
    soc_bias: float = 0.0
    delay_steps: int = 0

    def by_signal(self, what: Literal["noise_sd", "bias"]) -> dict[str, float]:
        """The errors that are not zero, by signal; a plant need not have the others."""
        signals = {"voltage_V": f"voltage_{what}_V", "temperature_K": f"temperature_{what}_K", "soc": f"soc_{what}"}
        return {signal: value for signal, field in signals.items() if (value := getattr(self, field))}


class ObjectiveTable(_Table):
    """c1 of the paper's scalar performance G; the SOC to which the time of charge is minimised, else the mean squared lack of charge.

    SOC windows in which an excess is told to the tuner; intervals in its moving mean.
    """

    c1: float = 1e-5
    charge_time_to_soc: float | None = None
    soc_windows: int = 5
    verdict_samples: int = 1


class BackoffTable(_Table):
    """Spline nodes of the voltage backoff as part of theta."""

    nodes: int = 7
    lower_V: float = -0.25
    upper_V: float = 0.25
    at: Literal["measured", "predicted"] = "measured"


class RatioTable(_Table):
    """A resistance as part of theta, as ratio to the controller's own: one a node, or ``scale = true`` one for all."""

    lower: float = 0.1
    upper: float = 6.0
    scale: bool = False


class CurrentLimitTable(_Table):
    """Spline nodes of a current limit over SOC as part of theta, as shares of the largest current."""

    nodes: int = 6
    lower: float = 0.1


class LimitBackoffTable(_Table):
    """A margin to the temperature limit (K) or to the anode potential's (V) as part of theta."""

    lower: float
    upper: float
    nodes: int = 1


class SpreadTable(_Table):
    """The voltage's standard deviation in the Kalman filter as part of theta; the default is the filter's own."""

    lower_V: float = 1e-3
    upper_V: float = 0.2


class ThetaTable(_Table):
    """What theta consists of, and values for it to simulate with."""

    backoff: BackoffTable | None = None
    R0: RatioTable | None = None
    R1: RatioTable | None = None
    R2: RatioTable | None = None
    R3: RatioTable | None = None
    current_limit: CurrentLimitTable | None = None
    temperature_backoff: LimitBackoffTable | None = None
    anode_backoff: LimitBackoffTable | None = None
    voltage_sd: SpreadTable | None = None
    values: dict[str, float | list[float]] = Field(default_factory=dict)


class SafetyTable(_Table):
    """Safe learning by the twin: what must be likely, where to begin, what may be spent, when an episode is ended.

    ``start`` holds values of theta by name, like [theta.values]; without it the most cautious corner is the start.
    """

    probability: float = 0.95
    start: dict[str, float | list[float]] | None = None
    budget_mVs: float | None = None
    abort_margin_V: float | None = 0.02
    abort_margin_K: float | None = 2.0


class TwinTable(_Table):
    """What is unknown of the plant before the first trial, as standard deviations: for the tuner "twin".

    ``resistance_spread`` is that of the logarithm of every R and C, ``capacity_spread`` relative, 0 is known exactly. ``ocv_spread_V`` is
    that of a constant error of the OCV, which is taken as known but for it.
    """

    resistance_spread: float = Field(default=0.4, gt=0.0, le=2.0)
    capacity_spread: float = Field(default=0.0, ge=0.0, le=0.3)
    soc_spread: float = Field(default=0.0, ge=0.0, le=0.3)
    ocv_spread_V: float = Field(default=0.0, ge=0.0, le=0.1)


class Config(_Table):
    """The whole file; every table may be left out."""

    study: StudyTable = StudyTable()
    cell: CellTable = CellTable()
    plant: PlantTable | None = None
    controller: ControllerTable = ControllerTable()
    estimator: EstimatorTable = EstimatorTable()
    limits: LimitsTable = LimitsTable()
    episode: EpisodeTable = EpisodeTable()
    sensors: SensorTable = SensorTable()
    objective: ObjectiveTable = ObjectiveTable()
    theta: ThetaTable = ThetaTable()
    safety: SafetyTable | None = None
    twin: TwinTable | None = None

    def problem(self, folder: Path | None = None, *, cell: Cell | None = None) -> ChargingProblem:
        """The charging problem; a relative cell file is looked for in ``folder``, ``cell`` stands in for the file's.

        Raises ValueError, FileNotFoundError.
        """
        theta, kalman = self.theta, self.estimator.kalman
        ratios = [ResistanceRatio(of, **table.model_dump()) for of in RESISTANCES if (table := getattr(theta, of))]
        margins = {"temperature": theta.temperature_backoff, "anode": theta.anode_backoff}
        sensors = Sensors(
            noise_sd=self.sensors.by_signal("noise_sd"),
            bias=self.sensors.by_signal("bias"),
            resolution={"voltage_V": self.sensors.voltage_resolution_V},
            delay_steps=self.sensors.delay_steps,
        )
        filter_ = Kalman(**kalman.model_dump()) if kalman else None
        if theta.voltage_sd and filter_ is None:
            raise ValueError("theta.voltage_sd is given without a table [estimator.kalman]")
        return ChargingProblem(
            plant_cell=cell or self._cell(folder),
            backoff=Backoff(**theta.backoff.model_dump()) if theta.backoff else None,
            ratios=tuple(ratios),
            limit_backoffs=tuple(LimitBackoff(of, **table.model_dump()) for of, table in margins.items() if table),  # type: ignore[arg-type]
            current_limit=CurrentLimit(**theta.current_limit.model_dump()) if theta.current_limit else None,
            voltage_spread=MeasurementSpread(**theta.voltage_sd.model_dump(), default_V=filter_.voltage_sd_V)
            if theta.voltage_sd and filter_
            else None,
            kalman=filter_,
            plant_model=Electrochemical(**self.plant.model_dump()) if self.plant else None,
            soc_start_error=self.estimator.soc_start_error,
            sensors=sensors,
            hard=tuple(self.limits.hard),
            scored_only=tuple(self.limits.scored_only),
            abort_margin_V=self.safety.abort_margin_V if self.safety else None,
            abort_margin_K=self.safety.abort_margin_K if self.safety else None,
            **self.objective.model_dump(),
            **self.controller.model_dump(),
            **self.limits.model_dump(exclude={"hard", "scored_only"}),
            **self.episode.model_dump(),
        )

    def values(self, problem: ChargingProblem) -> NDArray[np.float64]:
        """theta as the file gives it; what it does not name is untuned."""
        return problem.space.from_dict(dict(self.theta.values))

    def safe_start(self, problem: ChargingProblem) -> NDArray[np.float64] | None:
        """The theta that the file declares safe."""
        start = self.safety.start if self.safety else None
        return None if start is None else problem.space.from_dict(dict(start))

    def earlier(self, folder: Path | None = None) -> list[Earlier]:
        """The earlier studies; a relative file is looked for in ``folder``."""
        here = Path() if folder is None else folder
        return [Earlier(e.store if "://" in e.store else here / e.store, e.study) for e in self.study.earlier]

    def document(self, folder: Path | None = None) -> dict[str, Any]:
        """What decides the trials, as JSON data for the store: the cell's numbers instead of its file, without the number of trials."""
        data = self.model_dump(mode="json")
        cell = self._cell(folder)
        data["cell"] = json.loads(json.dumps(asdict(cell)))
        data["theta"].pop("values")
        data["study"] = {"tuner": self.study.tuner}
        # What is not given leaves no entry, that studies of before it resume.
        if self.objective.charge_time_to_soc is None:
            del data["objective"]["charge_time_to_soc"]
        for name in ("safety", "twin"):
            if data[name] is None:
                del data[name]
        return data

    def _cell(self, folder: Path | None) -> Cell:
        if self.cell.file is None:
            return default_cell()
        return load_cell(Path(self.cell.file) if folder is None else folder / self.cell.file)


def problem_of_document(document: Mapping[str, Any]) -> ChargingProblem:
    """The problem of a stored study, from what `Config.document` recorded."""
    cell = _tuples(document["cell"])
    for name, make in (("thermal", Thermal), ("anode", Anode)):
        cell[name] = make(**_tuples(cell[name])) if cell.get(name) else None
    tables = {name: table for name, table in document.items() if name not in ("cell", "study")}
    return Config.model_validate(tables).problem(cell=Cell(**cell))


def _tuples(table: Mapping[str, Any]) -> dict[str, Any]:
    return {name: tuple(value) if isinstance(value, list) else value for name, value in table.items()}


def load_config(path: str | Path) -> Config:
    """Read a study file. Raises FileNotFoundError, and ValueError naming file, field, value and what is allowed."""
    return read_tables(path, Config)


def read_tables(path: str | Path, model: type[T]) -> T:
    """Read a TOML file of this form. Raises as `load_config`."""
    try:
        data = tomllib.loads(Path(path).read_bytes().decode("utf-8-sig"))
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ValueError(f"{path} is not valid TOML: {error}") from error
    try:
        return model.model_validate(data)
    except ValidationError as error:
        raise ValueError("\n".join(f"{path}: {_plain(problem)}" for problem in error.errors())) from None


def _plain(problem: Any) -> str:
    field = ".".join(str(part) for part in problem["loc"])
    if problem["type"] == "extra_forbidden":
        return f"{field} is not a known key"
    return f"{field} = {problem['input']!r}: {problem['msg'].lower()}"
