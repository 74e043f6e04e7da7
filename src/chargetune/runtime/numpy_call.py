"""CasADi functions of NumPy's arrays, without a copy."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["numpy_call"]


def numpy_call(function: ca.Function, *given: ArrayLike) -> list[NDArray[np.float64]]:
    """The results of a function whose arguments and results are dense; other threads run meanwhile.

    All are transposed: CasADi stores columns one after the other, NumPy rows, so what is a column an interval there is a row an
    interval here. Raises RuntimeError for an argument with fewer numbers than the function reads.
    """
    arrays = [np.ascontiguousarray(one, dtype=np.float64) for one in given]
    results = [np.empty(function.size_out(i)[::-1]) for i in range(function.n_out())]
    buffer: Any
    buffer, evaluate = function.buffer()
    for i, one in enumerate(arrays):
        buffer.set_arg(i, one.data)
    for i, one in enumerate(results):
        buffer.set_res(i, one.data)
    evaluate()
    return results
