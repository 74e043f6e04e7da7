"""A charging study as a TOML file. Its tables are the settings of the charging problem, which check themselves."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Discriminator, Field, PrivateAttr, Tag, ValidationError, field_validator

from chargetune.battery.cell.cell import PACK, PACK_MAX, Cell, default_cell, load_cell, load_cells
from chargetune.battery.cell.plating import Anode
from chargetune.battery.cell.thermal import Thermal
from chargetune.battery.charging.kalman import Kalman
from chargetune.battery.charging.limits import LimitSettings
from chargetune.battery.charging.observers import Adaptive, OffsetFree
from chargetune.battery.charging.problem import ChargingProblem
from chargetune.battery.charging.range_settings import ADDED, ChargingRangeSettings
from chargetune.battery.charging.settings import (
    FILTERS,
    ControllerSettings,
    EpisodeSettings,
    EstimatorSettings,
    Objective,
    SafetySettings,
    SensorSettings,
)
from chargetune.battery.charging.tunables import Tunables
from chargetune.battery.plants.bpx import BpxCell, read_bpx
from chargetune.battery.plants.circuit import Circuit
from chargetune.battery.plants.electrochemical import Electrochemical
from chargetune.battery.studies.file_errors import plain_errors
from chargetune.study.names import check_name

if TYPE_CHECKING:
    from chargetune.study.warm_start import Earlier

__all__ = ["Config", "TunerName", "load_config", "problem_of_document", "read_tables"]


T = TypeVar("T", bound=BaseModel)
TunerName = Literal["default", "ei", "sobol", "twin", "iterative_learning", "composite", "range"]


class _Table(BaseModel):
    # Strict: true is not the number 1, and a misspelt key is not silently the default. It holds for the dataclasses in it too.
    model_config = ConfigDict(strict=True, extra="forbid", frozen=True)


class EarlierTable(_Table):
    """An earlier study whose trials are initial data of this one: its store, a file or postgresql://..., and its name."""

    store: str = Field(min_length=1)
    """Store of the earlier study: a file, relative to the study file, or postgresql://user@host/database."""
    study: str = Field(min_length=1)
    """Name of the study in that store."""


class StudyTable(_Table):
    """What is tuned how: name in the store, tuner, number of trials, seed, trials proposed at a time, earlier studies."""

    name: str = "study"
    """Name of the study in its store."""
    tuner: TunerName = "default"
    """How the next theta is chosen; "range" needs a table [range], "twin" learns a model of the plant from charge to charge."""
    trials: int = Field(default=60, ge=1)
    """Number of trials in all."""
    seed: int = Field(default=0, ge=0)
    """Seed of everything that is drawn at random."""
    batch: int = Field(default=1, ge=1)
    """Trials that are proposed together, for as many workers."""
    earlier: list[EarlierTable] = Field(default_factory=list)
    """Earlier studies whose trials are data of this one from the start, a list of tables [[study.earlier]]."""

    @field_validator("name")
    @classmethod
    def _check_name(cls, name: str) -> str:
        return check_name(name)


class CellTable(_Table):
    """The cell of controller and plant; without a file the default cell. A pack of it has the limits of one cell, in V and A per cell."""

    file: str | None = Field(default=None, description="Cell file, relative to this file; without it the case study's cell.")
    series: int | None = Field(
        default=None, ge=1, le=PACK_MAX, description="Cells in series in a pack; every V and A in this file stays per cell. Default 1."
    )
    parallel: int | None = Field(
        default=None, ge=1, le=PACK_MAX, description="Cells in parallel in a pack; every V and A in this file stays per cell. Default 1."
    )


class PlantCellTable(_Table):
    """Another cell as plant: the controller keeps the one of [cell], whose limits hold."""

    cell: str = Field(min_length=1, description="Cell file of the plant, relative to this file; the limits in it are not used.")


def _kind_of_plant(table: object) -> str:
    return CELL_PLANT if isinstance(table, PlantCellTable) or (isinstance(table, Mapping) and "cell" in table) else MODEL_PLANT


# In the place of an error, where the kinds of a plant stand, they are left out.
CELL_PLANT, MODEL_PLANT = "<another cell>", "<electrochemical model>"
PlantTable = Annotated[
    Annotated[Electrochemical, Tag(MODEL_PLANT)] | Annotated[PlantCellTable, Tag(CELL_PLANT)], Discriminator(_kind_of_plant)
]

# What a problem is made with: those tables with the content of the files that they name.
Plant = Circuit | Electrochemical


class TwinTable(_Table):
    """What is unknown of the plant before the first trial, as standard deviations: for the tuner "twin".

    ``resistance_spread`` is that of the logarithm of every R and C, ``capacity_spread`` relative, 0 is known exactly. ``ocv_spread_V`` is
    that of a constant error of the OCV, which is taken as known but for it.
    """

    resistance_spread: float = Field(default=0.4, gt=0.0, le=2.0)
    """Standard deviation of the logarithm of every R and C."""
    capacity_spread: float = Field(default=0.0, ge=0.0, le=0.3)
    """Relative standard deviation of the capacity; 0: it is known exactly."""
    soc_spread: float = Field(default=0.0, ge=0.0, le=0.3)
    """Standard deviation of the SOC at the start; 0: it is known exactly."""
    ocv_spread_V: float = Field(default=0.0, ge=0.0, le=0.1)
    """Standard deviation of a constant error of the OCV; 0: it is known exactly."""


class Config(_Table):
    """The whole file; every table may be left out."""

    study: StudyTable = StudyTable()
    """What is tuned how."""
    cell: CellTable = CellTable()
    """The plant's cell."""
    plant: PlantTable | None = None
    """The plant, where it is not the circuit of [cell]."""
    controller: ControllerSettings = ControllerSettings()
    """The controller and what it wrongly believes."""
    estimator: EstimatorSettings = EstimatorSettings()
    """What the controller knows of the state, and how."""
    limits: LimitSettings = LimitSettings()
    """Limits of the charge."""
    episode: EpisodeSettings = EpisodeSettings()
    """One charge."""
    sensors: SensorSettings = SensorSettings()
    """Errors of what is measured."""
    objective: Objective = Objective()
    """What a charge is worth."""
    theta: Tunables = Tunables()
    """What is tuned."""
    safety: SafetySettings | None = None
    """Safe mode: only theta that are predicted to keep the limits are tried."""
    twin: TwinTable | None = None
    """What is unknown of the plant before the first trial, for the tuner "twin"."""
    range: ChargingRangeSettings | None = None
    """What differs between the cells and charges that the controller will meet."""
    _file: str = PrivateAttr(default="")

    def problem(
        self, folder: Path | None = None, *, cell: Cell | None = None, plant: Plant | None = None, range_cells: Sequence[Cell] | None = None
    ) -> ChargingProblem:
        """The charging problem; a relative file is looked for in ``folder``, and what else is given stands in for the files'.

        Raises ValueError, FileNotFoundError.
        """
        with self.named():
            return ChargingProblem(
                cell=cell or self._cell(folder),
                plant=plant or self._plant(folder),
                controller=self.controller,
                estimator=self.estimator,
                limits=self.limits,
                episode=self.episode,
                sensors=self.sensors,
                objective=self.objective,
                theta=self.theta,
                safety=self.safety,
                range=self.range,
                range_cells=self._range_cells(folder) if range_cells is None else tuple(range_cells),
            )

    @contextmanager
    def named(self) -> Iterator[None]:
        """Within it, what is refused names the file: what tables say of each other is told as what one says of itself is."""
        try:
            yield
        except FileNotFoundError as error:
            for key, file in (("cell.file", self.cell.file), ("plant.cell", getattr(self.plant, "cell", None))):
                if file and error.filename and Path(error.filename).name == Path(file).name:
                    raise FileNotFoundError(error.errno, error.strerror, f"{self._file}: {key} = {error.filename}".lstrip(": ")) from None
            raise
        except ValueError as error:
            if not self._file or type(error) is not ValueError:
                raise
            raise ValueError(f"{self._file}: {error}") from None

    def earlier(self, folder: Path | None = None) -> list[Earlier]:
        """The earlier studies; a relative file is looked for in ``folder``."""
        # Only here: it loads what reads a store.
        from chargetune.study.warm_start import Earlier

        here = Path() if folder is None else folder
        return [Earlier(e.store if "://" in e.store else here / e.store, e.study) for e in self.study.earlier]

    def document(self, folder: Path | None = None) -> dict[str, Any]:
        """What decides the trials, as JSON data for the store: the cell's numbers instead of its file, without the number of trials."""
        data = self.model_dump(mode="json")
        cell = self._cell(folder)
        data["cell"] = _cell_document(cell)
        plant = self._plant(folder)
        if isinstance(plant, Circuit):
            data["plant"] = {"cell": _cell_document(plant.cell)}
        elif plant is not None:
            data["plant"] = plant.document() if isinstance(plant, BpxCell) else asdict(plant)
        data["theta"].pop("values")
        data["study"] = {"tuner": self.study.tuner}
        # What is not given leaves no entry, that studies of before it resume.
        if self.objective.charge_time_to_soc is None:
            del data["objective"]["charge_time_to_soc"]
        for name in ("safety", "twin", "range"):
            if data[name] is None:
                del data[name]
        data |= self._range_document(folder)
        settings = self.estimator.settings
        if isinstance(settings, (OffsetFree, Adaptive)):
            # Defaults may change; what decides the trials does not.
            data["estimator"][str(self.estimator.kind)] = asdict(settings)
        absent = (
            ("controller", "current_ramp_A_s"),
            ("theta", "observer"),
            ("theta", "capacity"),
            ("theta", "current_ramp"),
            ("theta", "rbf"),
            ("theta", "schedule"),
        )
        for table, name in (*absent, *(("estimator", name) for name in FILTERS)):
            if not data[table][name]:
                del data[table][name]
        for part in ("backoff", "temperature_backoff", "anode_backoff"):
            if data["theta"][part] and not data["theta"][part]["over"]:
                del data["theta"][part]["over"]
        return data | _as_recorded(data)

    def _cell(self, folder: Path | None) -> Cell:
        table = self.cell
        cell = default_cell() if table.file is None else load_cell(_beside(folder, table.file))
        return replace(cell, series=table.series or cell.series, parallel=table.parallel or cell.parallel)

    def _range_document(self, folder: Path | None) -> dict[str, Any]:
        """The table [range] without what is not given, and the cells of the folder that it names."""
        if self.range is None:
            return {}
        table: dict[str, Any] = json.loads(json.dumps(asdict(self.range)))
        for name in ("cell", "drop_idle", "objective_quantile", *ADDED):
            if table[name] == getattr(ChargingRangeSettings(), name):
                del table[name]
        if not self.range.cells:
            return {"range": table}
        # Where the folder lies decides nothing, what is in it does.
        return {
            "range": table | {"cells": Path(self.range.cells).name},
            "range_cells": [_cell_document(one) for one in self._range_cells(folder)],
        }

    def _range_cells(self, folder: Path | None) -> tuple[Cell, ...]:
        if self.range is None or not self.range.cells:
            return ()
        try:
            return load_cells(_beside(folder, self.range.cells))
        except ValueError as error:
            raise ValueError(f"range: {error}") from None

    def _plant(self, folder: Path | None) -> Plant | None:
        plant = self.plant
        if isinstance(plant, PlantCellTable):
            return Circuit(load_cell(_beside(folder, plant.cell)))
        if plant is not None and plant.file:
            # A worker, and a later command on the store, may run where the file is not.
            return read_bpx(plant, _beside(folder, plant.file))
        return plant


def _beside(folder: Path | None, file: str) -> Path:
    return Path(file) if folder is None else folder / file


def _cell_document(cell: Cell) -> dict[str, Any]:
    data: dict[str, Any] = json.loads(json.dumps(asdict(cell)))
    for name in PACK:
        # A single cell leaves no entry, that studies of before there were packs resume.
        if data[name] == 1:
            del data[name]
    return data


# A key at the top that only another kind of file has, the model of that kind, and what to do with it.
OTHER_FILES = {
    "campaign": ("CampaignFile", "a campaign file, which `chargetune campaign` takes"),
    "capacity_Ah": ("", "a cell file; a study names it in its table [cell], file = ..."),
    "study": ("Config", "a study file, which `chargetune tune` takes; a campaign names it in [campaign], configs = [...]"),
}

# Numbers of `OffsetFree` in older files and stores, and what to write instead: 2 acted at 10 s and the largest current as 0.15 does.
REPLACED = {"resistance_rate": "resistance_drift replaced it, a random walk over the SOC that holds for every sampling time (default 0.15)"}

# What older files and stores call the kind of the estimator.
OVERPOTENTIAL = {"model": "open_loop", "exact": "exact"}


def _as_recorded(data: Mapping[str, Any]) -> dict[str, Any]:
    """The tables of controller and estimator as studies of before ``estimator.kind`` have them, that those resume."""
    controller, estimator = data["controller"], {**data["estimator"]}
    kind = estimator["kind"]
    if kind in ("offset_free", "adaptive"):
        return {}
    del estimator["kind"]
    filters = {"kalman": estimator.get("kalman") or (asdict(Kalman()) if kind == "kalman" else None)}
    old = {"overpotential": next((old for old, new in OVERPOTENTIAL.items() if new == kind), "model")}
    return {"controller": {**controller, **old}, "estimator": {**estimator, **filters}}


def _migrated(data: dict[str, Any]) -> dict[str, Any]:
    """Tables of an older file or store with ``estimator.kind`` instead of ``controller.overpotential`` and a table [estimator.kalman]."""
    _check_replaced(data)
    controller, estimator = data.get("controller"), data.get("estimator", {})
    if not isinstance(estimator, dict):
        return data
    if not isinstance(controller, dict) or "overpotential" not in controller:
        return data
    old = controller["overpotential"]
    if "kind" in estimator:
        raise ValueError(f"controller.overpotential = {old!r} and estimator.kind = {estimator['kind']!r} are given, allowed is one of them")
    if not isinstance(old, str) or old not in OVERPOTENTIAL:
        raise ValueError(f"controller.overpotential = {old!r}, allowed is 'model' or 'exact'; it is estimator.kind today")
    kind = "kalman" if estimator.get("kalman") is not None else OVERPOTENTIAL[old]
    rest = {name: value for name, value in controller.items() if name != "overpotential"}
    return data | {"controller": rest, "estimator": {"kind": kind, **estimator}}


def _check_replaced(data: Mapping[str, Any]) -> None:
    """Refuse what another key with another meaning took the place of: its value says nothing about that one's."""
    observer, theta = (data.get(name) for name in ("estimator", "theta"))
    settings = observer.get("offset_free") if isinstance(observer, Mapping) else None
    tuned = theta.get("observer") if isinstance(theta, Mapping) else None
    names = [part.get("name") for part in tuned if isinstance(part, Mapping)] if isinstance(tuned, list) else []
    for old, new in REPLACED.items():
        if isinstance(settings, Mapping) and old in settings:
            raise ValueError(f"estimator.offset_free.{old} = {settings[old]!r} is no key any more; {new}")
        if old in names:
            raise ValueError(f"theta.observer names {old!r}, which is no number of the estimator any more; {new}")


def problem_of_document(document: Mapping[str, Any]) -> ChargingProblem:
    """The problem of a stored study, from what `Config.document` recorded."""
    tables = {name: table for name, table in document.items() if name not in ("cell", "study", "range_cells")}
    plant = tables.get("plant")
    made: Plant | None = None
    if isinstance(plant, Mapping) and "cell" in plant:
        made = Circuit(_cell_of_document(tables.pop("plant")["cell"]))
    elif isinstance(plant, Mapping) and "content" in plant:
        made = BpxCell.of_document(tables.pop("plant"))
    config = Config.model_validate_json(json.dumps(_migrated(tables)))
    # A store of before the content was kept has the path, which is read when the plant is built.
    by_path = config.plant if isinstance(config.plant, Electrochemical) else None
    cells = [_cell_of_document(one) for one in document.get("range_cells", ())]
    return config.problem(cell=_cell_of_document(document["cell"]), plant=made or by_path, range_cells=cells)


def _cell_of_document(data: Mapping[str, Any]) -> Cell:
    cell = _tuples(data)
    for name, make in (("thermal", Thermal), ("anode", Anode)):
        cell[name] = make(**_tuples(cell[name])) if cell.get(name) else None
    return Cell(**cell)


def _tuples(table: Mapping[str, Any]) -> dict[str, Any]:
    return {name: tuple(value) if isinstance(value, list) else value for name, value in table.items()}


def load_config(path: str | Path) -> Config:
    """Read a study file. Raises FileNotFoundError, and ValueError naming file, field, value and what is allowed."""
    config = read_tables(path, Config)
    config._file = str(path)  # noqa: SLF001 - its own
    return config


def read_tables(path: str | Path, model: type[T]) -> T:
    """Read a TOML file of this form. Raises as `load_config`."""
    try:
        data = tomllib.loads(Path(path).read_bytes().decode("utf-8-sig"))
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ValueError(f"{path} is not valid TOML: {error}") from error
    if model is Config:
        try:
            data = _migrated(data)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None
    try:
        # A dataclass is made from a table of JSON, but in strict mode not from a dict. JSON has no dates, and no key here is one.
        return model.model_validate_json(json.dumps(data, default=lambda date: {"date": str(date)}))
    except ValidationError as error:
        lines = [f"{path}: {line}" for line in plain_errors(error.errors(), model)]
        other = next((said for key, (kind, said) in OTHER_FILES.items() if key in data and model.__name__ != kind), None)
        raise ValueError("\n".join([f"{path}: {other}"] if other else lines)) from None
