"""What a result was made with: versions of the programs, machine, time."""

from __future__ import annotations

import platform
from datetime import UTC, datetime
from functools import cache
from importlib import metadata

__all__ = ["made_by", "utc_now", "versions"]

PACKAGES = ("chargetune", "numpy", "casadi", "torch", "botorch", "gpytorch", "pybamm")


def utc_now() -> str:
    """The time as ISO 8601 in UTC, to the millisecond."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")


@cache
def _versions() -> tuple[tuple[str, str], ...]:
    found = [("python", platform.python_version()), ("machine", f"{platform.system()} {platform.machine()}")]
    for package in PACKAGES:
        try:
            found.append((package, metadata.version(package)))
        except metadata.PackageNotFoundError:
            continue
    return tuple(found)


def versions() -> dict[str, str]:
    """Versions of Python, of this program and of the numerical packages that are installed; nothing is imported."""
    return dict(_versions())


def made_by() -> str:
    """This program and its version."""
    return f"chargetune {versions().get('chargetune', '(not installed)')}"
