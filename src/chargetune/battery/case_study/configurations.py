"""The studies of the paper."""

from __future__ import annotations

from chargetune.battery.studies.study_file import (
    BackoffTable,
    Config,
    ControllerTable,
    RatioTable,
    StudyTable,
    ThetaTable,
    TunerName,
)

__all__ = ["case_study"]

CASE_STUDIES: dict[str, ThetaTable] = {
    "backoff": ThetaTable(backoff=BackoffTable(lower_V=0.0, upper_V=0.2)),
    "model": ThetaTable(R1=RatioTable()),
    "both": ThetaTable(backoff=BackoffTable(lower_V=0.0, upper_V=0.2), R1=RatioTable()),
}


def case_study(name: str, mismatch_seed: int, tuner: TunerName = "default", seed: int | None = None) -> Config:
    """A study of the paper: theta is the backoff, the model's R1, or both. The tuner's seed is the mismatch seed's."""
    if name not in CASE_STUDIES:
        raise ValueError(f"case study {name!r}, allowed are {', '.join(CASE_STUDIES)}")
    return Config(
        study=StudyTable(name=f"{name} seed {mismatch_seed} {tuner}", tuner=tuner, seed=mismatch_seed if seed is None else seed),
        controller=ControllerTable(mismatch_seed=mismatch_seed),
        theta=CASE_STUDIES[name],
    )
