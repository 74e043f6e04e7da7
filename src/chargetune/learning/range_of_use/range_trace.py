"""What a trial over a range of use keeps: figures of every plant, and the episodes of three of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chargetune.episode.episode import Episode

__all__ = ["RangeTrace"]

PLANTS = "plants."


@dataclass(frozen=True)
class RangeTrace:
    """The trace of one theta on N drawn plants. The other episodes follow from the trial's theta and seed.

    worst, median, best
        The episodes of the plants with the largest, the middle and the smallest excess beyond the tolerance; of an even number of plants
        the middle is the smaller one of both. Plants whose episode did not come to its end are not among them.
    places
        Their places among the plants, by these names.
    plants
        By name an array of N numbers, in the order in which the plants were drawn: ``objective``, ``excess of LIMIT`` (signed, in the
        limit's unit), each metric, and as ``drawn NAME`` the number of each variation, of those by entry none. NaN: the plant has none.

    As the trace of a trial its arrays are those of the worst plant's episode, so that whoever reads an episode finds that one; with the
    prefixes ``median.`` and ``best.`` those of the others, with ``plants.`` the figures.
    """

    worst: Episode
    median: Episode
    best: Episode
    places: Mapping[str, int]
    plants: Mapping[str, NDArray[np.float64]]

    def arrays(self) -> dict[str, NDArray[Any]]:
        out = dict(self.worst.arrays())
        for name, episode in (("median", self.median), ("best", self.best)):
            out |= {f"{name}.{key}": values for key, values in episode.arrays().items()}
        return out | {PLANTS + name: values for name, values in self.plants.items()}

    def meta(self) -> dict[str, Any]:
        return {**self.worst.meta(), "plants": dict(self.places)}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]], meta: Mapping[str, Any]) -> RangeTrace | None:
        """The inverse of `arrays` and `meta`; None for a trace of one episode."""
        if "plants" not in meta:
            return None

        def of(prefix: str) -> dict[str, NDArray[Any]]:
            return {name.removeprefix(prefix): values for name, values in arrays.items() if name.startswith(prefix)}

        return cls(
            worst=Episode.from_arrays(arrays, meta),
            median=Episode.from_arrays(of("median."), meta),
            best=Episode.from_arrays(of("best."), meta),
            places={str(name): int(place) for name, place in meta["plants"].items()},
            plants=of(PLANTS),
        )
