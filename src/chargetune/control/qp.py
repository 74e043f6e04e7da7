"""Dense QP solvers as CasADi functions with one signature.

    min 1/2 x'Hx + g'x   s.t.   lbx <= x <= ubx,   A x <= uba

    (H, g, A, uba, lbx, ubx, guess) -> (x, multipliers)

``guess`` and ``multipliers``, shape (variables + rows,), hold the bounds first: positive is active at the upper side,
negative at the lower side, zero is inactive. A QP that is not solved gives NaN or a point that the caller's own
optimality check refuses.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib.resources import files
from typing import Any

import casadi as ca
import numpy as np

from chargetune.control.compiler import compile_library

__all__ = ["QPSolver", "daqp", "daqp_warm", "warm_sources"]

# DAQP's default of 1e-6 is noise of 1e-7 in the merit function, enough to refuse good steps near the solution.
PRIMAL_TOLERANCE = 1e-9

QPSolver = Callable[[int, int], ca.Function]


def daqp(variables: int, rows: int) -> ca.Function:
    """DAQP through CasADi's own interface: needs no compiler, starts cold (the guess is not used)."""
    h, g, a = ca.MX.sym("H", variables, variables), ca.MX.sym("g", variables), ca.MX.sym("A", rows, variables)
    uba, lbx, ubx = ca.MX.sym("uba", rows), ca.MX.sym("lbx", variables), ca.MX.sym("ubx", variables)
    guess = ca.MX.sym("guess", variables + rows)
    # Without CasADi's check of the data, which raises on NaN: a control step answers with its fallback instead.
    options: dict[str, Any] = {"error_on_fail": False, "inputs_check": False, "daqp": {"primal_tol": PRIMAL_TOLERANCE}}
    qp = ca.conic("qp", "daqp", {"h": h.sparsity(), "a": a.sparsity()}, options)
    solution = qp(h=h, g=g, a=a, lba=-np.inf, uba=uba, lbx=lbx, ubx=ubx)
    return ca.Function("daqp", [h, g, a, uba, lbx, ubx, guess], [solution["x"], ca.vertcat(solution["lam_x"], solution["lam_a"])])


def daqp_warm(variables: int, rows: int) -> ca.Function:
    """DAQP through its C interface, started from the guessed working set and without memory allocation."""
    sources, defines = warm_sources(variables, rows)
    name = _warm_name(variables, rows)
    return ca.external(name, str(compile_library(name, sources, defines)))


def warm_sources(variables: int, rows: int) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """(C sources, macro definitions) of `daqp_warm`, to compile it together with a function that calls it."""
    source = files(__package__).joinpath("daqp_warm.c").read_text()
    return (source,), (f"QP_NAME={_warm_name(variables, rows)}", f"QP_N={variables}", f"QP_M={rows}", f"QP_TOLERANCE={PRIMAL_TOLERANCE!r}")


def _warm_name(variables: int, rows: int) -> str:
    return f"daqp_warm_{variables}_{rows}"
