"""A campaign file: which study files are tuned with which seeds."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field

__all__ = ["CampaignFile", "CampaignTable"]


class CampaignTable(BaseModel):
    """Study files, seeds, trials of each study; with ``mismatch_from_seed`` a seed also draws the controller's wrong model."""

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True)

    configs: list[str] = Field(min_length=1)
    """Study files, relative to the campaign file; at least one."""
    seeds: str | list[int] = Field(default="0:1")
    """Seeds of each study: a list of whole numbers, or "A:B" for A to B - 1."""
    trials: int | None = Field(default=None, ge=1)
    """Trials of each study; not given: the number in the study file."""
    mismatch_from_seed: bool = False
    """Whether the seed also draws the controller's wrong model (controller.mismatch_seed)."""


class CampaignFile(BaseModel):
    """The whole file."""

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True)

    campaign: CampaignTable
    """The studies of the campaign."""
