"""The derivatives of one stage, packed in a vector, for CasADi's straight-line code (SX) as well as its loops (MX)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca

from chargetune.control.convexity import nearby_convex
from chargetune.control.estimators import finite
from chargetune.runtime.split import split

__all__ = ["Bend", "Linearisation", "dense", "straight"]


def dense(*expressions: Any) -> list[Any]:
    """Expressions without structural zeros, of which what they share is computed once."""
    return list(ca.cse([ca.densify(e) for e in expressions]))


@dataclass(frozen=True, eq=False)
class Bend:
    """Second derivatives of costate' f + multipliers' c with respect to (x, u), as far as the solver uses them."""

    costate: Any
    multipliers: Any
    hessian: Any

    @classmethod
    def of(cls, x: Any, u: Any, after: Any, rows: Any, *, exact: bool) -> Bend:
        """All of them, or of those with respect to u the diagonal where it is positive."""
        costate, multipliers = ca.SX.sym("costate", after.shape[0]), ca.SX.sym("lambda", rows.shape[0])
        total = ca.dot(costate, after) + ca.dot(multipliers, rows)
        if exact:
            # Dense, since a convex one nearby has more entries.
            return cls(costate, multipliers, ca.densify(ca.hessian(total, ca.vertcat(x, u))[0]))
        positive = ca.fmax(ca.diag(ca.densify(ca.hessian(total, u)[0])), 0)
        nx, nu = x.shape[0], u.shape[0]
        return cls(costate, multipliers, ca.diagcat(ca.SX(nx, nx), ca.diag(positive)) if nu else ca.SX(nx, nx))


@dataclass(frozen=True, eq=False)
class Linearisation:
    """How the derivatives of one stage with respect to (x, u), the non-zeros of sparse matrices, are packed in one vector."""

    patterns: tuple[ca.Sparsity, ...]

    @classmethod
    def of(cls, x: Any, u: Any, after: Any, cost: Any, rows: Any, bend: Bend) -> tuple[Linearisation, Any]:
        """(the form, the packed vector) of the expressions of one stage; the Hessians have room for what ``bend`` adds later."""
        xu = ca.vertcat(x, u)
        curvature, slope = ca.hessian(cost, xu)
        nx = x.shape[0]
        slope_x, slope_u = split(slope, (nx, u.shape[0]))
        parts = [ca.jacobian(after, x), ca.jacobian(after, u), ca.jacobian(rows, x), ca.jacobian(rows, u), slope_x, slope_u]
        parts = [ca.sparsify(part) for part in parts]
        pairs = zip(_hessians(ca.sparsify(curvature), nx), _hessians(bend.hessian, nx), strict=True)
        parts += [ca.project(one, one.sparsity() + two.sparsity()) for one, two in pairs]
        return cls(tuple(part.sparsity() for part in parts)), ca.vertcat(*(ca.vertcat(*part.nonzeros()) for part in parts))

    def bent(self, bend: Bend) -> Any:
        """What ``bend`` adds to the packed vector."""
        return ca.vertcat(ca.SX(ca.DM.zeros(sum(pattern.nnz() for pattern in self.patterns[:6]))), self._packed(bend.hessian))

    def convex(self, vector: Any) -> Any:
        """The packed vector with a positive definite Hessian near its own."""
        *_, l_xx, l_ux, l_uu = self.unpack(vector)
        kept, _ = split(vector, (sum(p.nnz() for p in self.patterns[:6]), sum(p.nnz() for p in self.patterns[6:])))
        return ca.vertcat(kept, self._packed(nearby_convex(ca.vertcat(ca.horzcat(l_xx, l_ux.T), ca.horzcat(l_ux, l_uu)))))

    def _packed(self, hessian: Any) -> Any:
        parts = zip(_hessians(hessian, self.patterns[6].size1()), self.patterns[6:], strict=True)
        return ca.vertcat(*(ca.vertcat(*ca.project(one, pattern).nonzeros()) for one, pattern in parts))

    @property
    def at_start(self) -> ca.Function:
        """D -> D of the first interval: what is not finite of the derivatives with respect to its state, which is given, is 0.

        They multiply a change of 0. One that is infinite, of a root at 0 for example, would make that no number.
        """
        vector = ca.SX.sym("D", self.length)
        pieces = split(vector, (pattern.nnz() for pattern in self.patterns))
        of_state = (True, False, True, False, True, False, True, True, False)
        kept = (ca.if_else(finite(piece), piece, 0) if known else piece for piece, known in zip(pieces, of_state, strict=True))
        return ca.Function("at_start", [vector], [ca.vertcat(*kept)])

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


def _hessians(matrix: Any, nx: int) -> list[Any]:
    """[xx, ux, uu] of the Hessian with respect to (x, u)."""
    return [matrix[:nx, :nx], matrix[nx:, :nx], matrix[nx:, nx:]]


def straight(function: ca.Function) -> ca.Function:
    """The same function without loops and calls, and with what its expressions share computed once."""
    arguments = function.sx_in()
    return ca.Function(function.name(), arguments, dense(*function.call(arguments)))
