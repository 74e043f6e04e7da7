"""A closed loop of two states and 60 steps in numpy: a vessel that is filled as fast as a gauge at its inlet allows.

    level+ = level + 0.025 inflow,  swirl+ = 0.8 swirl + 0.2 gain inflow,  gauge = level + loss(level) inflow + swirl <= 1

``loss`` is linear between its nodes at the levels 0, 0.5 and 1. The controller knows the level, believes ``theta`` times the nominal loss
and the nominal gain, and takes the largest inflow that keeps the gauge at both ends of the next interval.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from chargetune.episode.episode import Ending, Episode
from chargetune.episode.score import Score
from chargetune.learning import Twin, Uncertain
from chargetune.learning.twin.rollout import parameters, start_state
from chargetune.model.model import Model, Signal
from chargetune.model.parameter_space import Parameter, ParameterSpace

STEPS, FILL, KEPT, INFLOW_MAX, LIMIT = 60, 0.025, 0.8, 1.0, 1.0
LOSS, GAIN = np.array([0.5, 0.4, 0.5]), 0.1
NOISE, TOLERANCE, WINDOWS = 1e-3, 5e-3, 4
SPACE = ParameterSpace((Parameter("loss", 0.3, 3.0, 1.0, size=3),))
OUTPUTS = ("level", "gauge", "swirl")


def _equations(x, u, p):
    hats = [ca.fmax(0.0, 1.0 - ca.fabs(2.0 * x["level"] - i)) for i in range(3)]
    gauge = x["level"] + sum(p["loss"][i] * hat for i, hat in enumerate(hats)) * u["inflow"] + x["swirl"]
    return (
        {"level": x["level"] + FILL * u["inflow"], "swirl": KEPT * x["swirl"] + (1 - KEPT) * p["gain"] * u["inflow"]},
        {"level": x["level"], "gauge": gauge, "swirl": x["swirl"]},
    )


MODEL = Model.build(
    "vessel", states=(Signal("level"), Signal("swirl")), inputs=(Signal("inflow"),), outputs=tuple(Signal(n) for n in OUTPUTS),
    parameters={"loss": tuple(LOSS), "gain": GAIN}, sampling_time_s=1.0, equations=_equations,
)  # fmt: skip
UNKNOWNS = (Uncertain("loss", 0.4, smooth=0.3), Uncertain("gain", 0.3))


def hat(level, values):
    """``values`` (..., 3) at the nodes, linear between them, at level (...)."""
    return np.sum(np.maximum(0.0, 1.0 - np.abs(2.0 * np.asarray(level)[..., None] - np.arange(3))) * values, axis=-1)


def fill(theta, loss, gain, start=0.0, swirl_start=0.0):
    """(inflow (n, K), levels (n, K + 1), swirls (n, K + 1), gauge at the start and at the end of each interval (n, K)) of n loops."""
    n = len(theta)
    levels, swirls, inflow = np.zeros((n, STEPS + 1)), np.zeros((n, STEPS + 1)), np.zeros((n, STEPS))
    levels[:, 0], swirls[:, 0], believed = start, swirl_start, np.zeros(n)
    for k in range(STEPS):
        own = hat(levels[:, k], theta * LOSS)
        at_start = (LIMIT - levels[:, k] - believed) / own
        at_end = (LIMIT - levels[:, k] - KEPT * believed) / (own + FILL + (1 - KEPT) * GAIN)
        inflow[:, k] = np.clip(np.minimum(at_start, at_end), 0.0, INFLOW_MAX)
        believed = KEPT * believed + (1 - KEPT) * GAIN * inflow[:, k]
        levels[:, k + 1] = levels[:, k] + FILL * inflow[:, k]
        swirls[:, k + 1] = KEPT * swirls[:, k] + (1 - KEPT) * gain * inflow[:, k]
    gauges = [levels[:, s] + hat(levels[:, s], loss[:, None, :]) * inflow + swirls[:, s] for s in (slice(0, -1), slice(1, None))]
    return inflow, levels, swirls, *gauges


def episode_of(inflow, levels, swirls, gauge_start, gauge_end) -> Episode:
    """One loop of `fill` as an episode."""
    count = len(inflow)
    start, end = (np.stack([levels[s], g, swirls[s]], axis=1) for s, g in ((slice(0, -1), gauge_start), (slice(1, None), gauge_end)))
    return Episode(
        1.0, ("inflow",), OUTPUTS, ("",), ("",) * 3, MODEL.state_names, np.arange(count) * 1.0, inflow[:, None], start, end,
        np.stack([levels, swirls], axis=1)[:-1], np.zeros(count, dtype=np.int64), np.zeros(count),
        np.zeros(count, dtype=np.int64), Ending.DONE,
    )  # fmt: skip


@dataclass(frozen=True)
class Told:
    """As much of a trial as a tuner reads."""

    number: int
    theta: tuple
    status: str = "done"
    score: Score | None = None
    episode: Callable[[], Episode | None] | None = None


@dataclass(frozen=True)
class ToyLoop:
    """The learner's closed loop (`TwinLoop`): unknown losses and, unless ``unknowns`` are others, an unknown gain of the swirl."""

    unknowns: tuple[Uncertain, ...] = UNKNOWNS
    noise_sd: dict[str, float] = field(default_factory=lambda: {"gauge": NOISE})
    discrepancy_sd_floor: dict[str, float] = field(default_factory=lambda: {"gauge": 1e-3})

    @cached_property
    def twin(self) -> Twin:
        return Twin(MODEL, self.unknowns, self.noise_sd, discrepancy_sd_floor=self.discrepancy_sd_floor)

    @property
    def features(self):
        return {"level": (0.0, 1.0), "inflow": (0.0, INFLOW_MAX)}

    def simulate(self, members):
        if not members:
            return []
        thetas, unknowns = np.array([m[0] for m in members]), [m[1] for m in members]
        p, x0 = np.array([parameters(self.twin, m) for m in unknowns]), np.array([start_state(self.twin, m) for m in unknowns])
        loops = fill(thetas, p[:, :3], p[:, 3], x0[:, 0], x0[:, 1])
        out = []
        for k, (_, m, error) in enumerate(members):
            episode = episode_of(*(part[k] for part in loops))
            for name, value in self.twin.biases(m).items():
                for side in (episode.output_start, episode.output_end):
                    side[:, OUTPUTS.index(name)] += value
            out.append(error(episode) if error else episode)
        return out

    def samples(self, episode):
        """Both ends of every interval; the window is that of the level."""
        level, gauge = (np.concatenate(episode.signal(name)) for name in ("level", "gauge"))
        return {"gauge": (gauge - LIMIT, np.clip((WINDOWS * level).astype(int), 0, WINDOWS - 1))}

    def score(self, episode):
        if not np.all(np.isfinite(episode.output_end)):
            return None
        excess, window = self.samples(episode)["gauge"]
        windows = tuple(float(excess[window == k].max()) if np.any(window == k) else None for k in range(WINDOWS))
        level = episode.signal("level")[1]
        objective = -float(np.mean(1.0 - level))
        return Score(
            objective, objective, {"gauge": float(excess.max())}, {"gauge": TOLERANCE}, profile={"gauge": windows},
            metrics={"level_end": float(level[-1])},
        )  # fmt: skip

    def violation(self, episode):
        return float(np.sum(np.maximum(0.0, episode.signal("gauge")[1] - LIMIT - TOLERANCE)))


@dataclass(frozen=True)
class Plant:
    """What is truly there; ``unmodelled`` maps (level, inflow) to what no twin of this model has in its gauge."""

    factors: tuple[float, float, float] = (1.5, 1.3, 1.4)
    gain: float = 0.13
    unmodelled: Callable[[Any, Any], Any] | None = None
    noise: float = NOISE
    start: float = 0.0

    def episode(self, theta, seed: int | None = None) -> Episode:
        """With the noise of this seed, None: as it truly is."""
        return self.episodes(np.atleast_2d(theta), seed)[0]

    def episodes(self, thetas, seed: int | None = None) -> list[Episode]:
        n, out = len(thetas), []
        loops = fill(np.asarray(thetas), np.tile(np.multiply(self.factors, LOSS), (n, 1)), np.full(n, self.gain), self.start)
        draw = np.random.default_rng(seed)
        for k in range(n):
            one = episode_of(*(part[k] for part in loops))
            for side in (one.output_start, one.output_end):
                side[:, 1] += 0.0 if self.unmodelled is None else self.unmodelled(side[:, 0], one.input[:, 0])
                side[:, 1] += 0.0 if seed is None else self.noise * draw.standard_normal(len(side))
            out.append(one)
        return out

    def trial(self, number, theta, seed: int = 0, loop: ToyLoop | None = None) -> Told:
        episode = self.episode(theta, 1000 * seed + number)
        return Told(number, tuple(theta), "done", (loop or ToyLoop()).score(episode), lambda: episode)

    def truth(self, theta) -> Score:
        return ToyLoop().score(self.episode(theta))

    def learn(self, tuner, count, seed: int = 0, trials=()) -> list[Told]:
        """The trials after ``count`` asks."""
        trials = list(trials)
        for number in range(len(trials), len(trials) + count):
            trials.append(self.trial(number, tuner.ask(SPACE, trials)[0], seed))
        return trials


def structural(level, inflow):
    """A loss that grows with the square of the inflow, and a gauge that is off near full."""
    return 0.04 * inflow * (inflow - 0.4) + 0.01 * level**3


@dataclass(frozen=True)
class Failing:
    """The loop, but that it fails where ``fails`` says so of theta."""

    loop: ToyLoop
    fails: Callable[[Any], bool]

    def __getattr__(self, name):
        return getattr(self.loop, name)

    def simulate(self, members):
        return [None if self.fails(member[0]) else e for member, e in zip(members, self.loop.simulate(members), strict=True)]


def holed(episode: Episode, name: str, where) -> Episode:
    """Without the samples of one output at ``where``."""
    out = replace(episode, output_start=episode.output_start.copy(), output_end=episode.output_end.copy())
    for side in (out.output_start, out.output_end):
        side[where, OUTPUTS.index(name)] = np.nan
    return out
