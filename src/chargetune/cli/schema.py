"""chargetune schema."""

from __future__ import annotations

import json

import typer

from chargetune.battery.file_formats.formats import FORMATS
from chargetune.battery.file_formats.json_schema import json_schema

__all__ = ["schema_command"]


def schema_command(kind: str) -> None:
    """Print the schema of a study, cell or campaign file."""
    typer.echo(json.dumps(json_schema(FORMATS[kind]), indent=1, ensure_ascii=False))
