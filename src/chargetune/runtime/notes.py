"""Warnings as notes of one line, each said once in a process: a person at a terminal has no use for the place in the source."""

from __future__ import annotations

import sys
import warnings
from typing import Any

__all__ = ["first_line", "say_warnings_as_notes"]

LONGEST = 300


def first_line(message: object) -> str:
    """Of what may be a compiler's whole output the line that says what happened."""
    text = next(iter(str(message).strip().splitlines()), "")
    return text if len(text) <= LONGEST else text[: LONGEST - 3] + "..."


def say_warnings_as_notes() -> None:
    """From now on, or until the end of `warnings.catch_warnings`, warnings are lines on stderr that begin with "note: "."""
    said: set[str] = set()

    def note(message: Warning | str, category: type[Warning], *_: Any, **__: Any) -> None:
        text = first_line(message) or category.__name__
        if text not in said:
            said.add(text)
            print(f"note: {text}", file=sys.stderr)  # noqa: T201

    warnings.showwarning = note
