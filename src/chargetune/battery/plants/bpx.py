"""A plant of a BPX file with the file's content in it, so that a store and a worker need no file."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from chargetune.battery.plants.electrochemical import Electrochemical

__all__ = ["BpxCell", "read_bpx"]


@dataclass(frozen=True)
class BpxCell(Electrochemical):
    """`Electrochemical` with the content of its BPX file.

    parameters
        Name of the file, without its folder.
    content
        What stands in it: JSON with sorted keys, that spaces and the order of entries make no other plant.
    """

    content: str = ""

    def bpx(self) -> Any:
        return json.loads(self.content)

    @classmethod
    def of_document(cls, table: Mapping[str, Any]) -> BpxCell:
        """What `document` recorded."""
        return cls(**{**table, "content": json.dumps(table["content"], sort_keys=True)})

    def document(self) -> dict[str, Any]:
        """As JSON data for the store."""
        return {**asdict(self), "content": self.bpx()}


def read_bpx(settings: Electrochemical, path: Path) -> BpxCell:
    """The plant of the BPX file at ``path``, with the other numbers of ``settings``. Raises ValueError, FileNotFoundError."""
    try:
        content = json.loads(path.read_bytes().decode("utf-8-sig"))
    except ValueError as error:
        raise ValueError(f"electrochemical plant: {path} is no BPX file: {error}") from error
    return BpxCell(**{**asdict(settings), "parameters": path.name}, content=json.dumps(content, sort_keys=True))
