"""The studies of the papers."""

from __future__ import annotations

from chargetune.battery.charging.radial_basis import RadialBasis
from chargetune.battery.charging.settings import ControllerSettings
from chargetune.battery.charging.tunables import Backoff, ResistanceRatio, Tunables
from chargetune.battery.studies.study_file import Config, StudyTable, TunerName

__all__ = ["CASE_STUDIES", "case_study"]

CASE_STUDIES: dict[str, Tunables] = {
    "backoff": Tunables(backoff=Backoff(lower_V=0.0, upper_V=0.2)),
    "model": Tunables(R1=ResistanceRatio()),
    "both": Tunables(backoff=Backoff(lower_V=0.0, upper_V=0.2), R1=ResistanceRatio()),
    "rbf": Tunables(rbf=RadialBasis()),
}


def case_study(name: str, mismatch_seed: int, tuner: TunerName = "default", seed: int | None = None) -> Config:
    """A study of the papers: theta is backoff, R1, both, or a radial-basis stage cost. The tuner's seed is the mismatch seed's."""
    if name not in CASE_STUDIES:
        raise ValueError(f"case study {name!r}, allowed are {', '.join(CASE_STUDIES)}")
    return Config(
        study=StudyTable(name=f"{name} seed {mismatch_seed} {tuner}", tuner=tuner, seed=mismatch_seed if seed is None else seed),
        controller=ControllerSettings(mismatch_seed=mismatch_seed),
        theta=CASE_STUDIES[name],
    )
