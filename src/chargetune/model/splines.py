"""Cubic tables whose node values may be numbers or CasADi parameters.

Both kinds are sums of truncated powers,

    s(z) = a + b (z - z_0) + sum_j e_j max(0, z - z_j)^2 + d_j max(0, z - z_j)^3,

so that there is no interval search: the expression differentiates, compiles and stays defined outside the nodes, where
it goes on as a straight line. For the natural spline a, b, d are linear in the node values (e = 0), which lets theta
be a node value at run time. The monotone PCHIP slopes are not linear in the values, so PCHIP takes numbers only.

The powers are multiplied out: what the nodes below z add to the four coefficients of one cubic in z - z_0 is summed first.
These sums are constant between nodes, so a derivative costs a few operations a table instead of a few a node.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["natural_spline", "natural_spline_matrix", "pchip", "piecewise_linear"]


def natural_spline_matrix(nodes: ArrayLike) -> NDArray[np.float64]:
    """Matrix M, shape (n+2, n), with coefficients [a, b, d_0 .. d_{n-1}] = M @ values of the natural cubic spline."""
    z = _check_nodes(nodes)
    if z.size == 2:
        slope = np.array([-1.0, 1.0]) / (z[1] - z[0])
        return np.vstack([[1.0, 0.0], slope, np.zeros((2, 2))])
    from scipy.interpolate import CubicSpline

    spline = CubicSpline(z, np.eye(z.size), bc_type="natural")
    cubic = spline.c[0]
    jumps = np.diff(np.vstack([np.zeros((1, z.size)), cubic, np.zeros((1, z.size))]), axis=0)
    return np.vstack([np.eye(z.size)[0], spline.c[2, 0], jumps])


def natural_spline(z: Any, nodes: ArrayLike, values: Any) -> Any:
    """Natural cubic spline through (nodes, values) at the CasADi expression z; values (n,) numbers or expressions.

    Twice continuously differentiable; straight lines outside the nodes. Source: de Boor, A Practical Guide to Splines.
    """
    grid = _check_nodes(nodes)
    column = ca.SX(values) if not isinstance(values, ca.MX) else values
    if column.shape != (grid.size, 1):
        raise ValueError(f"spline values have shape {column.shape}, expected ({grid.size}, 1), one a node")
    coefficients = ca.mtimes(ca.DM(natural_spline_matrix(grid)), column)
    cubic = [coefficients[0], coefficients[1], 0.0, 0.0]
    for j, node in enumerate(grid):
        step = _beyond(z, node) * coefficients[2 + j]
        cubic = [c + k * step if k else c for c, k in zip(cubic, _about(node - grid[0], 0.0, 1.0), strict=True)]
    return _horner(z - grid[0], cubic)


def piecewise_linear(z: Any, nodes: ArrayLike, values: Any) -> Any:
    """Straight lines through (nodes, values) at the CasADi expression z; the outer ones go on beyond the nodes.

    ``values`` may be symbols: the result is linear in them, and between the smallest and the largest within the nodes.
    """
    grid = _check_nodes(nodes)
    column = ca.SX(values) if not isinstance(values, ca.MX) else values
    if column.shape != (grid.size, 1):
        raise ValueError(f"values have shape {column.shape}, expected ({grid.size}, 1), one a node")
    at: list[Any] = ca.vertsplit(column)
    slopes = [(b - a) / step for a, b, step in zip(at, at[1:], np.diff(grid), strict=False)]
    out = at[0] + slopes[0] * (z - grid[0])
    for j in range(1, grid.size - 1):
        out += (slopes[j] - slopes[j - 1]) * _positive_part(z - grid[j])
    return out


def pchip(z: Any, nodes: ArrayLike, values: ArrayLike) -> Any:
    """Monotone cubic (PCHIP) through numbers (nodes, values) at the CasADi expression z.

    Once continuously differentiable and monotone where the data are; straight lines outside the nodes.
    Source: Fritsch and Butland, SIAM J. Sci. Stat. Comput. 5 (1984), as in SciPy.
    """
    grid, table = _check_nodes(nodes), np.asarray(values, dtype=float)
    if table.shape != grid.shape or not np.all(np.isfinite(table)):
        raise ValueError(f"spline values have shape {table.shape}, expected {grid.shape} finite numbers")
    from scipy.interpolate import PchipInterpolator

    interpolant = PchipInterpolator(grid, table)
    slope = interpolant.derivative()(grid)
    curve = np.append(interpolant.c[1], 0.0)
    cubic = np.append(interpolant.c[0], 0.0)
    width = np.append(np.nan, np.diff(grid))
    out: list[Any] = [table[0], slope[0], 0.0, 0.0]
    for j, node in enumerate(grid):
        # Coefficients of this piece less those of the piece before, both written about this node.
        square = curve[j] - (curve[j - 1] + 3 * cubic[j - 1] * width[j] if j else 0.0)
        cube = cubic[j] - (cubic[j - 1] if j else 0.0)
        beyond = _beyond(z, node)
        out = [c + k * beyond if k else c for c, k in zip(out, _about(node - grid[0], square, cube), strict=True)]
    return _horner(z - grid[0], out)


def _about(t: float, square: float, cube: float) -> tuple[float, float, float, float]:
    """The coefficients 1, x, x^2, x^3 of square (x - t)^2 + cube (x - t)^3."""
    return square * t**2 - cube * t**3, 3 * cube * t**2 - 2 * square * t, square - 3 * cube * t, cube


def _horner(x: Any, c: list[Any]) -> Any:
    return c[0] + x * (c[1] + x * (c[2] + x * c[3]))


def _beyond(z: Any, node: float) -> Any:
    # As a factor: CasADi moves an if_else out of every product, and the machine code would branch at each derivative of each node.
    return z > node


def _positive_part(t: Any) -> Any:
    # Compiles to a compare and a mask; fmax becomes a call of the C library because of its rules for NaN.
    return ca.if_else(t > 0, t, 0)


def _check_nodes(nodes: ArrayLike) -> NDArray[np.float64]:
    z = np.asarray(nodes, dtype=float)
    if z.ndim != 1 or z.size < 2 or not np.all(np.isfinite(z)) or not np.all(np.diff(z) > 0):
        raise ValueError(f"spline nodes = {z.tolist()}, allowed are at least 2 finite, strictly increasing numbers")
    return z
