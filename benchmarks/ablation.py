"""What each part of safe mode does: the same trials without it.

    python benchmarks/ablation.py --plant structural --study r0 --seeds 0:10 --trials 4

Options and columns are those of learning.py; a method is safe mode without that part. Parts are taken away from outside, by other
values of the package's own names while the trials of one seed run.
"""

from __future__ import annotations

from contextlib import ExitStack
from typing import Any
from unittest.mock import patch

import numpy as np

from chargetune.learning import safe_mode as safe_ask
from chargetune.learning import twin_tuner
from chargetune.learning.closed_loop import search as twin_search
from chargetune.learning.closed_loop.loop import windows_of
from chargetune.learning.closed_loop.search import Search
from chargetune.learning.closed_loop.slp import Point
from chargetune.learning.safe_mode import SURE, SafeProposal
from chargetune.learning.twin import ensemble
from chargetune.learning.twin.discrepancy import Discrepancy, DiscrepancySample
from chargetune.learning.twin.posterior import Posterior
from learning import arguments, measure, run

_error = Discrepancy._error  # noqa: SLF001 - what is taken away has no public name


def _no_error(self: Discrepancy, left: Any, _seed: int | None) -> DiscrepancySample:
    return DiscrepancySample(self, np.zeros_like(_error(self, left, None).table))


def _by_window(self: Search, seen: Any) -> Point:
    excess = windows_of(seen.score, self._share - twin_search.ROUNDING) + self._margin
    return Point(-seen.score.objective, np.where(np.isfinite(excess), excess, -np.inf))


# (owner, name, what stands there instead) by what is taken away.
PARTS: dict[str, tuple[tuple[Any, str, Any], ...]] = {
    "nothing": (),
    # No error of the twin is known, in any plant.
    "discrepancy": ((Discrepancy, "_error", _no_error),),
    # Every plant has the error that is expected of it.
    "its samples": ((Discrepancy, "_error", lambda self, left, _: _error(self, left, None)),),
    # Where nothing was measured the twin may be as wrong as the hyperparameters of the residuals say, and no more.
    "its floor": ((ensemble, "calibrate_scale", lambda *_: 0.0),),
    "its scale": ((ensemble, "calibrate_scale", lambda *_: 1.0),),
    # The second trial is treated like those that follow.
    "unproved": ((safe_ask, "UNPROVED", 0.0), (twin_tuner, "SURE_UNPROVED", SURE)),
    # Draws are Gaussian.
    "moved draws": ((Posterior, "moved", lambda self, draws: self.mode + draws),),
    "envelope steps": (
        (SafeProposal, "_expected_best", lambda self: np.array(self.trials[-1].theta)),
        (SafeProposal, "covered", lambda *_: None),
    ),
    "search": ((SafeProposal, "_searched", lambda _self, start, _deviations: [start]),),
    # The search keeps the largest excess of each window.
    "samples": ((Search, "_point", _by_window),),
    "nearest": ((SafeProposal, "_nearer", lambda _self, candidate, _deviations: candidate[0]),),
}


def without(plant: str, study: str, noise_V: float, trials: int, job: tuple[str, int]) -> dict[str, Any]:
    """A run of safe mode on one seed, as in learning.py, without one part."""
    part, seed = job
    with ExitStack() as stack:
        for owner, name, instead in PARTS[part]:
            stack.enter_context(patch.object(owner, name, instead))
        return run(plant, study, noise_V, trials, ("safe", seed)) | {"method": part}


def main() -> None:
    measure(arguments(__doc__, PARTS, methods=",".join(PARTS), plant="structural", seeds="0:10"), without)


if __name__ == "__main__":
    main()
