"""A charging study as a TOML file: types and names are checked here, values where they are used."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from chargetune.battery.cell import Cell, default_cell, load_cell
from chargetune.battery.charging import Backoff, ChargingProblem, ResistanceRatio
from chargetune.plants.sensors import Sensors

__all__ = ["CASE_STUDIES", "Config", "case_study", "load_config", "problem_of_document"]


class _Table(BaseModel):
    # Strict: true is not the number 1, and a misspelt key is not silently the default.
    model_config = ConfigDict(strict=True, extra="forbid", frozen=True)


class StudyTable(_Table):
    """What is tuned how: name in the store, tuner, number of trials, seed, trials proposed at a time."""

    name: str = Field(default="study", min_length=1, max_length=200)
    tuner: Literal["default", "ei", "sobol"] = "default"
    trials: int = Field(default=60, ge=1)
    seed: int = Field(default=0, ge=0)
    batch: int = Field(default=1, ge=1)


class CellTable(_Table):
    """The plant's cell; without a file the default cell."""

    file: str | None = None


class ControllerTable(_Table):
    """The controller and what it wrongly believes; no ``mismatch_seed`` means that it knows the cell."""

    sampling_time_s: float = 10.0
    horizon: int = 5
    mismatch_seed: int | None = None
    overpotential: Literal["model", "exact"] = "model"
    penalty_per_V: float = 1e3


class LimitsTable(_Table):
    """Limits; what is not given comes from the cell."""

    current_min_A: float = 0.0
    current_max_A: float | None = None
    voltage_min_V: float | None = None
    voltage_max_V: float | None = None
    tolerance_V: float = 5e-4


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
    soc_noise_sd: float = 0.0
    soc_bias: float = 0.0
    delay_steps: int = 0


class ObjectiveTable(_Table):
    """c1 of the paper's scalar performance G; SOC windows in which the voltage excess is told to the tuner."""

    c1: float = 1e-5
    soc_windows: int = 5


class BackoffTable(_Table):
    """Spline nodes of the voltage backoff as part of theta."""

    nodes: int = 7
    lower_V: float = -0.25
    upper_V: float = 0.25
    at: Literal["measured", "predicted"] = "measured"


class RatioTable(_Table):
    """Node values of a resistance as part of theta, as ratio to the controller's own."""

    lower: float = 0.1
    upper: float = 6.0


class ThetaTable(_Table):
    """What theta consists of, and values for it to simulate with."""

    backoff: BackoffTable | None = None
    R0: RatioTable | None = None
    R1: RatioTable | None = None
    values: dict[str, float | list[float]] = Field(default_factory=dict)


class Config(_Table):
    """The whole file; every table may be left out."""

    study: StudyTable = StudyTable()
    cell: CellTable = CellTable()
    controller: ControllerTable = ControllerTable()
    limits: LimitsTable = LimitsTable()
    episode: EpisodeTable = EpisodeTable()
    sensors: SensorTable = SensorTable()
    objective: ObjectiveTable = ObjectiveTable()
    theta: ThetaTable = ThetaTable()

    def problem(self, folder: Path | None = None, *, cell: Cell | None = None) -> ChargingProblem:
        """The charging problem; a relative cell file is looked for in ``folder``, ``cell`` stands in for the file's.

        Raises ValueError, FileNotFoundError.
        """
        theta = self.theta
        ratios = [ResistanceRatio("R0", theta.R0.lower, theta.R0.upper)] if theta.R0 else []
        ratios += [ResistanceRatio("R1", theta.R1.lower, theta.R1.upper)] if theta.R1 else []
        sensors = Sensors(
            noise_sd={"voltage_V": self.sensors.voltage_noise_sd_V, "soc": self.sensors.soc_noise_sd},
            bias={"voltage_V": self.sensors.voltage_bias_V, "soc": self.sensors.soc_bias},
            resolution={"voltage_V": self.sensors.voltage_resolution_V},
            delay_steps=self.sensors.delay_steps,
        )
        return ChargingProblem(
            plant_cell=cell or self._cell(folder),
            backoff=Backoff(**theta.backoff.model_dump()) if theta.backoff else None,
            ratios=tuple(ratios),
            sensors=sensors,
            **self.objective.model_dump(),
            **self.controller.model_dump(),
            **self.limits.model_dump(),
            **self.episode.model_dump(),
        )

    def values(self, problem: ChargingProblem) -> NDArray[np.float64]:
        """theta as the file gives it; what it does not name is untuned."""
        return problem.space.from_dict(dict(self.theta.values))

    def document(self, folder: Path | None = None) -> dict[str, Any]:
        """What decides the trials, as JSON data for the store: the cell's numbers instead of its file, without the number of trials."""
        data = self.model_dump(mode="json")
        cell = self._cell(folder)
        data["cell"] = {name: list(v) if isinstance(v := getattr(cell, name), tuple) else v for name in cell.__dataclass_fields__}
        data["theta"].pop("values")
        data["study"] = {"tuner": self.study.tuner}
        return data

    def _cell(self, folder: Path | None) -> Cell:
        if self.cell.file is None:
            return default_cell()
        return load_cell(Path(self.cell.file) if folder is None else folder / self.cell.file)


def problem_of_document(document: Mapping[str, Any]) -> ChargingProblem:
    """The problem of a stored study, from what `Config.document` recorded."""
    cell: dict[str, Any] = {name: tuple(value) if isinstance(value, list) else value for name, value in document["cell"].items()}
    tables = {name: table for name, table in document.items() if name not in ("cell", "study")}
    return Config.model_validate(tables).problem(cell=Cell(**cell))


def load_config(path: str | Path) -> Config:
    """Read a study file. Raises FileNotFoundError, and ValueError naming file, field, value and what is allowed."""
    try:
        data = tomllib.loads(Path(path).read_bytes().decode("utf-8-sig"))
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ValueError(f"{path} is not valid TOML: {error}") from error
    try:
        return Config.model_validate(data)
    except ValidationError as error:
        raise ValueError("\n".join(f"{path}: {_plain(problem)}" for problem in error.errors())) from None


def _plain(problem: Any) -> str:
    field = ".".join(str(part) for part in problem["loc"])
    if problem["type"] == "extra_forbidden":
        return f"{field} is not a known key"
    return f"{field} = {problem['input']!r}: {problem['msg'].lower()}"


CASE_STUDIES: dict[str, ThetaTable] = {
    "backoff": ThetaTable(backoff=BackoffTable(lower_V=0.0, upper_V=0.2)),
    "model": ThetaTable(R1=RatioTable()),
    "both": ThetaTable(backoff=BackoffTable(lower_V=0.0, upper_V=0.2), R1=RatioTable()),
}


def case_study(name: str, mismatch_seed: int, tuner: Literal["default", "ei", "sobol"] = "default", seed: int | None = None) -> Config:
    """A study of the paper: theta is the backoff, the model's R1, or both. The tuner's seed is the mismatch seed's."""
    if name not in CASE_STUDIES:
        raise ValueError(f"case study {name!r}, allowed are {', '.join(CASE_STUDIES)}")
    return Config(
        study=StudyTable(name=f"{name} seed {mismatch_seed} {tuner}", tuner=tuner, seed=mismatch_seed if seed is None else seed),
        controller=ControllerTable(mismatch_seed=mismatch_seed),
        theta=CASE_STUDIES[name],
    )
