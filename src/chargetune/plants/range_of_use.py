"""The range of use: every plant and every episode that a controller may meet, as draws of a simulated plant."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from chargetune.plants.simulated import SimulatedPlant
from chargetune.plants.variation import Variation

__all__ = ["DrawnPlant", "OwnDraws", "RangeOfUse"]

# Shares of a Sobol sequence are kept off 0 and 1, where a normal quantile is not finite.
LEAST_SHARE = 1e-6
# Numbers of which every combination of their ends is drawn in turn: 64 corners; of more, random ones.
CORNERED = 6
# Halvings of the interval of shares, to the rounding of a double.
BISECTIONS = 50


@dataclass(frozen=True)
class DrawnPlant:
    """One draw: the plant, the seed of its noise, and the value of each variation by name (one entry, or one an entry).

    ``error``: by how much its true outputs are off those of its model, as the nodes of a lookup table (outputs, nodes); None: not at all.
    """

    plant: SimulatedPlant
    seed: int
    values: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    error: NDArray[np.float64] | None = field(default=None, compare=False, repr=False)


@dataclass(frozen=True)
class RangeOfUse:
    """Draws of ``plant``, each with all ``variations`` at once.

    A parameter of a draw is p prod_j (1 + s_j v_j) over the variations j that change it (exp(s_j v_j) of those with ``log``), a start
    x_0 + sum_j s_j v_j, a sensor's bias b + sum_j s_j v_j; starts are kept within ``start_bounds``. Draws are a scrambled Sobol sequence
    (Owen, J. Complexity 14 (1998) 466): any number of them covers the range evenly, and each alone has the stated distributions. The same
    seed gives the same draws, and more of them begin with the same ones, so that thetas are compared on common random numbers.

    Raises ValueError where a variation changes what the plant does not have, or two have one name.
    """

    plant: SimulatedPlant
    variations: tuple[Variation, ...]
    start_bounds: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        names = [one.name for one in self.variations]
        if len(set(names)) < len(names):
            raise ValueError(f"range: variations are named {names}, allowed are different names")
        model = self.plant.model
        allowed = {"parameters": tuple(model.parameter_blocks), "starts": model.state_names, "biases": model.output_names}
        for one in self.variations:
            for label, known in allowed.items():
                unknown = sorted(set(getattr(one, label)) - set(known))
                if unknown:
                    raise ValueError(f"range: variation {one.name}: {label} names unknown {unknown}, allowed are {', '.join(known)}")
            followed = sorted(set(one.parameters) & set(self.plant.given))
            if followed:
                raise ValueError(f"range: variation {one.name}: parameters names {followed}, allowed are none that follow a given signal")
            for name, sensitivity in one.parameters.items():
                entries = model.parameter_blocks[name]
                if np.ndim(sensitivity) and np.size(sensitivity) != entries:
                    found = f"has {np.size(sensitivity)} sensitivities of {name}"
                    raise ValueError(f"range: variation {one.name}: {found}, allowed is one, or one for each of its {entries} entries")
            one.mixing(model.parameter_blocks)
        unknown = sorted(set(self.start_bounds) - set(model.state_names))
        if unknown:
            raise ValueError(f"range: start_bounds names unknown {unknown}, allowed are {', '.join(model.state_names)}")

    def draw(
        self, count: int, seed: int, first: int = 0, *, scores: NDArray[np.float64] | None = None, extreme: float | None = None
    ) -> list[DrawnPlant]:
        """Draws ``first`` to ``first + count - 1`` of this seed.

        ``scores`` are normal scores of all numbers that are of the plant, in the order of the variations, a row a draw or one row for
        all: what they stand for is not drawn. A number v has the score e with v = quantile(Phi(e)), Phi the normal distribution; numbers
        that are correlated have v = quantile(Phi(L e)), all e of one variation together (`Variation.mixing`).
        With ``extreme`` in (0, 0.5) every number that is drawn and that is not one by entry is at its quantile of this share or at that
        of 1 - this: their combinations (the corners of the range) in turn, of more than 64 some.
        """
        if extreme is not None and not 0 < extreme < 0.5:
            raise ValueError(f"range: extreme = {extreme!r}, allowed is (0, 0.5)")
        _check_count(count)
        shares = self._shares(first + count, seed)[first:]
        if scores is not None:
            from scipy.special import ndtr

            given = np.atleast_2d(np.asarray(scores, dtype=float))
            own = int(self.of_plant.sum())
            if given.shape not in ((count, own), (1, own)):
                raise ValueError(f"range: scores have the shape {given.shape}, allowed is ({count}, {own}), or one row")
            shares[:, self.of_plant] = np.clip(ndtr(given), LEAST_SHARE, 1.0 - LEAST_SHARE)
        if extreme is not None:
            alone = ~np.repeat([one.by_entry for one in self.variations], self.sizes).astype(bool)
            alone &= ~self.of_plant if scores is not None else True
            shares[:, alone] = np.where(self._corners(first + count, int(alone.sum()), seed)[first:], 1.0 - extreme, extreme)
        shares = self._mixed(shares)
        return [self._drawn(share, _noise_seed(seed, first + k)) for k, share in enumerate(shares)]

    def plant_scores(self, seed: int) -> NDArray[np.float64]:
        """Normal scores of one plant, the first draw of this seed, as `draw` takes them, shape (numbers of the plant,)."""
        from scipy.special import ndtri

        return np.asarray(ndtri(self._shares(1, seed)[0, self.of_plant]))

    @property
    def nominal_scores(self) -> NDArray[np.float64]:
        """Scores of the plant whose numbers change nothing, v = 0, or of the nearest that a distribution has, shape (numbers,).

        By bisection of each quantile function.
        """
        from scipy.special import ndtri

        parts = [one.distribution for one, size in zip(self.variations, self.sizes, strict=True) if one.of == "plant" for _ in range(size)]
        low, high = np.full(len(parts), LEAST_SHARE), np.full(len(parts), 1.0 - LEAST_SHARE)
        for _ in range(BISECTIONS):
            middle = (low + high) / 2
            below = np.array([float(one.at(np.array([share]))[0]) < 0 for one, share in zip(parts, middle, strict=True)], dtype=bool)
            low, high = np.where(below, middle, low), np.where(below, high, middle)
        scores = np.asarray(ndtri((low + high) / 2))
        return scores if self.plant_mixing is None else np.asarray(np.linalg.pinv(self.plant_mixing) @ scores)

    @cached_property
    def mixing(self) -> NDArray[np.float64] | None:
        """L of all numbers, of their normal scores (`Variation.mixing`), shape (numbers, numbers); None where none are correlated."""
        from scipy.linalg import block_diag

        if not any(one.correlated for one in self.variations):
            return None
        return np.asarray(block_diag(*(one.mixing(self.plant.model.parameter_blocks) for one in self.variations)))

    @cached_property
    def plant_mixing(self) -> NDArray[np.float64] | None:
        """The same of the numbers that are of the plant."""
        return None if self.mixing is None else self.mixing[np.ix_(self.of_plant, self.of_plant)]

    def _mixed(self, shares: NDArray[np.float64]) -> NDArray[np.float64]:
        """Shares of independent numbers (count, numbers) as those of correlated ones."""
        if self.mixing is None:
            return shares
        from scipy.special import ndtr, ndtri

        own = np.repeat([one.correlated for one in self.variations], self.sizes).astype(bool)
        mixed = np.clip(ndtr(ndtri(shares) @ self.mixing.T), LEAST_SHARE, 1.0 - LEAST_SHARE)
        return np.where(own, mixed, shares)

    def _shares(self, count: int, seed: int) -> NDArray[np.float64]:
        """Points of the unit cube, shape (count, numbers)."""
        numbers = sum(self.sizes)
        if not numbers:
            return np.zeros((count, 0))
        from scipy.stats import qmc

        # A Sobol sequence is balanced at powers of two; a longer one begins with the shorter.
        points = qmc.Sobol(numbers, scramble=True, rng=np.random.default_rng([seed, 1])).random_base2(int(np.ceil(np.log2(max(count, 2)))))
        return np.asarray(np.clip(points[:count], LEAST_SHARE, 1.0 - LEAST_SHARE))

    @staticmethod
    def _corners(count: int, numbers: int, seed: int) -> NDArray[np.bool_]:
        """Which numbers are at their upper end, shape (count, numbers)."""
        if numbers <= CORNERED:
            return np.asarray((np.arange(count)[:, None] >> np.arange(numbers)) & 1, dtype=bool)
        return np.asarray(np.random.default_rng([seed, 2]).random((count, numbers)) < 0.5)

    @cached_property
    def sizes(self) -> tuple[int, ...]:
        """Numbers of each variation."""
        blocks = self.plant.model.parameter_blocks
        return tuple(sum(blocks[name] for name in one.parameters) if one.by_entry else 1 for one in self.variations)

    @cached_property
    def of_plant(self) -> NDArray[np.bool_]:
        """Which of all numbers stay with a plant, shape (numbers,)."""
        return np.repeat([one.of == "plant" for one in self.variations], self.sizes).astype(bool)

    def _drawn(self, shares: NDArray[np.float64], seed: int) -> DrawnPlant:
        model, sensors = self.plant.model, self.plant.sensors
        parameters = {name: np.array(values) for name, values in model.parameters}
        start = {name: float(self.plant.start.get(name, 0.0)) for name in model.state_names}
        bias, drawn = dict(sensors.bias), {}
        for one, part in zip(self.variations, np.split(shares, np.cumsum(self.sizes, dtype=int))[:-1], strict=True):
            values = one.distribution.at(part)
            drawn[one.name] = tuple(float(v) for v in values)
            own = iter(_split(values, one, model.parameter_blocks))
            for name in one.parameters:
                parameters[name] = parameters[name] * one.factor(name, next(own))
            for name, sensitivity in one.starts.items():
                start[name] += sensitivity * float(values[0])
            for name, sensitivity in one.biases.items():
                bias[name] = bias.get(name, 0.0) + sensitivity * float(values[0])
        for name, (low, high) in self.start_bounds.items():
            start[name] = float(np.clip(start[name], low, high))
        plant = replace(self.plant, model=model.with_parameters(**parameters), start=start, sensors=replace(sensors, bias=bias))
        return DrawnPlant(plant, seed, drawn)


def _split(values: NDArray[np.float64], one: Variation, sizes: Mapping[str, int]) -> Sequence[NDArray[np.float64]]:
    """The values for each parameter of a variation, in their order."""
    if not one.by_entry:
        return [values] * len(one.parameters)
    return np.split(values, np.cumsum([sizes[name] for name in one.parameters])[:-1])


@dataclass(frozen=True)
class OwnDraws:
    """A range of use whose draws are yours: measured plants, rows of a table, samples of a posterior.

    plant
        The model that all of them have; their parameters, starts and sensors differ.
    function
        (generator of random numbers) -> a plant; one of a list is ``lambda rng: plants[rng.integers(len(plants))]``.

    It takes the place of `RangeOfUse` in `SimulatedRange`. What of a draw is of the plant is not known, so nothing is learnt from
    traces; and a range without numbers has no corners: ``extreme`` changes nothing.
    """

    plant: SimulatedPlant
    function: Callable[[np.random.Generator], SimulatedPlant]

    def draw(
        self, count: int, seed: int, first: int = 0, *, scores: NDArray[np.float64] | None = None, extreme: float | None = None
    ) -> list[DrawnPlant]:
        """Draws ``first`` to ``first + count - 1`` of this seed, each of a generator of its own. Raises ValueError for ``scores``."""
        _check_count(count)
        if scores is not None:
            raise ValueError("range: scores are given, allowed are none for draws of your own: what is of the plant is not known")
        numbers = range(first, first + count)
        return [DrawnPlant(self.function(np.random.default_rng([seed, 3, k])), _noise_seed(seed, k), {}) for k in numbers]


def _check_count(count: int) -> None:
    if isinstance(count, bool) or not isinstance(count, int) or count < 1:
        raise ValueError(f"range: count = {count!r}, allowed is an integer >= 1")


def _noise_seed(seed: int, number: int) -> int:
    """Noise is drawn anew for each draw; its seeds have spawn keys that those of a study's trials never have."""
    return int(np.random.SeedSequence(seed, spawn_key=(2, number)).generate_state(1, np.uint64)[0]) >> 11
