"""The range of use as what a twin knows of its plant before the first trace."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from chargetune.episode.episode import Episode
from chargetune.learning.twin.twin import Twin, Uncertain
from chargetune.plants.range_of_use import LEAST_SHARE, RangeOfUse
from chargetune.plants.variation import Variation

__all__ = ["RangePrior", "range_twin"]

# Step of the differences of a quantile over its normal score: exact to 1e-4 of a slope for smooth ones.
STEP = 1e-4


@dataclass(frozen=True)
class RangePrior:
    """The prior of a `Twin` whose plant is one of a range of use (a `ScoredPrior`).

    Every number v_j that is of the plant has a normal score e_j, v_j = quantile_j(Phi(e_j)), with e ~ N(0, I): that is the declared
    distribution exactly, and no e is outside the range. The twin's unknowns follow from them,

        m_p = sum_j ln(1 + s_j v_j)  for a parameter p,   m_x = sum_j s_j v_j  for a start or a bias,

    over the variations j that change it; of those with ``log`` the summand is s_j v_j, and correlated numbers have the scores L e.
    What is of the episode is read off each trace: of a variation with a start, v follows from the state there, and so do the parameters
    that it changes too, such as an ambient temperature. The state is the first measured value where the estimator reads it (``read``),
    else the estimate. A number without slope, such as a `Choice`, stays what it was before.
    """

    range_of_use: RangeOfUse
    read: tuple[str, ...] = ()

    @cached_property
    def unknowns(self) -> tuple[Uncertain, ...]:
        """What the plant's variations change, with its standard deviation to first order."""
        kinds = {"factor": self._changed("parameters"), "start": self._changed("starts"), "bias": self._changed("biases")}
        slots = [(name, kind) for kind, names in kinds.items() for name in names]
        sd = np.linalg.norm(self.slopes(np.zeros(self.size)), axis=1)
        parts = np.split(sd, np.cumsum([self._count(name, kind) for name, kind in slots])[:-1])
        return tuple(
            Uncertain(name, max(float(np.mean(part)), 1e-9), kind)  # type: ignore[arg-type]
            for (name, kind), part in zip(slots, parts, strict=True)
        )

    @property
    def size(self) -> int:
        """Numbers of the plant."""
        return int(self.range_of_use.of_plant.sum())

    @property
    def scalars(self) -> list[int]:
        """Scores that no other score is like: of variations that are one number."""
        ends = np.cumsum([size for _, size in self._plants])
        return [int(end - 1) for end, (_, size) in zip(ends, self._plants, strict=True) if size == 1]

    def at(self, scores: NDArray[np.float64]) -> NDArray[np.float64]:
        """Unknowns m of scores e (..., size)."""
        mixing = self.range_of_use.plant_mixing
        return np.asarray(self._unknowns(self._values(scores if mixing is None else scores @ mixing.T)))

    def slopes(self, scores: NDArray[np.float64]) -> NDArray[np.float64]:
        """dm/de at scores e (size,), shape (unknowns, size)."""
        mixing = self.range_of_use.plant_mixing
        scores = scores if mixing is None else mixing @ scores
        values = self._values(scores)
        up, down = self._values(scores + STEP) - values, values - self._values(scores - STEP)
        # The lesser of both sides: at a jump there is no slope.
        steep = np.where(np.abs(up) < np.abs(down), up, down) / STEP
        # Each score has a number of its own, so that the slopes of all numbers are a diagonal.
        columns = []
        for j in range(self.size):
            moved = np.repeat(values[None], 2, axis=0)
            moved[0, j] += STEP * steep[j]
            moved[1, j] -= STEP * steep[j]
            high, low = self._unknowns(moved)
            columns.append((high - low) / (2 * STEP))
        slopes = np.array(columns).T.reshape(-1, self.size)
        return slopes if mixing is None else slopes @ mixing

    def under(self, twin: Twin, episode: Episode) -> Twin:
        """The twin in the condition of this episode: where it began, and what goes with that."""
        start, parameters = dict(twin.start), {name: np.array(values) for name, values in twin.model.parameters}
        seen = {name: value for name in self._started if (value := self._first(episode, name)) is not None}
        for one in self.range_of_use.variations:
            if one.of != "episode":
                continue
            states = [name for name, sensitivity in one.starts.items() if name in seen and sensitivity]
            # What a trace does not show is taken as in the middle of its range.
            middle = float(one.distribution.at(np.array([0.5]))[0])
            v = (seen[states[0]] - twin.start.get(states[0], 0.0)) / one.starts[states[0]] if states else middle
            for name in one.parameters:
                parameters[name] = parameters[name] * one.factor(name, v)
            if not states:
                for name, sensitivity in one.starts.items():
                    start[name] = start.get(name, 0.0) + sensitivity * v
        return replace(twin, model=twin.model.with_parameters(**parameters), start=start | seen)

    def _first(self, episode: Episode, name: str) -> float | None:
        """The state where an episode began; None where nothing says."""
        if not len(episode):
            return None
        if name in episode.output_names and (name in self.read or name not in episode.estimate_names):
            value = float(episode.signal(name)[0][0])
        elif name in episode.estimate_names:
            value = float(episode.estimate[0, episode.estimate_names.index(name)])
        else:
            return None
        return value if np.isfinite(value) else None

    @cached_property
    def _plants(self) -> list[tuple[Variation, int]]:
        """Variations of the plant, and how many numbers each has."""
        both = zip(self.range_of_use.variations, self.range_of_use.sizes, strict=True)
        return [(one, size) for one, size in both if one.of == "plant"]

    @cached_property
    def _started(self) -> list[str]:
        return list(dict.fromkeys(name for one in self.range_of_use.variations if one.of == "episode" for name in one.starts))

    def _changed(self, label: str) -> list[str]:
        return list(dict.fromkeys(name for one, _ in self._plants for name in getattr(one, label)))

    def _count(self, name: str, kind: str) -> int:
        return self.range_of_use.plant.model.parameter_blocks[name] if kind == "factor" else 1

    def _values(self, scores: NDArray[np.float64]) -> NDArray[np.float64]:
        """Numbers v of the scores of each alone, the same shape."""
        from scipy.special import ndtr

        shares = np.clip(ndtr(scores), LEAST_SHARE, 1.0 - LEAST_SHARE)
        parts = np.split(shares, np.cumsum([size for _, size in self._plants])[:-1], axis=-1)
        return np.concatenate([one.distribution.at(part) for (one, _), part in zip(self._plants, parts, strict=True)], axis=-1)

    def _unknowns(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Unknowns m of numbers v (..., size)."""
        blocks, shape = self.range_of_use.plant.model.parameter_blocks, values.shape[:-1]
        logs = {name: np.zeros((*shape, blocks[name])) for name in self._changed("parameters")}
        added = {label: {name: np.zeros((*shape, 1)) for name in self._changed(label)} for label in ("starts", "biases")}
        parts = np.split(values, np.cumsum([size for _, size in self._plants])[:-1], axis=-1)
        for (one, _), part in zip(self._plants, parts, strict=True):
            first = 0
            for name in one.parameters:
                own = part[..., first : first + blocks[name]] if one.by_entry else part
                first += blocks[name] if one.by_entry else 0
                logs[name] = logs[name] + one.log_factor(name, own)
            for label in ("starts", "biases"):
                for name, sensitivity in getattr(one, label).items():
                    added[label][name] = added[label][name] + sensitivity * part[..., :1]
        return np.concatenate([*logs.values(), *added["starts"].values(), *added["biases"].values()], axis=-1)


def range_twin(
    range_of_use: RangeOfUse,
    read: Sequence[str],
    noise_sd: Mapping[str, float],
    discrepancy_sd_floor: Mapping[str, float],
    floor_at_zero_input: float,
) -> Twin:
    """The twin of a plant that is one of this range, whose controller's estimator reads the signals ``read``; see `Twin` for the numbers.

    Raises ValueError where nothing is of the plant.
    """
    prior = RangePrior(range_of_use, tuple(read))
    if not prior.size:
        raise ValueError(
            "range: nothing differs from plant to plant, allowed is at least one variation of the plant: there is nothing to learn"
        )
    plant = range_of_use.plant
    return Twin(
        plant.model, prior.unknowns, dict(noise_sd), dict(plant.start), dict(discrepancy_sd_floor), floor_at_zero_input, prior=prior
    )
