"""What each part of safe mode does: the same trials without it.

    python benchmarks/ablation.py --plant structural --study r0 --seeds 0:10 --trials 4

Options and columns are those of learning.py; a method is safe mode with other settings (`TwinSettings`).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from chargetune.learning.twin.settings import TwinSettings
from learning import arguments, measure, run

# Settings by what is taken away.
PARTS: dict[str, Mapping[str, Any]] = {
    "nothing": {},
    # The discrepancy is as large as it is stated, whatever predictions said.
    "its scale": {"scale_sd": 1e-3},
    # Every plant has the discrepancy at the median of its scale.
    "its scales": {"scale_share": 0.5},
    # Residuals of neighbouring bins are told to be independent.
    "correlated bins": {"correlated_bins": 1.0},
    "older traces": {"traces": 1},
    # What is not needed may move.
    "proximal": {"proximal": 0.0},
    # Margins are never taken anew: the theta that is best on the expected plant, or a step back from it.
    "margins": {"rounds": 1},
    "mean of margins": {"rounds": 2},
    # The whole tolerance may be used.
    "aim": {"aim": 1.0},
    # Fewer plants judge than the candidates were chosen by.
    "judges": {"judges": 16},
    "pool": {"pool": 1},
    "steps back": {"steps_back": (0.25,)},
}


def without(plant: str, study: str, noise_V: float, trials: int, job: tuple[str, int]) -> dict[str, Any]:
    """A run of safe mode on one seed, as in learning.py, without one part."""
    part, seed = job
    return run(plant, study, noise_V, trials, ("safe", seed), TwinSettings(**PARTS[part])) | {"method": part}


def main() -> None:
    measure(arguments(__doc__, PARTS, methods=",".join(PARTS), plant="structural", seeds="0:10"), without)


if __name__ == "__main__":
    main()
