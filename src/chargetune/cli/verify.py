"""chargetune verify."""

from __future__ import annotations

import json
import sys
from pathlib import Path

from rich.console import Console

from chargetune.runtime.counted import counted
from chargetune.verify import verify

__all__ = ["verify_command"]

SQLITE = b"SQLite format 3\0"


def verify_command(location: str, *, study: str | None, trial: int | None, as_json: bool) -> None:
    """Recompute a certificate, or the trials of a store; exit code 1 when a figure differs."""
    if _is_store(location):
        from chargetune.cli.output import shown
        from chargetune.cli.verify_store import differences

        found, about = differences(location, study, trial, quiet=as_json)
        good = f"{about}: every figure is what theta and seed give"
        # A URL may hold a password.
        location = shown(location)
    else:
        for name, value in (("--study", study), ("--trial", trial)):
            if value is not None:
                raise ValueError(f"{name} = {value} is given with a certificate, allowed is it with a store")
        try:
            found, good = verify(location), f"{location}: every figure is what the traces give"
        except ValueError as error:
            raise ValueError(f"{error}; allowed are a certificate and a store") from error
    if as_json:
        listed = [{"name": d.name, "stated": d.stated, "recomputed": d.recomputed} for d in found]
        print(json.dumps({"file": location, "verified": not found, "differences": listed}))  # noqa: T201
    else:
        screen = Console(highlight=False)
        for d in found:
            screen.print(f"{d.name}: stated {d.stated}, recomputed {d.recomputed}", style="red", markup=False, soft_wrap=True)
        screen.print(f"{location}: {counted(len(found), 'figure')} not as stated" if found else good, markup=False, soft_wrap=True)
    if found:
        sys.exit(1)


def _is_store(location: str) -> bool:
    if "://" in location:
        return True
    with Path(location).open("rb") as file:
        return file.read(len(SQLITE)) == SQLITE
