"""chargetune verify."""

from __future__ import annotations

import json
import sys
from pathlib import Path

from rich.console import Console

from chargetune.runtime.counted import counted
from chargetune.verify import verify

__all__ = ["verify_command"]


def verify_command(path: Path, *, as_json: bool) -> None:
    """Recompute a certificate; exit code 1 when a figure differs."""
    differences = verify(path)
    if as_json:
        listed = [{"name": d.name, "stated": d.stated, "recomputed": d.recomputed} for d in differences]
        print(json.dumps({"file": str(path), "verified": not differences, "differences": listed}))  # noqa: T201
    else:
        screen = Console(highlight=False)
        for d in differences:
            screen.print(f"{d.name}: stated {d.stated}, recomputed {d.recomputed}", style="red", markup=False, soft_wrap=True)
        verdict = f"{counted(len(differences), 'figure')} not as stated" if differences else "every figure is what the traces give"
        screen.print(f"{path}: {verdict}", markup=False, soft_wrap=True)
    if differences:
        sys.exit(1)
