"""Dense QP solvers as CasADi functions with one signature.

    min over x, s   |x|^2 / 2 + |s|^2 / 2 + g'(s, x)   s.t.   s >= 0,   lba <= A (s, x) <= uba

    (g, A', lba, uba, guess) -> (A (s, x), multipliers)

``guess`` and ``multipliers``, shape (slacks + rows,), hold the bounds of the slacks first: positive is active at the
upper side, negative at the lower side, zero is inactive. A QP that is not solved gives NaN or a point that the caller's
own optimality check refuses.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib.resources import files
from typing import Any

import casadi as ca
import numpy as np

from chargetune.runtime.compiler import compile_library

__all__ = ["QPSolver", "daqp", "daqp_warm", "warm_sources"]

# DAQP's default of 1e-6 is noise of 1e-7 in the merit function, enough to refuse good steps near the solution.
PRIMAL_TOLERANCE = 1e-9

# (slacks, variables besides, rows) -> solver
QPSolver = Callable[[int, int, int], ca.Function]


def daqp(slacks: int, variables: int, rows: int) -> ca.Function:
    """DAQP through CasADi's own interface: needs no compiler, starts cold (the guess is not used)."""
    n = slacks + variables
    g, a, lba, uba = ca.MX.sym("g", n), ca.MX.sym("A", n, rows), ca.MX.sym("lba", rows), ca.MX.sym("uba", rows)
    guess = ca.MX.sym("guess", slacks + rows)
    # Without CasADi's check of the data, which raises on NaN: a control step answers with its fallback instead.
    options: dict[str, Any] = {"error_on_fail": False, "inputs_check": False, "daqp": {"primal_tol": PRIMAL_TOLERANCE}}
    qp = ca.conic("qp", "daqp", {"h": ca.Sparsity.dense(n, n), "a": ca.Sparsity.dense(rows, n)}, options)
    lower = ca.DM(np.repeat([0.0, -np.inf], [slacks, variables]))
    solution = qp(h=ca.DM.eye(n), g=g, a=a.T, lba=lba, uba=uba, lbx=lower)
    of_slacks, _ = ca.vertsplit(solution["lam_x"], [0, slacks, n])
    multipliers = ca.vertcat(of_slacks, solution["lam_a"])
    return ca.Function("daqp", [g, a, lba, uba, guess], [ca.mtimes(a.T, solution["x"]), multipliers])


def daqp_warm(slacks: int, variables: int, rows: int) -> ca.Function:
    """DAQP through its C interface, started from the guessed working set and without memory allocation."""
    sources, defines = warm_sources(slacks, variables, rows)
    name = _warm_name(slacks, variables, rows)
    return ca.external(name, str(compile_library(name, sources, defines)))


def warm_sources(slacks: int, variables: int, rows: int) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """(C sources, macro definitions) of `daqp_warm`, to compile it together with a function that calls it."""
    source = files(__package__).joinpath("daqp_warm.c").read_text()
    shape = (f"QP_SLACKS={slacks}", f"QP_VARIABLES={slacks + variables}", f"QP_ROWS={rows}")
    return (source,), (f"QP_NAME={_warm_name(slacks, variables, rows)}", *shape, f"QP_TOLERANCE={PRIMAL_TOLERANCE!r}")


def _warm_name(slacks: int, variables: int, rows: int) -> str:
    return f"daqp_warm_{slacks}_{variables}_{rows}"
