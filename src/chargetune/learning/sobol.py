"""The baseline without learning."""

from __future__ import annotations

__all__ = []
