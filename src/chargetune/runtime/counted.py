"""How a text says how many there are of something."""

from __future__ import annotations

__all__ = ["counted"]


def counted(count: int, one: str, many: str | None = None) -> str:
    """The count with its noun, "1 trial", "3 trials"; the plural is given where it is not ``one`` and an s."""
    return f"{count} {one if count == 1 else many or one + 's'}"
