"""A twin of the plant as data: a model, what of it is unknown, and what is measured with what noise."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from chargetune.episode.episode import Episode
from chargetune.model.model import Model
from chargetune.runtime.numeric import is_finite

__all__ = ["ScoredPrior", "Twin", "Uncertain"]


@dataclass(frozen=True)
class Uncertain:
    """A parameter block, a state at the start, or the constant error of a measured output, that is not known.

    sd
        Standard deviation of ln(p / nominal) for a factor, of p - nominal for an offset, of what is added to the output for a bias.
    smooth
        Correlation of neighbouring entries of a block: entries i and j have correlation smooth^|i - j|.
    """

    name: str
    sd: float
    kind: Literal["factor", "offset", "start", "bias"] = "factor"
    smooth: float = 0.0

    def __post_init__(self) -> None:
        if self.kind not in ("factor", "offset", "start", "bias"):
            raise ValueError(f"twin: kind of {self.name} = {self.kind!r}, allowed is 'factor', 'offset', 'start' or 'bias'")
        for name, low, high in (("sd", 0.0, math.inf), ("smooth", 0.0, 1.0)):
            value = getattr(self, name)
            if not is_finite(value) or value < low or value >= high or (name == "sd" and value == 0):
                raise ValueError(f"twin: {name} of {self.name} = {value!r}, allowed is {'> 0' if name == 'sd' else '[0, 1)'}")

    @property
    def slot(self) -> tuple[str, str]:
        """What it belongs to: factor and offset of one block exclude each other."""
        return self.name, self.kind if self.kind in ("start", "bias") else "block"


class ScoredPrior(Protocol):
    """A prior of the unknowns m as functions of scores e ~ N(0, I), where it is not the Gaussian that `Uncertain` states."""

    @property
    def size(self) -> int:
        """Scores."""
        ...

    @property
    def scalars(self) -> list[int]:
        """Scores of unknowns that are one number."""
        ...

    def at(self, scores: NDArray[np.float64]) -> NDArray[np.float64]:
        """m of scores (..., size)."""
        ...

    def slopes(self, scores: NDArray[np.float64]) -> NDArray[np.float64]:
        """dm/de, shape (d, size)."""
        ...

    def under(self, twin: Twin, episode: Episode) -> Twin:
        """The twin with the start and the parameters that this episode was under."""
        ...


@dataclass(frozen=True)
class Twin:
    """A `Model` of the plant, what of it is unknown, and which outputs are measured with what noise.

    ``noise_sd`` maps the measured outputs to the standard deviation of one sample, ``start`` the states at the start of every
    trial to their nominal value (others are 0). ``given`` maps scalar parameters of the model that follow a given signal to its value in
    each interval of every trial; beyond the end the last one holds.
    ``discrepancy_sd_floor`` is by how much at least an output may be off at the largest input
    where nothing was measured, however well the model fits elsewhere; its variance is proportional to the input, down to the
    share ``floor_at_zero_input`` of it: wrong resistances do no harm where nothing flows, a wrong output at rest does.
    ``prior`` says more of the unknowns than their standard deviations, and in which condition each episode was.
    Raises ValueError for what the model does not have.
    """

    model: Model
    unknowns: tuple[Uncertain, ...]
    noise_sd: Mapping[str, float]
    start: Mapping[str, float] = field(default_factory=dict)
    discrepancy_sd_floor: Mapping[str, float] = field(default_factory=dict)
    floor_at_zero_input: float = 0.0
    given: Mapping[str, Sequence[float]] = field(default_factory=dict)
    prior: ScoredPrior | None = None

    def __post_init__(self) -> None:
        model = self.model
        blocks = set(model.parameter_blocks)
        known = {"start": set(model.state_names), "factor": blocks, "offset": blocks, "bias": set(self.noise_sd)}
        for one in self.unknowns:
            if one.name not in known[one.kind]:
                raise ValueError(f"twin: unknown {one.kind} {one.name!r}, allowed are {', '.join(sorted(known[one.kind]))}")
        names = [one.slot for one in self.unknowns]
        if not names or len(set(names)) < len(names):
            raise ValueError(f"twin: unknowns = {[n for n, _ in names]}, allowed is each once, at least one")
        outputs = tuple(self.noise_sd)
        named = (
            ("noise_sd", outputs, model.output_names),
            ("start", self.start, model.state_names),
            ("discrepancy_sd_floor", self.discrepancy_sd_floor, outputs),
        )
        for label, given, allowed in named:
            unknown = sorted(set(given) - set(allowed))
            if unknown:
                raise ValueError(f"twin: {label} names {unknown}, allowed are {', '.join(allowed)}")
        free = [name for name, size in model.parameter_blocks.items() if size == 1 and (name, "block") not in names]
        unknown = sorted(set(self.given) - set(free))
        if unknown:
            raise ValueError(f"twin: given = {unknown}, allowed are scalar parameters that are known: {', '.join(free) or '(none)'}")
        for name, values in self.given.items():
            if not len(values) or not np.all(np.isfinite(values)):
                raise ValueError(f"twin: given of {name} = {list(values)}, allowed are finite numbers, one for each interval")
        if not self.noise_sd or not all(math.isfinite(v) and v > 0 for v in self.noise_sd.values()):
            raise ValueError(f"twin: noise_sd = {dict(self.noise_sd)}, allowed are finite numbers > 0 for at least one output")

    @cached_property
    def sizes(self) -> tuple[int, ...]:
        """Entries of each unknown."""
        return tuple(1 if one.kind in ("start", "bias") else self.model.parameter_blocks[one.name] for one in self.unknowns)

    @cached_property
    def content(self) -> tuple[object, ...]:
        """All that it says, as text and numbers: equal for equal twins, in every process."""
        model = self.model
        functions = [hashlib.blake2b(f.serialize().encode(), digest_size=16).hexdigest() for f in (model.f, model.h)]
        measured, floor = dict(self.noise_sd), dict(self.discrepancy_sd_floor)
        told = {name: list(values) for name, values in self.given.items()}
        own = (*functions, model.nominal.tolist(), self.unknowns, measured, dict(self.start), floor, self.floor_at_zero_input)
        return (*own, *([told] if told else []), *([self.prior] if self.prior else []))

    @property
    def scalars(self) -> list[int]:
        """Entries of the scores that are one number: the prior knows each apart from all others."""
        if self.prior is not None:
            return self.prior.scalars
        return [int(at) for at, size in zip(np.cumsum([0, *self.sizes[:-1]]), self.sizes, strict=True) if size == 1]

    @cached_property
    def factors(self) -> NDArray[np.bool_]:
        """Which of the unknowns m are logarithms of factors, shape (d,)."""
        return np.repeat([one.kind == "factor" for one in self.unknowns], self.sizes)

    @cached_property
    def prior_factor(self) -> NDArray[np.float64]:
        """Lower Cholesky factor of the prior covariance S, shape (d, d)."""
        out = np.zeros((sum(self.sizes), sum(self.sizes)))
        start = 0
        for one, size in zip(self.unknowns, self.sizes, strict=True):
            steps = np.abs(np.subtract.outer(np.arange(size), np.arange(size)))
            part = slice(start, start + size)
            correlation = np.where(steps == 0, 1.0, one.smooth**steps)
            out[part, part] = one.sd * np.linalg.cholesky(correlation)
            start += size
        return out

    @property
    def score_count(self) -> int:
        """Scores e ~ N(0, I) that the unknowns follow from: m = L e with S = L L', or what ``prior`` says."""
        return len(self.prior_factor) if self.prior is None else self.prior.size

    def unknowns_at(self, scores: NDArray[np.float64]) -> NDArray[np.float64]:
        """Unknowns m of scores e (..., score_count)."""
        return np.asarray(scores @ self.prior_factor.T) if self.prior is None else self.prior.at(scores)

    def score_slopes(self, scores: NDArray[np.float64]) -> NDArray[np.float64]:
        """dm/de at scores e, shape (d, score_count)."""
        return self.prior_factor if self.prior is None else self.prior.slopes(scores)

    def under(self, episode: Episode) -> Twin:
        """The twin in the condition that this episode was under; itself where all episodes are under the same."""
        return self if self.prior is None else self.prior.under(self, episode)

    def biases(self, m: NDArray[np.float64]) -> dict[str, float]:
        """What is added to measured outputs for unknowns m, by output."""
        pieces = np.split(np.asarray(m), np.cumsum(self.sizes)[:-1])
        return {one.name: float(piece[0]) for one, piece in zip(self.unknowns, pieces, strict=True) if one.kind == "bias"}
