"""Names of studies: what is allowed, wherever one is given."""

from __future__ import annotations

import re

from chargetune.runtime.counted import counted

__all__ = ["check_name"]

NAME = re.compile(r"[^\W_](?:[\w .,+=:@()-]{0,98}[\w.,+=:@()-])?")


def check_name(name: str) -> str:
    """The name, where a store, a folder and a page can have it as it stands. Raises ValueError."""
    if not NAME.fullmatch(name):
        shown = repr(name) if len(name) <= 100 else f"{name[:40]!r}... ({counted(len(name), 'character')})"
        raise ValueError(
            f"study name = {shown}, allowed are 1 to 100 letters, digits, spaces and _ . , + = : @ ( ) -, first a letter or digit"
        )
    return name
