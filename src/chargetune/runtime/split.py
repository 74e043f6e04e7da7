"""CasADi vectors in pieces."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import accumulate
from typing import Any

import casadi as ca

__all__ = ["split"]


def split(vector: Any, sizes: Iterable[int]) -> list[Any]:
    """A CasADi column in pieces of these sizes, one after the other; a piece may be empty, shape (0, 1).

    A slice is no substitute: of a 1 x 1 symbol ``v[1:]`` is 1 x 0, which fits below nothing. Raises RuntimeError when the sizes do not
    add up to the length of ``vector``.
    """
    edges = [0, *accumulate(sizes)]
    return list(ca.vertsplit(vector, edges)) if len(edges) > 1 else []
