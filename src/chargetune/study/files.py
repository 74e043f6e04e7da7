"""Files that are there whole or not at all: made aside, and then given their name."""

from __future__ import annotations

import os
from pathlib import Path

__all__ = ["write_whole"]


def write_whole(path: str | os.PathLike[str], content: str | bytes) -> Path:
    """Write a file, text as UTF-8; a crash at any moment leaves the old file or the new one. Raises OSError."""
    target = Path(path)
    data = content.encode() if isinstance(content, str) else content
    if target.exists() and not target.is_file():  # a terminal, a pipe
        target.write_bytes(data)
        return target
    # A link stays a link, and what it leads to is replaced.
    place = target.resolve()
    aside = place.with_name(f".{place.name}.{os.getpid()}.new")
    try:
        with aside.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        aside.replace(place)
    finally:
        aside.unlink(missing_ok=True)
    return target
