"""Files that are there whole or not at all: made aside, and then given their name."""

from __future__ import annotations

import os
from pathlib import Path

__all__ = ["try_whole", "write_whole"]


def write_whole(path: str | os.PathLike[str], content: str | bytes) -> Path:
    """Write a file, text as UTF-8; a crash at any moment leaves the old file or the new one. Raises OSError with the file's name."""
    target = Path(path)
    data = content.encode() if isinstance(content, str) else content
    try:
        if target.exists() and not target.is_file():  # a terminal, a pipe
            target.write_bytes(data)
            return target
        # A link stays a link, and what it leads to is replaced.
        place = target.resolve()
        aside = _aside(place)
        try:
            with aside.open("wb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            aside.replace(place)
        finally:
            aside.unlink(missing_ok=True)
    except OSError as error:
        # A full disk names no file, and the name aside is nobody's.
        raise OSError(error.errno, error.strerror, str(target)) from error
    return target


def try_whole(path: str | os.PathLike[str]) -> None:
    """Raise the OSError that `write_whole` would end with for want of permission or of a folder; writes nothing.

    Folders that are missing can be made later where the first one that is there can be written to.
    """
    target = Path(path)
    place = target.resolve()
    try:
        if place.is_file() and not os.access(place, os.W_OK):
            raise PermissionError(13, "is write-protected")
        parent = place.parent
        while not parent.exists():
            parent = parent.parent
        aside = _aside(parent / place.name)
        try:
            aside.open("wb").close()
        finally:
            aside.unlink(missing_ok=True)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(target)) from error


def _aside(place: Path) -> Path:
    return place.with_name(f".{place.name}.{os.getpid()}.new")
