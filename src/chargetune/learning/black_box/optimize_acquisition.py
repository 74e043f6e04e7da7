"""Maximising an acquisition function over the unit cube, reproducibly and on one thread."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np
import torch
from botorch.acquisition.acquisition import AcquisitionFunction
from botorch.exceptions.errors import CandidateGenerationError
from botorch.optim.optimize import optimize_acqf
from numpy.typing import NDArray

from chargetune.learning.black_box.gaussian_process import FAILURES
from chargetune.learning.initial_design import sobol_points
from chargetune.runtime.counted import counted

__all__ = ["candidates", "maximise", "reproducible"]

# Points that are evaluated first: Sobol points over the unit cube, and normal steps around the incumbent for each of these lengths.
SOBOL_POINTS = 128
LOCAL_POINTS = 48
LOCAL_SCALES = (0.02, 0.06, 0.15)
# Gradient searches, from the best of those points, and their iterations at most.
STARTS = 2
ITERATIONS = 40
# Two thetas closer than this in the unit cube, in every entry, count as the same trial.
DUPLICATE = 1e-6


@contextmanager
def reproducible(seed: int) -> Iterator[None]:
    """Context with torch's random numbers from ``seed``, one thread and double precision; afterwards all is as before."""
    threads, dtype = torch.get_num_threads(), torch.get_default_dtype()
    with torch.random.fork_rng(devices=[]), warnings.catch_warnings():
        # Warnings about linear_operator's own use of torch, which its users cannot change.
        warnings.filterwarnings("ignore", "TypedStorage is deprecated|.*[Ss]parse", UserWarning)
        torch.manual_seed(seed)
        # For matrices of a hundred rows more threads cost time, and the rounding of sums depends on their number.
        torch.set_num_threads(1)
        torch.set_default_dtype(torch.float64)
        try:
            yield
        finally:
            torch.set_num_threads(threads)
            torch.set_default_dtype(dtype)


def candidates(dimension: int, seed: int, around: torch.Tensor | None) -> torch.Tensor:
    """Points (m, d) that are evaluated first: Sobol points over the cube, and normal steps around the incumbent ``around``, if given."""
    everywhere = torch.from_numpy(sobol_points(dimension, seed, 0, SOBOL_POINTS))
    if around is None:
        return everywhere
    draw = np.random.default_rng(seed)
    steps = [scale * draw.standard_normal((LOCAL_POINTS, dimension)) for scale in LOCAL_SCALES]
    return torch.cat([everywhere, *((around + torch.from_numpy(step)).clamp(0.0, 1.0) for step in steps)])


def maximise(
    acquisition: AcquisitionFunction,
    points: torch.Tensor,
    taken: Sequence[Sequence[float]] | NDArray[np.float64],
    *,
    starts: int = STARTS,
    also: torch.Tensor | None = None,
    iterations: int = ITERATIONS,
) -> torch.Tensor:
    """The maximiser of the acquisition as far as it was found, shape (d,), and none of ``taken``.

    L-BFGS-B from the ``starts`` best of ``points`` (m, d), and from ``also`` (k, d). If it fails, the best of ``points``, with a
    RuntimeWarning.
    """
    with torch.no_grad():
        values = acquisition(points[:, None, :])
    values = torch.nan_to_num(values, nan=-torch.inf)
    best = points[values.argmax()]
    start = points[values.topk(starts).indices]
    start = (start if also is None else torch.cat([start, also]))[:, None, :]
    d = points.shape[1]
    try:
        with warnings.catch_warnings():
            # BoTorch warns when the iteration limit is reached, which is intended here.
            warnings.simplefilter("ignore")
            found, value = optimize_acqf(
                acquisition, torch.stack([torch.zeros(d), torch.ones(d)]), 1, num_restarts=len(start), batch_initial_conditions=start,
                options={"maxiter": iterations},
            )  # fmt: skip
        if value is not None and torch.isfinite(value).all() and torch.isfinite(found).all():
            best = found[0]
    except (*FAILURES, CandidateGenerationError) as error:
        # The acquisition is flat or ill-conditioned.
        warnings.warn(
            f"the acquisition was not maximised, the best of {counted(len(points), 'point')} stands ({error})", RuntimeWarning, stacklevel=2
        )
    done = torch.as_tensor(np.asarray(taken, dtype=float)).reshape(-1, d)
    if len(done) and (done - best).abs().amax(1).min() < DUPLICATE:
        order = values.argsort(descending=True)
        apart = torch.cdist(points[order], done).amin(1) > DUPLICATE
        if apart.any():
            best = points[order[apart][0]]
    return best.detach().clamp(0.0, 1.0)
