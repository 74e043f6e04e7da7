"""Export of a store: trials and traces as Parquet or CSV, traces with the column names of the Battery Data Format (BDF)."""

from __future__ import annotations

import io
import json
import os
import re
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from chargetune.episode.episode import Episode
from chargetune.learning.range_of_use.range_trace import RangeTrace
from chargetune.study.dataframe import trials_dataframe
from chargetune.study.files import write_whole
from chargetune.study.result import read_result
from chargetune.study.serialization import space_from_json
from chargetune.study.store.store import Store, StoreError, StudyRecord
from chargetune.study.trial import Trial

__all__ = ["Exported", "Format", "bdf_columns", "export", "planned_files"]

Format = Literal["parquet", "csv"]
# What follows the name of a trial in those of its files.
ENDINGS = (".bdf", ".median.bdf", ".best.bdf", ".plants")
# Signal of this library -> BDF's name and what is added for its unit.
BDF = {"current_A": ("Current / A", 0.0), "voltage_V": ("Voltage / V", 0.0), "temperature_K": ("Surface Temperature / degC", -273.15)}


@dataclass(frozen=True)
class Exported:
    """The files that were written, and which traces were left out and why."""

    files: tuple[Path, ...]
    left: tuple[str, ...]


def bdf_columns(episode: Episode) -> dict[str, NDArray[Any]]:
    """One row an interval, at its end: time, inputs that flowed since the row before, outputs; each (K,).

    Further columns that BDF leaves free: the outputs at the start of the interval, right after the input jumped
    (``voltage at start / V``), for simulations those without noise (``voltage without noise / V``), the controller's estimate at
    the start and its `SolveStatus`.
    """
    table: dict[str, NDArray[Any]] = {"Test Time / s": episode.time_s + episode.sampling_time_s}
    for i, (name, unit) in enumerate(zip(episode.input_names, episode.input_units, strict=True)):
        table |= _column(name, unit, episode.input[:, i])
    outputs = list(enumerate(zip(episode.output_names, episode.output_units, strict=True)))
    for i, (name, unit) in outputs:
        table |= _column(name, unit, episode.output_end[:, i])
    for kind, values in (
        ("at start", episode.output_start),
        ("without noise", episode.true_end),
        ("without noise at start", episode.true_start),
    ):
        if values is not None:
            table |= {f"{_bare(name, unit)} {kind} / {unit}": values[:, i] for i, (name, unit) in outputs}
    table |= {f"estimate of {name}": episode.estimate[:, i] for i, name in enumerate(episode.estimate_names)}
    return {**table, "solver status / 1": episode.status}


def export(
    store: Store,
    folder: str | os.PathLike[str],
    *,
    study: str | None = None,
    form: Format = "parquet",
    step: Callable[[int, int], None] | None = None,
) -> Exported:
    """Write each study, or the one named, into a folder of its own below ``folder``.

    ``study.json``: identity, versions and result; ``trials.parquet``: one row a trial; ``trial-0007.bdf.parquet``: its trace. Of a trial
    over a range of use the trace is that of the worst plant; ``trial-0007.median.bdf.parquet`` and ``.best.bdf.parquet`` are those of two
    more, ``trial-0007.plants.parquet`` has one row a drawn plant (`RangeTrace`). The trials of earlier studies (D_0) are among them with
    numbers below 0, as ``earlier-0003``. Existing files of these names are replaced.

    Raises ImportError without pandas (and pyarrow), StoreError for a study that is not there.
    """
    _need(form)
    records, work = _work(store, study)
    total, done = sum(len(trials) for _, trials in work), 0
    files: list[Path] = []
    left: list[str] = []
    for record, trials in work:
        place = Path(folder) / _folder_name(record, records)
        place.mkdir(parents=True, exist_ok=True)
        about = {"name": record.name, "created_at": record.created_at, "versions": record.versions, "identity": record.identity}
        about["result"] = read_result(store, record).facts()
        files.append(write_whole(place / "study.json", json.dumps(about, indent=1, ensure_ascii=False)))
        frame = trials_dataframe(space_from_json(record.identity["space"]), trials)
        frame["seed"], frame["trace_sha256"] = [t.seed for t in trials], [t.trace_sha256 for t in trials]
        files.append(_write(frame.reset_index(), place / "trials", form))
        for trial in trials:
            try:
                tables = _traces(store, record, trial)
            except (StoreError, ValueError) as error:
                left.append(f"study {record.name!r}, trial {trial.number}: {error}")
            else:
                files += [_write(table, place / f"{_trial_name(trial)}{ending}", form) for ending, table in tables.items()]
            done += 1
            if step is not None:
                step(done, total)
    return Exported(tuple(files), tuple(left))


def planned_files(store: Store, folder: str | os.PathLike[str], *, study: str | None = None, form: Format = "parquet") -> list[Path]:
    """The files that `export` may write: a trace says itself whether it is one of a range of use, and it may be damaged."""
    records, work = _work(store, study)
    files: list[Path] = []
    for record, trials in work:
        place = Path(folder) / _folder_name(record, records)
        files += [place / "study.json", place / f"trials.{form}"]
        traced = [_trial_name(trial) for trial in trials if trial.trace_sha256 is not None]
        files += [place / f"{name}{ending}.{form}" for name in traced for ending in ENDINGS]
    return files


def _work(store: Store, study: str | None) -> tuple[list[StudyRecord], list[tuple[StudyRecord, list[Trial]]]]:
    records = store.studies() if study is None else [store.study(study)]
    return records, [(record, [*store.earlier(record.id), *store.trials(record.id)]) for record in records]


def _trial_name(trial: Trial) -> str:
    return f"trial-{trial.number:04d}" if trial.number >= 0 else f"earlier-{-trial.number:04d}"


def _need(form: Format) -> None:
    missing = [name for name in ("pandas", *(["pyarrow"] if form == "parquet" else [])) if find_spec(name) is None]
    if missing:
        raise ImportError(f"export as {form} needs {' and '.join(missing)}: pip install 'chargetune[export]'")


def _traces(store: Store, record: StudyRecord, trial: Trial) -> dict[str, Any]:
    """The tables of one trial by `ENDINGS`."""
    import pandas as pd

    trace = store.trace(record.id, trial.number)
    if trace is None:
        return {}
    try:
        spread = RangeTrace.from_arrays(*trace)
        episodes = [Episode.from_arrays(*trace)] if spread is None else [spread.worst, spread.median, spread.best]
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError("its trace is no episode of this library, but the caller's own; it is left out") from error
    tables = [bdf_columns(episode) for episode in episodes] + ([] if spread is None else [dict(spread.plants)])
    return {ending: pd.DataFrame(table) for ending, table in zip(ENDINGS, tables, strict=False)}


def _write(frame: Any, path: Path, form: Format) -> Path:
    content = io.BytesIO()
    if form == "csv":
        frame.to_csv(content, index=False)
    else:
        frame.to_parquet(content, index=False)
    return write_whole(path.with_name(f"{path.name}.{form}"), content.getvalue())


def _column(name: str, unit: str, values: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
    label, offset = BDF.get(name, (f"{_bare(name, unit)} / {unit}", 0.0))
    return {label: values + offset}


def _bare(name: str, unit: str) -> str:
    return name.removesuffix(f"_{unit}")


def _folder_name(record: StudyRecord, records: list[StudyRecord]) -> str:
    # Names of studies may have characters that a file system refuses, and differ in case alone.
    names = {r.id: re.sub(r"[^\w .,+=@()-]+", "_", r.name).strip(" .") for r in records}
    alike = [r for r in records if names[r.id].lower() == names[record.id].lower()]
    return names[record.id] if len(alike) == 1 else f"{names[record.id]}-{record.id}"
