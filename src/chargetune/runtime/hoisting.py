"""What depends on parameters alone is computed once, not at every interval."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca

__all__ = ["hoist"]


def hoist(name: str, arguments: Sequence[Any], fixed: Sequence[Any], expressions: Sequence[Any]) -> tuple[ca.Function, ca.Function]:
    """(arguments, q) -> expressions, and fixed -> q, for SX ``expressions`` of both: q is what they need of ``fixed``, shape (nq,).

    What two expressions share is one entry of q, because it is made one beforehand.
    """
    shared = ca.cse([ca.densify(one) for one in expressions])
    found: list[Any]
    found, symbols, values = ca.extract_parametric(shared, ca.vertcat(*fixed), {"extract_trivial": True})
    q, known = (ca.vertcat(*parts) if parts else ca.SX(0, 1) for parts in (symbols, values))
    return ca.Function(name, [*arguments, q], ca.cse(found)), ca.Function(f"of_{name}", list(fixed), [ca.cse(ca.densify(known))])
