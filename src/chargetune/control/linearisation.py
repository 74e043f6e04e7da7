"""The derivatives of one stage, packed in a vector, for CasADi's straight-line code (SX) as well as its loops (MX)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca

from chargetune.runtime.split import split

__all__ = ["Linearisation", "dense", "straight"]


def dense(*expressions: Any) -> list[Any]:
    """Expressions without structural zeros, of which what they share is computed once."""
    return list(ca.cse([ca.densify(e) for e in expressions]))


@dataclass(frozen=True, eq=False)
class Linearisation:
    """How the derivatives of one stage with respect to (x, u), the non-zeros of sparse matrices, are packed in one vector."""

    patterns: tuple[ca.Sparsity, ...]

    @classmethod
    def of(cls, x: Any, u: Any, after: Any, cost: Any, rows: Any) -> tuple[Linearisation, Any]:
        """(the form, the packed vector) of the expressions of one stage."""
        xu = ca.vertcat(x, u)
        curvature, slope = ca.hessian(cost, xu)
        nx = x.shape[0]
        slope_x, slope_u = split(slope, (nx, u.shape[0]))
        parts = [
            ca.jacobian(after, x), ca.jacobian(after, u), ca.jacobian(rows, x), ca.jacobian(rows, u),
            slope_x, slope_u, curvature[:nx, :nx], curvature[nx:, :nx], curvature[nx:, nx:],
        ]  # fmt: skip
        parts = [ca.sparsify(part) for part in parts]
        return cls(tuple(part.sparsity() for part in parts)), ca.vertcat(*(ca.vertcat(*part.nonzeros()) for part in parts))

    @property
    def length(self) -> int:
        return sum(pattern.nnz() for pattern in self.patterns)

    @property
    def shape(self) -> tuple[int, int, int]:
        """(nx, nu, rows)."""
        return self.patterns[0].size2(), self.patterns[1].size2(), self.patterns[2].size1()

    def unpack(self, vector: Any) -> list[Any]:
        """[f_x, f_u, c_x, c_u, l_x, l_u, l_xx, l_ux, l_uu] from the packed vector."""
        pieces = split(vector, (pattern.nnz() for pattern in self.patterns))
        return [type(vector)(pattern, piece) for pattern, piece in zip(self.patterns, pieces, strict=True)]


def straight(function: ca.Function) -> ca.Function:
    """The same function without loops and calls, and with what its expressions share computed once."""
    arguments = function.sx_in()
    return ca.Function(function.name(), arguments, dense(*function.call(arguments)))
